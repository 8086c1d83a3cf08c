"""Light that scatters once."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import numbers, record
from splatjax.gaussians import AbstractProfile

from ._fresnel import moment_outside, reflectance
from ._medium import Medium
from ._quadrature import along_first_axis, unit_interval, unit_legendre

_LEAST_COSINE = 1e-4
_COSINES = 10


@record
class SingleScattering(AbstractProfile):
    r"""Light scattered once in a half space, isotropically with the reduced coefficient: as a
    profile, and as radiance in a picture.

    The profile is that of light along the normal: after the scattering it travels to the surface,
    attenuated, and through it with the Fresnel transmittance. With theta the angle inside,

        R1(r) = alpha' sigma_t' / (4 pi r) * integral of exp(-sigma_t' r cot(theta / 2)) (1 - F)
        cos(theta) d theta.

    Infinite at the origin like 1/r. Differentiable in every coefficient, and for `r > 0`.

    **Attributes:**

    - `medium`: its coefficients, [channels].
    - `strength`: a factor on all of it, [channels]; 1 but for materials made white.

    **Source:** Habel, Christensen and Jarosz 2013 (profile); Hanrahan and Krueger 1993 (radiance).
    """

    medium: Medium
    strength: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0)

    singular: ClassVar[bool] = True

    @property
    def channels(self) -> int:
        return self.medium.channels

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        medium, angles = self.medium, self._escaping()
        shape = (angles[0].shape[0], *r.shape, medium.channels)
        middle = tuple(range(1, 1 + r.ndim))
        half_angle, weight = (
            jnp.broadcast_to(jnp.expand_dims(angle, middle), shape) for angle in angles
        )
        radius = jnp.broadcast_to(r[..., None], shape[1:])
        path = radius * jnp.broadcast_to(medium.sigma_t_prime, shape[1:])
        total = jnp.sum(weight * jnp.exp(-path[None] / half_angle), axis=0)
        scattering = jnp.broadcast_to(self.strength * medium.sigma_s_prime, shape[1:])
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
        r"""Compute the radiance towards `wo` per irradiance that has entered from `wi`, of a flat
        and evenly lit piece:

            alpha' / 4 pi * (1 - F(mu_o)) / (eta^2 (mu_i' + mu_o')),

        with the cosines `mu'` refracted. Times `mu_o` and integrated over all directions, with
        light along the normal, it is the total reflectance.

        **Arguments:** `mu_i`, `mu_o`: cosines of `wi` and `wo` outside, in [0, 1]; kept above 1e-4.
        Differentiable.
        """
        eta = self.medium.eta
        shape = (*mu_i.shape, self.channels)
        scattered = jnp.broadcast_to(self.strength * self.medium.albedo_prime, shape)
        eta = jnp.broadcast_to(eta, shape)
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
        """Compute the fraction of the light entering under the cosine `mu_i` that leaves after one
        scattering, with an error of 1e-3.
        """
        total = jnp.zeros((*mu_i.shape, self.channels), mu_i.dtype)
        for node, weight in zip(*unit_legendre(_COSINES), strict=True):
            # mu = t^2: the radiance has a root at grazing angles.
            radiance = self.reflected(mu_i, jnp.full_like(mu_i, node * node))
            total = total + float(4 * np.pi * weight * node**3) * radiance
        return total

    def _escaping(self) -> tuple[Float[Array, "angles channels"], Float[Array, "angles channels"]]:
        """Compute `tan(theta / 2)` of the angles at which light leaves, and their weights `(1 - F)
        cos(theta) d theta`.

        The angle is measured on the rarer side, where it takes all values: `sin(theta) = min(1, 1 /
        eta) sin(psi)`.
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
        # As eta goes to 1, light is reflected at grazing angles alone, which get infinitely few
        # nodes: the quadrature keeps its value and loses its derivative. One more node, at the
        # grazing angle, restores the closed form.
        missed = jnp.sum(weights * reflected * sine, axis=0) - 0.5 * moment_outside(self.medium.eta)
        grazing = stop_gradient(inside[0] / (1 + jnp.sqrt(1 - inside[0] ** 2)))
        half_angle = jnp.concatenate([inside * sine / (1 + cos_in), grazing[None]])
        return half_angle, jnp.concatenate(
            [weights * (1 - reflected) * inside, (inside[0] * missed)[None]]
        )
