"""The dipole with Grosjean's diffusion coefficient and an exitance that counts fluence and flux."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax.gaussians import AbstractProfile

from ._dipole import screening
from ._fresnel import AbstractFresnel, ExactFresnel
from ._medium import Medium


class BetterDipole(AbstractProfile):
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

    **Attributes:**

    - `medium`: its coefficients, [channels].
    - `fresnel`: the diffuse Fresnel moments: exact, or the polynomial fits of the literature.

    **Source:** d'Eon 2012, "A better dipole"; diffusion coefficient: Grosjean 1956.
    """

    medium: Medium
    fresnel: AbstractFresnel

    def __init__(self, medium: Medium, fresnel: AbstractFresnel | None = None):
        self.medium = medium
        self.fresnel = ExactFresnel() if fresnel is None else fresnel

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        medium = self.medium
        shape = (*r.shape, *medium.sigma_a.shape)
        squared_radius = jnp.broadcast_to((r * r)[..., None], shape)
        depth = jnp.broadcast_to(self.length_scale(), shape)
        albedo_prime = jnp.broadcast_to(medium.albedo_prime, shape)
        return albedo_prime * exitance_of_source(medium, self.fresnel, depth, squared_radius)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        r"""Give `2 pi` times the integral of `r R(r)` in closed form.

            alpha' { C_phi (exp(-s z_r) - exp(-s z_v)) / (2 D s) + C_E / 2 (exp(-s z_r) + exp(-s
            z_v)) },  s = sigma_tr

        **Returns:** in [0, 1]; 1 where `sigma_a = 0`, with a derivative in `sigma_a` that diverges
        there: autodiff's is not finite.
        """
        medium = self.medium
        diffusion, squared_sigma_tr = grosjean(medium)
        fluence_share, flux_share, height = _boundary(medium, self.fresnel, diffusion)
        s, source = jnp.sqrt(squared_sigma_tr), self.length_scale()
        near = jnp.exp(-s * source)
        fluence = fluence_share / (2 * diffusion) * height * near * falling_share(s * height)
        return medium.albedo_prime * (fluence + flux_share / 2 * near * (1 + jnp.exp(-s * height)))

    def length_scale(self) -> Float[Array, " channels"]:
        return 1 / self.medium.sigma_t_prime


def grosjean(medium: Medium) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
    """Give Grosjean's diffusion coefficient (mm) and the square of the effective transport
    coefficient (1/mm^2).
    """
    diffusion = (2 * medium.sigma_a + medium.sigma_s_prime) / (
        3 * medium.sigma_t_prime * medium.sigma_t_prime
    )
    return diffusion, medium.sigma_a / diffusion


def _boundary(medium: Medium, fresnel: AbstractFresnel, diffusion: Float[Array, " channels"]):
    """Give C_phi, C_E, and how much higher the image lies than the source is deep, mm."""
    first, second = fresnel.first_moment(medium.eta), fresnel.second_moment(medium.eta)
    return (1 - first) / 4, (1 - second) / 2, 4 * (1 + second) / (1 - first) * diffusion


def exitance_of_source(
    medium: Medium,
    fresnel: AbstractFresnel,
    depth: Float[Array, "*shape"],
    squared_radius: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """Give the exitance, 1/mm^2, above a point source of unit power and its image; the last axis is
    the channels.
    """
    shape = depth.shape
    diffusion, squared_sigma_tr = grosjean(medium)
    factors = _boundary(medium, fresnel, diffusion)
    fluence_share, flux_share, height = (jnp.broadcast_to(each, shape) for each in factors)
    diffusion, squared_sigma_tr = (
        jnp.broadcast_to(each, shape) for each in (diffusion, squared_sigma_tr)
    )
    image = depth + height
    near, far = squared_radius + depth * depth, squared_radius + image * image
    fluence = fluence_share / diffusion * fluence_difference(squared_sigma_tr, near, far)

    def flux(z, squared_distance):
        return (
            z
            * screening(squared_sigma_tr * squared_distance)
            / (squared_distance * jnp.sqrt(squared_distance))
        )

    return (fluence + flux_share * (flux(depth, near) + flux(image, far))) / (4 * jnp.pi)


def falling_share(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Give `(1 - exp(-x)) / x`, which is 1 at 0, for x at least 0."""
    positive = x > 0
    safe = jnp.where(positive, x, 1.0)
    return jnp.where(positive, -jnp.expm1(-safe) / safe, 1.0)


@jax.custom_jvp
def fluence_difference(
    u: Float[Array, "..."], near: Float[Array, "..."], far: Float[Array, "..."]
) -> Float[Array, "..."]:
    r"""Give `exp(-sqrt(u near)) / sqrt(near) - exp(-sqrt(u far)) / sqrt(far)`, where near and far
    are squared distances.

    The rule is there for `u = 0`: the infinite derivatives of the two cancel.
    """
    s, a, b = jnp.sqrt(u), jnp.sqrt(near), jnp.sqrt(far)
    return jnp.exp(-s * a) / a - jnp.exp(-s * b) / b


@fluence_difference.defjvp
def _fluence_difference_jvp(primals, tangents):
    u, near, far = primals
    u_dot, near_dot, far_dot = tangents
    s, a, b = jnp.sqrt(u), jnp.sqrt(near), jnp.sqrt(far)
    along_u = -0.5 * (b - a) * jnp.exp(-s * a) * falling_share(s * (b - a))
    along_near, along_far = (
        -0.5 * screening(u * near) / (near * a),
        0.5 * screening(u * far) / (far * b),
    )
    return fluence_difference(
        u, near, far
    ), along_u * u_dot + along_near * near_dot + along_far * far_dot
