"""Models of the light of a medium: the profile, the quadrature of its fit, and the angles of its
light.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import (
    L2_QUADRATURE,
    AbstractRadialRule,
    AngularLaw,
    Dipole,
    HalfSpace,
    Medium,
    PhotonBeam,
)

from ._fit import fit_weights
from ._weights import FixedTotalReflectance, NonNegativeWeights


class AbstractModel(eqx.Module):
    """A model of light in a half space.

    **Attributes:** (of the class)

    - `rule`: the quadrature of a fit to its profiles.
    - `description`: of its profile, for files; `None` if coefficients alone define it.
    """

    rule: ClassVar[AbstractRadialRule] = L2_QUADRATURE
    description: ClassVar[str | None] = None

    @abc.abstractmethod
    def profile(self, medium: Medium) -> AbstractProfile:
        """Compute the profile of a medium. Differentiable."""

    def angles(self, medium: Medium) -> AngularLaw | None:
        """Compute the dependence of the light on the angles of entry and exit; `None` for none."""
        return None


class DiffusionModel(AbstractModel):
    r"""A profile in closed form: `Dipole`, as in publications, or `BetterDipole`.

    **Attributes:**

    - `kind`: from a medium to a profile that is finite at the origin. Static.
    """

    kind: Callable[[Medium], AbstractProfile] = eqx.field(static=True, default=Dipole)

    def profile(self, medium: Medium) -> AbstractProfile:
        return self.kind(medium)


class TransportModel(AbstractModel):
    r"""Light transport: the photon beam with the total reflectance and the angles of a `HalfSpace`.

    A fit uses radii from half a mean free path on, because splats hardly resolve smaller ones. It
    weights them by the fifth power of the radius, so that deep shadows are right.

    **Attributes:**

    - `g`: mean cosine of the phase function; one for all channels, or one for each. Static.
    """

    g: float | tuple[float, ...] = eqx.field(static=True, default=0.0)

    rule: ClassVar[AbstractRadialRule] = L2_QUADRATURE.beyond(0.5, tail=4.0)
    description: ClassVar[str | None] = "photon beam with the total of light transport"

    def half_space(self, medium: Medium) -> HalfSpace:
        return HalfSpace(medium, self.g)

    def profile(self, medium: Medium) -> PhotonBeam:
        total = self.half_space(medium).total_reflectance()
        return PhotonBeam(medium).with_total(total)

    def angles(self, medium: Medium) -> AngularLaw:
        return self.half_space(medium).angular_law()


def weight_factors(
    gaussians: SumOfGaussians, other: SumOfGaussians
) -> Float[Array, "gaussians channels"]:
    """Fit the factors on the weights of Gaussians that make another profile of them, of its total
    reflectance: `Splats.weights` where the body is of the other material. Not for traced arrays.

    A Gaussian without weight in a channel keeps none: the material with the wider profile should be
    the first.
    """
    weights, rule = np.asarray(gaussians.weights), TransportModel.rule
    held, factors = NonNegativeWeights(FixedTotalReflectance()), np.ones_like(weights)
    for channel, own in enumerate((weights > 0).T):
        profile = SumOfGaussians(other.variances, other.weights[:, channel, None])
        fitted = fit_weights(profile, gaussians.variances[own], weights=held, rule=rule).weights
        factors[own, channel] = fitted[:, 0] / weights[own, channel]
    return jnp.asarray(factors)
