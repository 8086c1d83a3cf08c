"""A beam of sources instead of one, and light that scatters once."""

import functools
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import record
from splatjax.gaussians import AbstractProfile

from ._better_dipole import exitance_of_source
from ._dipole import AbstractHalfSpace
from ._quadrature import along_first_axis, integrated_reflectance
from ._single_scattering import SingleScattering

_NODES = 128


@record
class PhotonBeam(AbstractHalfSpace):
    r"""Photon beam diffusion: the better dipole's exitance averaged over a beam's depth, plus
    single scattering.

    Light enters as a beam along the normal and is scattered at depth z with density `sigma_t'
    exp(-sigma_t' z)`. What scatters more than once is `alpha'^2 kappa E(z, r)`, with E the exitance
    above a point source and the correction `kappa = 1 - exp(-2 sigma_t' (d_r + z))`. What scatters
    once, isotropically, is followed to the surface, attenuated, and through it with the Fresnel
    transmittance; with theta the angle inside,

        R1(r) = alpha' sigma_t' / (4 pi r) * integral of exp(-sigma_t' r cot(theta / 2)) (1 - F)
        cos(theta) d theta.

    Infinite at the origin like 1/r: Eq. 3 is taken beyond a cut. Differentiable in every
    coefficient, and for `r > 0`.

    **Attributes:**

    - `medium`: its coefficients, [channels]; scattering is isotropic with the reduced coefficient.
    - `fresnel`: the diffuse Fresnel moments of the surface that diffuse light meets.

    **Source:** Habel, Christensen and Jarosz 2013, "Photon beam diffusion".
    """

    singular: ClassVar[bool] = True

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return self.multiple(r) + self.single(r)

    @jit_unless_traced
    def multiple(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        """Compute the light scattered more than once; finite at `r = 0`. 1/mm^2."""
        medium = self.medium
        shape = (_NODES, *r.shape, medium.channels)
        depth, weight = (along_first_axis(nodes, shape, r.dtype) for nodes in _beam())
        sigma_t_prime = jnp.broadcast_to(medium.sigma_t_prime, shape)
        depth = depth / sigma_t_prime
        squared_radius = jnp.broadcast_to((r * r)[None, ..., None], shape)
        distance = jnp.sqrt(squared_radius + depth * depth)
        kappa = -jnp.expm1(-2 * sigma_t_prime * (distance + depth))
        total = jnp.sum(
            weight * kappa * exitance_of_source(medium, self.fresnel, depth, squared_radius), axis=0
        )
        return jnp.broadcast_to(medium.albedo_prime**2, total.shape) * total

    def single(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        """Compute the light scattered once, 1/mm^2."""
        return SingleScattering(self.medium)(r)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute `2 pi` times the integral of `r R(r)`: single scattering exactly, multiple
        scattering by quadrature.
        """
        multiple = integrated_reflectance(self.multiply_scattered())
        return SingleScattering(self.medium).total_reflectance() + multiple

    def multiply_scattered(self) -> AbstractProfile:
        """Return the light scattered more than once as a profile: for a material with a
        `SingleScattering` of its own.
        """
        return _Multiple(self)


class _Multiple(AbstractProfile):
    """The light scattered more than once, which quadrature can integrate."""

    beam: PhotonBeam

    def __call__(self, r):
        return self.beam.multiple(r)

    def total_reflectance(self):
        return integrated_reflectance(self)

    def length_scale(self):
        return self.beam.length_scale()


@functools.cache
def _beam() -> tuple[np.ndarray, np.ndarray]:
    """Optical depths of sources and their weights `exp(-x) dx`, at equal steps of the logarithm:
    all scales are resolved.
    """
    logarithm, step = np.linspace(-30.0, 3.9, _NODES, retstep=True)
    x = np.exp(logarithm)
    return x, step * x * np.exp(-x)
