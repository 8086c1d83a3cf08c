"""The normalized Gaussian, profiles, and the one sum of Gaussians that fitter and renderer
share.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced


def gaussian(
    variance: Float[Array, "..."], squared_radius: Float[Array, "..."]
) -> Float[Array, "..."]:
    r"""Give the normalized two-dimensional Gaussian of Eq. 2, `exp(-r^2 / 2v) / (2 pi v)`.

    It is a function of the squared radius, so that no square root stands between a position and its
    gradient.

    **Arguments:**

    - `variance`: variance per axis, mm^2, positive. Differentiable.
    - `squared_radius`: mm^2; broadcasts against `variance`. Differentiable.

    **Returns:** 1/mm^2. Its integral over the plane is 1.

    **Source:** d'Eon, Luebke and Enderton 2007; Kim et al. 2010, Eq. 2.
    """
    return jnp.exp(-0.5 * squared_radius / variance) / (2 * jnp.pi * variance)


class AbstractProfile(eqx.Module):
    """A radial profile: radiant exitance per unit power entering at the origin of a flat surface.

    Lengths are in mm, `profile(r)` in 1/mm^2. Fresnel transmission at entry and exit is not part of
    it.
    """

    singular: ClassVar[bool] = False
    """Whether the profile goes to infinity at the origin like 1/r: the integrals of Eq. 3 and 4
    then exist beyond a cut only.
    """

    @abc.abstractmethod
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        """Give the profile at distance `r` (mm) from where light enters, in 1/mm^2."""

    @abc.abstractmethod
    def total_reflectance(self) -> Float[Array, " channels"]:
        """Give `2 pi` times the integral of `r profile(r)`: the share of the entering power that
        leaves.
        """

    @abc.abstractmethod
    def length_scale(self) -> Float[Array, " channels"]:
        """Give the distance (mm) over which the core of the profile changes: quadrature counts
        radii in it.
        """

    def known_radii(self) -> tuple[Float[Array, " samples"], Float[Array, " samples"]] | None:
        """Give the radii at which alone a measured profile is known, and their weights `dr` (mm);
        None for one known everywhere.

        Integrals of the profile are then sums over these.
        """
        return None


class SumOfGaussians(AbstractProfile):
    r"""A profile as a sum of Gaussians, `sum_i w_i G(v_i, r)` (Eq. 2).

    The variances are shared by all channels, since one set of layers serves them all.

    **Attributes:**

    - `variances`: mm^2, per axis. Differentiable.
    - `weights`: energies; their sum over the Gaussians is the total reflectance of a channel.
      Differentiable.
    """

    variances: Float[Array, " gaussians"]
    weights: Float[Array, "gaussians channels"]

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        squared_radius = jnp.broadcast_to((r * r)[..., None], (*r.shape, *self.variances.shape))
        variances = jnp.broadcast_to(self.variances, squared_radius.shape)
        return jnp.dot(gaussian(variances, squared_radius), self.weights)

    def total_reflectance(self) -> Float[Array, " channels"]:
        return jnp.sum(self.weights, axis=0)

    def length_scale(self) -> Float[Array, " channels"]:
        """Give the standard deviation of the narrowest Gaussian, mm."""
        return jnp.full_like(self.weights[0], jnp.sqrt(jnp.min(self.variances)))

    def blurred(self, variance: Float[Array, ""] | float) -> "SumOfGaussians":
        """Give what a Gaussian beam of a variance (mm^2 per axis) makes of the profile: the
        variances add (its convolution).
        """
        return SumOfGaussians(self.variances + variance, self.weights)

    def white(self) -> "SumOfGaussians":
        """Give the same profile with the weights of each channel divided by their sum."""
        return SumOfGaussians(self.variances, self.weights / jnp.sum(self.weights, axis=0)[None])
