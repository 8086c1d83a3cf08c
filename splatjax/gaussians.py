"""The normalized Gaussian, profiles, and sums of Gaussians, shared by fits and renderer."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import (
    Numbers,
    as_floats,
    check_values,
    numbers,
    precision_of,
    record,
    valid,
)


def gaussian(
    variance: Float[Array, "..."], squared_radius: Float[Array, "..."]
) -> Float[Array, "..."]:
    r"""Compute the normalized two-dimensional Gaussian of Eq. 2, `exp(-r^2 / 2v) / (2 pi v)`.

    The argument is the squared radius, so that derivatives with respect to positions need no square
    root.

    **Arguments:**

    - `variance`: variance per axis, mm^2, positive. Differentiable.
    - `squared_radius`: mm^2; broadcasts against `variance`. Differentiable.

    **Returns:** 1/mm^2. Its integral over the plane is 1.

    **Source:** d'Eon, Luebke and Enderton 2007; Kim et al. 2010, Eq. 2.
    """
    return jnp.exp(-0.5 * squared_radius / variance) / (2 * jnp.pi * variance)


class AbstractProfile(eqx.Module):
    """A radial profile: radiant exitance per unit power entering at the origin of a flat surface.

    Lengths are in mm, `profile(r)` in 1/mm^2. Fresnel transmission at entry and exit is not
    included.

    **Attributes:** (of the class)

    - `singular`: whether the profile diverges like 1/r at the origin, so that the integrals of Eq.
      3 and 4 need a cut.
    - `has_separate_channels`: whether each channel depends only on its own entry of every array of
      the profile. Integrals over different radii per channel are then faster.
    """

    singular: ClassVar[bool] = False
    has_separate_channels: ClassVar[bool] = False

    def __call__(self, r: Numbers) -> Float[Array, "*radii channels"]:
        """Compute the profile at distance `r` (mm) from the point where light enters, 1/mm^2. `r`
        may be a number, a list, or an array of any shape.
        """
        return self.evaluate(as_floats(r, precision_of([r, self]), "r"))

    @abc.abstractmethod
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        """Compute the profile at an array of distances, for `profile(r)`."""

    @abc.abstractmethod
    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute `2 pi` times the integral of `r profile(r)`: the fraction of the entering power
        that leaves.
        """

    @abc.abstractmethod
    def length_scale(self) -> Float[Array, " channels"]:
        """Compute the distance (mm) over which the core of the profile varies. Quadrature rules use
        it as the unit of radius.
        """

    def known_radii(self) -> tuple[Float[Array, " samples"], Float[Array, " samples"]] | None:
        """Return the radii at which a measured profile is known and their weights `dr` (mm), for
        integrals; `None` for a profile known at all radii.
        """
        return None


@record
class SumOfGaussians(AbstractProfile):
    r"""A profile that is a sum of Gaussians, `sum_i w_i G(v_i, r)` (Eq. 2).

    All channels share the variances, because one set of layers is rendered for all channels.

    **Attributes:**

    - `variances`: mm^2, per axis. Differentiable.
    - `weights`: energies; their sum over the Gaussians is the total reflectance. Differentiable.
    """

    variances: Float[Array, " gaussians"] = eqx.field(
        converter=numbers, metadata=valid("positive (mm^2)", lambda x: x > 0)
    )
    weights: Float[Array, "gaussians channels"] = eqx.field(
        converter=numbers, metadata=valid("finite")
    )

    @property
    def channels(self) -> int:
        return self.weights.shape[-1]

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        variances = self.variances.reshape(*[1] * r.ndim, -1)
        return jnp.dot(gaussian(variances, (r * r)[..., None]), self.weights)

    def total_reflectance(self) -> Float[Array, " channels"]:
        return jnp.sum(self.weights, axis=0)

    def length_scale(self) -> Float[Array, " channels"]:
        """Compute the standard deviation of the narrowest Gaussian, mm."""
        return jnp.full_like(self.weights[0], jnp.sqrt(jnp.min(self.variances)))

    def blurred(self, variance: Float[Array, ""] | float) -> "SumOfGaussians":
        """Convolve the profile with a Gaussian of a given variance, mm^2 per axis."""
        return SumOfGaussians(self.variances + variance, self.weights)

    def white(self) -> "SumOfGaussians":
        """Scale the weights of each channel to sum to 1.

        **Raises:** `ValueError` for a black channel.
        """
        total = self.total_reflectance()
        check_values("total_reflectance", total, "positive, to be scaled to 1", lambda x: x > 0)
        return SumOfGaussians(self.variances, self.weights / total[None])


def pad_gaussians(gaussians: SumOfGaussians) -> SumOfGaussians:
    """Pad more than three Gaussians to a multiple of three with unresolvably narrow ones of weight
    0. Not for traced arrays.
    """
    count = len(gaussians.variances)
    lacking = -count % 3 if count > 3 else 0
    if not lacking:
        return gaussians
    variances = np.pad(gaussians.variances, (0, lacking))
    variances[count:] = 1e-6 * variances[:count].min()
    weights = np.pad(gaussians.weights, ((0, lacking), (0, 0)))
    return SumOfGaussians(jax.device_put(variances), jax.device_put(weights))
