"""Single scattering, and photon beam diffusion."""

import functools
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import numbers, record
from splatjax.gaussians import AbstractProfile

from ._dipole import AbstractHalfSpace, BetterDipole
from ._medium import Medium, moment_outside, reflectance
from ._quadrature import along_first_axis, integrated_reflectance, unit_interval, unit_legendre

_NODES = 128
_LEAST_COSINE = 1e-4
_COSINES = 10
_LEAST_PART = 0.5


@record
class SingleScattering(AbstractProfile):
    r"""Light scattered once in a half space, isotropically with the reduced coefficient. It is
    available as a profile and as radiance.

    The profile is for light that enters along the normal. After the scattering event the light is
    attenuated on its way to the surface and leaves with the Fresnel transmittance. With theta the
    angle inside,

        R1(r) = alpha' sigma_t' / (4 pi r) * integral of exp(-sigma_t' r cot(theta / 2)) (1 - F)
        cos(theta) d theta.

    It diverges like 1/r at the origin. Differentiable in every coefficient, and in `r > 0`.

    **Attributes:**

    - `medium`: its coefficients, [channels].
    - `strength`: a factor, [channels]; 1 except for materials made white, and media that do not
      scatter isotropically (`PhotonBeam.single_scattered`).

    **Source:** Habel, Christensen and Jarosz 2013 (profile); Hanrahan and Krueger 1993 (radiance).
    """

    medium: Medium
    strength: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0)

    singular: ClassVar[bool] = True
    has_separate_channels: ClassVar[bool] = True

    @property
    def channels(self) -> int:
        return self.medium.channels

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        shape = (*r.shape, self.channels)
        half_angle, weight = (
            jnp.expand_dims(angles, tuple(range(1, 1 + r.ndim))) for angles in self._escaping()
        )
        radius = jnp.broadcast_to(r[..., None], shape)
        path = radius * jnp.broadcast_to(self.medium.sigma_t_prime, shape)
        total = jnp.sum(weight * jnp.exp(-path[None] / half_angle), axis=0)
        scattering = jnp.broadcast_to(self.strength * self.medium.sigma_s_prime, shape)
        return scattering * total / (4 * jnp.pi * radius)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        half_angle, weight = self._escaping()
        return self.strength * 0.5 * self.medium.albedo_prime * jnp.sum(weight * half_angle, axis=0)

    def length_scale(self) -> Float[Array, " channels"]:
        return 1 / self.medium.sigma_t_prime

    @jit_unless_traced
    def reflected(
        self, mu_i: Float[Array, "*points"], mu_o: Float[Array, "*points"]
    ) -> Float[Array, "*points channels"]:
        r"""Compute the radiance towards `wo`, per irradiance that entered from `wi`, of a flat and
        uniformly lit surface:

            alpha' / 4 pi * (1 - F(mu_o)) / (eta^2 (mu_i' + mu_o')),

        where `mu'` are the refracted cosines. For light along the normal, its integral over all
        directions, times `mu_o`, is the total reflectance.

        **Arguments:** `mu_i`, `mu_o`: cosines of `wi` and `wo` outside, in [0, 1]; clamped to at
        least 1e-4. Differentiable.
        """
        shape = (*mu_i.shape, self.channels)
        scattered = jnp.broadcast_to(self.strength * self.medium.albedo_prime, shape)
        eta = jnp.broadcast_to(self.medium.eta, shape)
        mu_i, mu_o = (
            jnp.broadcast_to(jnp.maximum(mu, _LEAST_COSINE)[..., None], shape)
            for mu in (mu_i, mu_o)
        )
        inside_i, inside_o = (
            jnp.sqrt(jnp.maximum(mu * mu + (eta * eta - 1), _LEAST_COSINE**2)) / eta
            for mu in (mu_i, mu_o)
        )
        transmitted = 1 - reflectance(inside_o, mu_o, eta)
        return scattered * transmitted / (4 * jnp.pi * eta * eta * (inside_i + inside_o))

    @jit_unless_traced
    def directional_albedo(self, mu_i: Float[Array, "*points"]) -> Float[Array, "*points channels"]:
        """Compute the fraction of the light entering at the cosine `mu_i` that leaves after one
        scattering event. The error is at most 1e-3.
        """
        # Substitute mu = t^2, because the radiance behaves like a square root at grazing angles.
        parts = [
            float(4 * np.pi * weight * t**3) * self.reflected(mu_i, jnp.full_like(mu_i, t * t))
            for t, weight in zip(*unit_legendre(_COSINES), strict=True)
        ]
        return functools.reduce(jnp.add, parts)

    def _escaping(self) -> tuple[Float[Array, "angles channels"], Float[Array, "angles channels"]]:
        """Compute `tan(theta / 2)` of the angles at which light leaves, and their weights
        `(1 - F) cos(theta) d theta`.

        The nodes are angles psi on the rarer side, which take all values:
        `sin(theta) = min(1, 1 / eta) sin(psi)`.
        """
        eta = self.medium.eta
        x, beyond, weights = (
            along_first_axis(nodes, (len(nodes), *eta.shape), eta.dtype)
            for nodes in unit_interval()
        )
        sine, cosine = jnp.sin(0.5 * jnp.pi * x), jnp.sin(0.5 * jnp.pi * beyond)
        eta = jnp.broadcast_to(eta, x.shape)
        inside, outside = jnp.where(eta < 1, 1.0, 1 / eta), jnp.where(eta < 1, eta, 1.0)
        cos_in, cos_out = (
            jnp.sqrt(cosine**2 + (1 - scale**2) * sine**2) for scale in (inside, outside)
        )
        reflected, weights = reflectance(cos_in, cos_out, eta), 0.5 * jnp.pi * weights * cosine
        # As eta goes to 1, light is reflected only at grazing angles, which the nodes do not
        # resolve: the value is right and the derivative is wrong. One more node, at the grazing
        # angle, restores the closed form.
        missed = jnp.sum(weights * reflected * sine, axis=0) - 0.5 * moment_outside(self.medium.eta)
        grazing = stop_gradient(inside[0] / (1 + jnp.sqrt(1 - inside[0] ** 2)))
        half_angle = jnp.concatenate([inside * sine / (1 + cos_in), grazing[None]])
        return half_angle, jnp.concatenate(
            [weights * (1 - reflected) * inside, (inside[0] * missed)[None]]
        )


