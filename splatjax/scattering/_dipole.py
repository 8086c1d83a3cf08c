"""The classical dipole."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax.gaussians import AbstractProfile

from ._fresnel import AbstractFresnel, ExactFresnel
from ._medium import Medium


class Dipole(AbstractProfile):
    r"""The dipole of a semi-infinite medium: a source one mean free path below the surface, its
    mirror image above.

    With `z_r = 1 / sigma_t'`, `z_v = z_r (1 + 4A/3)` and `d^2 = r^2 + z^2`,

        R(r) = alpha' / (4 pi) * sum over z in (z_r, z_v) of z (1 + sigma_tr d) exp(-sigma_tr d) /
        d^3.

    Fresnel transmission at entry and exit is not part of it. Differentiable in every coefficient
    and in `r`; the derivatives at `r = 0` and, for the profile, at `sigma_a = 0` equal the
    one-sided limits.

    **Attributes:**

    - `medium`: its coefficients, [channels].
    - `fresnel`: the diffuse Fresnel moments: exact, or the polynomial fits of the literature.

    **Source:** Jensen, Marschner, Levoy and Hanrahan 2001, Eq. 4 (with both depths positive).
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
        squared_sigma_tr = jnp.broadcast_to(medium.squared_sigma_tr, shape)
        total = jnp.zeros(shape, squared_radius.dtype)
        for depth in self._depths():
            z = jnp.broadcast_to(depth, shape)
            squared_distance = squared_radius + z * z
            screened = screening(squared_sigma_tr * squared_distance)
            total = total + z * screened / (squared_distance * jnp.sqrt(squared_distance))
        return jnp.broadcast_to(medium.albedo_prime, shape) / (4 * jnp.pi) * total

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        r"""Give `2 pi` times the integral of `r R(r)` in closed form.

            alpha'/2 (1 + exp(-(4/3) A s)) exp(-s),  s = sqrt(3 (1 - alpha'))

        **Returns:** in [0, 1]; 1 where `sigma_a = 0`. There its derivative in `sigma_a` diverges
        like `-sigma_a^(-1/2)`, so that what autodiff gives at `sigma_a = 0` is not finite, on
        purpose.

        **Source:** Jensen et al. 2001, section 2.4.
        """
        medium = self.medium
        s = jnp.sqrt(3 * medium.sigma_a / medium.sigma_t_prime)
        boundary = self.fresnel.boundary(medium.eta)
        return 0.5 * medium.albedo_prime * (1 + jnp.exp(-4 / 3 * boundary * s)) * jnp.exp(-s)

    def length_scale(self) -> Float[Array, " channels"]:
        return 1 / self.medium.sigma_t_prime

    def _depths(self) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
        """Depth of the source and height of its image, mm."""
        source = 1 / self.medium.sigma_t_prime
        return source, source * (1 + 4 / 3 * self.fresnel.boundary(self.medium.eta))


@jax.custom_jvp
def screening(y: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Give `(1 + sqrt y) exp(-sqrt y)`, where `y = (sigma_tr d)^2` is at least 0; its derivative
    is `-exp(-sqrt y) / 2`.

    The rule is there for `y = 0`: the square roots' infinite derivatives cancel.
    """
    root = jnp.sqrt(y)
    return (1 + root) * jnp.exp(-root)


@screening.defjvp
def _screening_jvp(primals, tangents):
    (y,), (y_dot,) = primals, tangents
    return screening(y), -0.5 * jnp.exp(-jnp.sqrt(y)) * y_dot
