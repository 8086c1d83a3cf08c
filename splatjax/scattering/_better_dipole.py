"""The dipole with Grosjean's diffusion coefficient and an exitance that counts fluence and flux."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import record

from ._dipole import AbstractHalfSpace, flux_of_source, screening
from ._fresnel import AbstractFresnel
from ._medium import Medium


@record
class BetterDipole(AbstractHalfSpace):
    r"""The dipole of d'Eon: closer to light transport than the classical one where absorption is
    strong.

    With `D = (2 sigma_a + sigma_s') / (3 sigma_t'^2)`, `sigma_tr^2 = sigma_a / D`, `A = (1 + 3 C2)
    / (1 - 2 C1)`, `z_r = 1 / sigma_t'`, `z_v = z_r + 4 A D`, `C_phi = (1 - 2 C1) / 4` and `C_E = (1
    - 3 C2) / 2`,

        R(r) = alpha' / (4 pi) * { C_phi / D [exp(-sigma_tr d_r) / d_r - exp(-sigma_tr d_v) / d_v]
                                   + C_E * sum over z in (z_r, z_v) of z (1 + sigma_tr d)
                                   exp(-sigma_tr d) / d^3 }.

    Differentiable in every coefficient and in `r`; the derivatives at `r = 0` and, for the profile,
    at `sigma_a = 0` equal the one-sided limits.

    **Attributes:** `medium` and `fresnel`, as for every half space.

    **Source:** d'Eon 2012, "A better dipole"; diffusion coefficient: Grosjean 1956.
    """

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        shape = (*r.shape, self.medium.channels)
        squared_radius = jnp.broadcast_to((r * r)[..., None], shape)
        depth = jnp.broadcast_to(self.length_scale(), shape)
        albedo_prime = jnp.broadcast_to(self.medium.albedo_prime, shape)
        return albedo_prime * exitance_of_source(self.medium, self.fresnel, depth, squared_radius)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        r"""Compute `2 pi` times the integral of `r R(r)` in closed form.

            alpha' { C_phi (exp(-s z_r) - exp(-s z_v)) / (2 D s) + C_E / 2 (exp(-s z_r) + exp(-s
            z_v)) },  s = sigma_tr

        **Returns:** in [0, 1]; 1 where `sigma_a = 0`, with a derivative in `sigma_a` that diverges
        there: that of autodiff is infinite.
        """
        squared_sigma_tr, fluence_factor, flux_factor, height = _constants(
            self.medium, self.fresnel
        )
        s = jnp.sqrt(squared_sigma_tr)
        fluence = 0.5 * fluence_factor * height * one_minus_exp_over(s * height)
        flux = 0.5 * flux_factor * (1 + jnp.exp(-s * height))
        return self.medium.albedo_prime * jnp.exp(-s * self.length_scale()) * (fluence + flux)


def _constants(medium: Medium, fresnel: AbstractFresnel):
    """Compute `sigma_tr^2`, `C_phi / D`, `C_E` and `z_v - z_r` of each channel."""
    diffusion = (2 * medium.sigma_a + medium.sigma_s_prime) / (
        3 * medium.sigma_t_prime * medium.sigma_t_prime
    )
    first, second = fresnel.first_moment(medium.eta), fresnel.second_moment(medium.eta)
    height = 4 * (1 + second) / (1 - first) * diffusion
    return medium.sigma_a / diffusion, (1 - first) / (4 * diffusion), (1 - second) / 2, height


def exitance_of_source(
    medium: Medium,
    fresnel: AbstractFresnel,
    depth: Float[Array, "*shape"],
    squared_radius: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """Compute the exitance, 1/mm^2, above a point source of unit power and its image; the last axis
    is the channels.
    """
    squared_sigma_tr, fluence_factor, flux_factor, height = (
        jnp.broadcast_to(constant, depth.shape) for constant in _constants(medium, fresnel)
    )
    image = depth + height
    near, far = squared_radius + depth * depth, squared_radius + image * image
    fluence = fluence_factor * fluence_difference(squared_sigma_tr, near, far)
    flux = flux_of_source(squared_sigma_tr, depth, near)
    flux = flux + flux_of_source(squared_sigma_tr, image, far)
    return (fluence + flux_factor * flux) / (4 * jnp.pi)


def one_minus_exp_over(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute `(1 - exp(-x)) / x`, which is 1 at 0, for x at least 0."""
    positive = x > 0
    safe = jnp.where(positive, x, 1.0)
    return jnp.where(positive, -jnp.expm1(-safe) / safe, 1.0)


@jax.custom_jvp
def fluence_difference(
    u: Float[Array, "..."], near: Float[Array, "..."], far: Float[Array, "..."]
) -> Float[Array, "..."]:
    r"""Compute `exp(-sqrt(u near)) / sqrt(near) - exp(-sqrt(u far)) / sqrt(far)`, where near and
    far are squared distances.

    The derivative rule serves `u = 0`, where the infinite derivatives of the two terms cancel.
    """
    s, a, b = jnp.sqrt(u), jnp.sqrt(near), jnp.sqrt(far)
    return jnp.exp(-s * a) / a - jnp.exp(-s * b) / b


@fluence_difference.defjvp
def _fluence_difference_jvp(primals, tangents):
    u, near, far = primals
    u_dot, near_dot, far_dot = tangents
    s, a, b = jnp.sqrt(u), jnp.sqrt(near), jnp.sqrt(far)
    along_u = -0.5 * (b - a) * jnp.exp(-s * a) * one_minus_exp_over(s * (b - a))
    along_near = -0.5 * screening(u * near) / (near * a)
    along_far = 0.5 * screening(u * far) / (far * b)
    return fluence_difference(
        u, near, far
    ), along_u * u_dot + along_near * near_dot + along_far * far_dot