@record
class PhotonBeam(AbstractHalfSpace):
    r"""Photon beam diffusion: the better dipole's exitance averaged over a beam's depth, plus
    single scattering.

    Light enters as a beam along the normal and is first scattered at depth z with density `sigma_t'
    exp(-sigma_t' z)`. Multiple scattering is `alpha'^2 kappa E(z, r)`, with E the exitance due to a
    point source and the correction `kappa = 1 - exp(-2 sigma_t' (d_r + z))`. Single scattering is
    isotropic, attenuated on its way to the surface, and transmitted there; with theta the angle
    inside,

        R1(r) = alpha' sigma_t' / (4 pi r) * integral of exp(-sigma_t' r cot(theta / 2)) (1 - F)
        cos(theta) d theta.

    It diverges like 1/r at the origin, so the integral of Eq. 3 starts at a cut. Differentiable in
    every coefficient, and in `r > 0`.

    **Attributes:**

    - `medium`: its coefficients, [channels]; scattering is isotropic with the reduced coefficient.
    - `fresnel`: the diffuse Fresnel moments of the surface that diffuse light meets.
    - `strength`: factor of multiple scattering, [channels]; 1 as published. `with_total` sets it.
    - `single`: factor of single scattering, [channels]; 1 for isotropic scattering.

    **Source:** Habel, Christensen and Jarosz 2013, "Photon beam diffusion".
    """

    strength: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0)
    single: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0)

    singular: ClassVar[bool] = True

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return self.multiply_scattered()(r) + self.single_scattered()(r)

    @jit_unless_traced
    def with_total(self, total: Float[Array, " channels"]) -> "PhotonBeam":
        """Scale multiple scattering so that the total reflectance is `total`, for example that of
        light transport (`HalfSpace`). The unscaled total of isotropic scattering differs from it by
        1 to 9%. Where less than half of multiple scattering's part of `total` would be left to it,
        it keeps this half, and single scattering is scaled, too.
        """
        single = self.single_scattered().total_reflectance()
        multiple = _MultipleScattering(self.medium, self.fresnel).total_reflectance()
        total = jnp.asarray(total)
        strength = (total - single) / multiple
        added = jnp.maximum(_LEAST_PART * total / (single + multiple) - strength, 0)
        factor = self.single * (1 - added * multiple / single)
        return PhotonBeam(self.medium, self.fresnel, strength + added, factor)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute `2 pi` times the integral of `r R(r)`: single scattering exactly, multiple
        scattering by quadrature.
        """
        multiple, single = self.multiply_scattered(), self.single_scattered()
        return multiple.total_reflectance() + single.total_reflectance()

    def multiply_scattered(self) -> AbstractProfile:
        """Return multiple scattering, which is finite at `r = 0`, for a material with separate
        `single_scattered()`. Their sum is this profile.
        """
        return _MultipleScattering(self.medium, self.fresnel, self.strength)

    def single_scattered(self) -> SingleScattering:
        """Return single scattering, for `Material.single_scattering`."""
        return SingleScattering(self.medium, self.single)


@record
class _MultipleScattering(AbstractHalfSpace):
    strength: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0)

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        shape = (_NODES, *r.shape, self.medium.channels)
        depth, weight = (along_first_axis(nodes, shape, self.medium.eta.dtype) for nodes in _beam())
        sigma_t_prime = jnp.broadcast_to(self.medium.sigma_t_prime, shape)
        depth = depth / sigma_t_prime
        squared_radius = jnp.broadcast_to((r * r)[None, ..., None], shape)
        distance = jnp.sqrt(squared_radius + depth * depth)
        kappa = -jnp.expm1(-2 * sigma_t_prime * (distance + depth))
        exitance = BetterDipole(self.medium, self.fresnel).exitance(depth, squared_radius)
        total = jnp.sum(weight * kappa * exitance, axis=0)
        factor = self.strength * self.medium.albedo_prime**2
        return jnp.broadcast_to(factor, total.shape) * total

    def total_reflectance(self):
        return integrated_reflectance(self)


@functools.cache
def _beam() -> tuple[np.ndarray, np.ndarray]:
    """Compute optical depths x of the sources and their weights `exp(-x) dx`, at equal steps of log
    x to resolve all scales.
    """
    logarithm, step = np.linspace(-30.0, 3.9, _NODES, retstep=True)
    x = np.exp(logarithm)
    return x, step * x * np.exp(-x)
