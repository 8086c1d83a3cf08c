"""The classical dipole."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import record
from splatjax.gaussians import AbstractProfile

from ._fresnel import AbstractFresnel, ExactFresnel
from ._medium import Medium


class AbstractHalfSpace(AbstractProfile):
    r"""A profile of a semi-infinite medium.

    **Attributes:**

    - `medium`: its coefficients, [channels].
    - `fresnel`: the diffuse Fresnel moments: exact, or the polynomial fits of the literature.
    """

    medium: Medium
    fresnel: AbstractFresnel = ExactFresnel()

    def length_scale(self) -> Float[Array, " channels"]:
        """Return the mean free path, mm."""
        return 1 / self.medium.sigma_t_prime


@record
class Dipole(AbstractHalfSpace):
    r"""The dipole of a semi-infinite medium: a source one mean free path below the surface, its
    mirror image above.

    With `z_r = 1 / sigma_t'`, `z_v = z_r (1 + 4A/3)` and `d^2 = r^2 + z^2`,

        R(r) = alpha' / (4 pi) * sum over z in (z_r, z_v) of z (1 + sigma_tr d) exp(-sigma_tr d) /
        d^3.

    Fresnel transmission at entry and exit is not part of it. Differentiable in every coefficient
    and in `r`; the derivatives at `r = 0` and, for the profile, at `sigma_a = 0` equal the
    one-sided limits.

    **Attributes:** `medium` and `fresnel`, as for every half space.

    **Source:** Jensen, Marschner, Levoy and Hanrahan 2001, Eq. 4 (with both depths positive).
    """

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        medium = self.medium
        shape = (*r.shape, medium.channels)
        squared_radius = jnp.broadcast_to((r * r)[..., None], shape)
        squared_sigma_tr = jnp.broadcast_to(medium.squared_sigma_tr, shape)
        total = jnp.zeros(shape, squared_radius.dtype)
        source = self.length_scale()
        image = source * (1 + 4 / 3 * self.fresnel.boundary(medium.eta))
        for depth in (source, image):
            z = jnp.broadcast_to(depth, shape)
            total = total + flux_of_source(squared_sigma_tr, z, squared_radius + z * z)
        return jnp.broadcast_to(medium.albedo_prime, shape) / (4 * jnp.pi) * total

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        r"""Compute `2 pi` times the integral of `r R(r)` in closed form.

            alpha'/2 (1 + exp(-(4/3) A s)) exp(-s),  s = sqrt(3 (1 - alpha'))

        **Returns:** in [0, 1]; 1 where `sigma_a = 0`. There its derivative in `sigma_a` diverges
        like `-sigma_a^(-1/2)`, so that autodiff returns infinity at `sigma_a = 0`, on purpose.

        **Source:** Jensen et al. 2001, section 2.4.
        """
        medium = self.medium
        s = jnp.sqrt(3 * medium.sigma_a / medium.sigma_t_prime)
        boundary = self.fresnel.boundary(medium.eta)
        return 0.5 * medium.albedo_prime * (1 + jnp.exp(-4 / 3 * boundary * s)) * jnp.exp(-s)


def flux_of_source(
    squared_sigma_tr: Float[Array, "..."],
    depth: Float[Array, "..."],
    squared_distance: Float[Array, "..."],
) -> Float[Array, "..."]:
    """Compute `z (1 + sigma_tr d) exp(-sigma_tr d) / d^3`: the flux, times 4 pi, through the
    surface at a distance d from a source at depth z. 1/mm^2.
    """
    screened = screening(squared_sigma_tr * squared_distance)
    return depth * screened / (squared_distance * jnp.sqrt(squared_distance))


@jax.custom_jvp
def screening(y: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Compute `(1 + sqrt y) exp(-sqrt y)`, where `y = (sigma_tr d)^2` is at least 0; its
    derivative is `-exp(-sqrt y) / 2`.

    The derivative rule serves `y = 0`, where the infinite derivatives of the square roots cancel.
    """
    root = jnp.sqrt(y)
    return (1 + root) * jnp.exp(-root)


@screening.defjvp
def _screening_jvp(primals, tangents):
    (y,), (y_dot,) = primals, tangents
    return screening(y), -0.5 * jnp.exp(-jnp.sqrt(y)) * y_dot
