"""Profiles of what has two sides, known in the Hankel domain."""

import abc

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax.gaussians import AbstractProfile

from ._adding import Response
from ._hankel import inverse_hankel_transform
from ._layers import Layer


class AbstractSlabProfile(AbstractProfile):
    """A profile with a transmittance beside its reflectance; both are inverse Hankel transforms."""

    @abc.abstractmethod
    def response(self, k: Float[Array, "*frequencies channels"]) -> Response:
        """Give reflectance and transmittance at spatial frequencies `k` (1/mm, at least 0)."""

    @abc.abstractmethod
    def falls(self) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
        """Give lengths `a` (mm) such that reflectance and transmittance fall like `exp(-a k)` or
        faster.
        """

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return inverse_hankel_transform(
            lambda k: self.response(k).reflectance_above, r, self.falls()[0]
        )

    @jit_unless_traced
    def transmittance(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        """Give the radiant exitance below per unit power entering above, at distance `r` (mm) from
        the axis; 1/mm^2.
        """
        return inverse_hankel_transform(
            lambda k: self.response(k).transmittance_down, r, self.falls()[1]
        )

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        return self.response(jnp.zeros_like(self.length_scale())).reflectance_above

    @jit_unless_traced
    def total_transmittance(self) -> Float[Array, " channels"]:
        """Give the share of the entering power that leaves below."""
        return self.response(jnp.zeros_like(self.length_scale())).transmittance_down

    def transmitted(self) -> "Transmitted":
        """Give the transmittance as a profile, to be fitted like any other."""
        return Transmitted(self)


class Transmitted(AbstractProfile):
    """What leaves a slab on the far side, as a profile."""

    slab: AbstractSlabProfile

    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return self.slab.transmittance(r)

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Give the share of the entering power that leaves on the far side."""
        return self.slab.total_transmittance()

    def length_scale(self) -> Float[Array, " channels"]:
        """Give the mean free path, or the depth below the last source if that is more, mm."""
        return jnp.maximum(self.slab.length_scale(), self.slab.falls()[1])


_SHALLOWEST = 1e-3  # mean free paths: so near the far side a source is a point to the quadrature


def slab_falls(layer: Layer) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
    """Give the source's distances (mm) from both sides; an infinite layer lets nothing through, and
    any length does.
    """
    depth = 1 / layer.medium.sigma_t_prime
    beneath = jnp.maximum(layer.thickness.astype(depth.dtype) - depth, _SHALLOWEST * depth)
    return depth, jnp.where(jnp.isfinite(beneath), beneath, depth)
