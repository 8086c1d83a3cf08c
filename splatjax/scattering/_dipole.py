"""Profiles in closed form: the classical dipole, the better dipole with fluence and flux, and
normalized diffusion.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import numbers, record, valid
from splatjax._smooth import mean_decay
from splatjax.gaussians import AbstractProfile

from ._medium import AbstractFresnel, ExactFresnel, Medium


class AbstractHalfSpace(AbstractProfile):
    r"""A profile of a semi-infinite medium.

    **Attributes:**

    - `medium`: its coefficients, [channels].
    - `fresnel`: the diffuse Fresnel moments: exact, or the polynomial fits of the literature.
    """

    medium: Medium
    fresnel: AbstractFresnel = ExactFresnel()

    has_separate_channels: ClassVar[bool] = True

    def length_scale(self) -> Float[Array, " channels"]:
        """Return the mean free path, mm."""
        return 1 / self.medium.sigma_t_prime


class AbstractDipole(AbstractHalfSpace):
    r"""A point source one mean free path `z_r` below the surface, and its mirror image at height
    `z_v = z_r + h` above it:

        R(r) = alpha' / (4 pi) * { C_phi / D [exp(-s d_r) / d_r - exp(-s d_v) / d_v]
                                   + C_E * sum over z in (z_r, z_v) of
                                     z (1 + s d) exp(-s d) / d^3 },

    with `s = sigma_tr` and `d^2 = r^2 + z^2`.

    Fresnel transmission at entry and exit is not included. Differentiable in every coefficient and
    in `r`; the derivatives of the profile at `r = 0` and at `sigma_a = 0` are the one-sided limits.
    """

    @abc.abstractmethod
    def boundary(self) -> tuple[Array, Array, Array, Array | None]:
        """Compute `sigma_tr^2`, `h`, `C_E` and `C_phi / D`; the last is None for a model without
        fluence.
        """

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        shape = (*r.shape, self.medium.channels)
        squared_radius = jnp.broadcast_to((r * r)[..., None], shape)
        depth = jnp.broadcast_to(self.length_scale(), shape)
        return jnp.broadcast_to(self.medium.albedo_prime, shape) * self.exitance(
            depth, squared_radius
        )

    def exitance(
        self, depth: Float[Array, "*shape"], squared_radius: Float[Array, "*shape"]
    ) -> Float[Array, "*shape"]:
        """Compute the exitance, 1/mm^2, due to a point source of unit power and its image. The last
        axis holds the channels.
        """
        u, height, flux, fluence = jax.tree.map(
            lambda constant: jnp.broadcast_to(constant, depth.shape), self.boundary()
        )
        image = depth + height
        near, far = squared_radius + depth * depth, squared_radius + image * image
        exitance = flux * sum(
            z * screening(u * squared) / (squared * jnp.sqrt(squared))
            for z, squared in ((depth, near), (image, far))
        )
        if fluence is not None:
            exitance = exitance + fluence * fluence_difference(u, near, far)
        return exitance / (4 * jnp.pi)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        r"""Compute `2 pi` times the integral of `r R(r)` in closed form.

            alpha'/2 exp(-s z_r) { C_E (1 + exp(-s h)) + C_phi / D (1 - exp(-s h)) / s }

        **Returns:** in [0, 1]; 1 where `sigma_a = 0`. The derivative with respect to `sigma_a`
        diverges like `-sigma_a^(-1/2)`, so at `sigma_a = 0` autodiff returns infinity, as it
        should.

        **Source:** Jensen et al. 2001, section 2.4, for the classical dipole.
        """
        squared_sigma_tr, height, flux, fluence = self.boundary()
        s = jnp.sqrt(squared_sigma_tr)
        total = flux * (1 + jnp.exp(-s * height))
        if fluence is not None:
            total = total + fluence * height * mean_decay(s * height)
        return 0.5 * self.medium.albedo_prime * jnp.exp(-s * self.length_scale()) * total


@record
class Dipole(AbstractDipole):
    r"""The classical dipole, a profile of a half space. Most published fits use it.

        Dipole(load_medium("marble"))(jnp.linspace(0.5, 2, 3))  # [radii, channels], 1/mm^2

    A source below the surface and its image above give

        R(r) = alpha' / (4 pi) * sum over z in (z_r, z_v) of z (1 + s d) exp(-s d) / d^3

    with `d^2 = r^2 + z^2`, `s = sigma_tr`, `sigma_tr^2 = 3 sigma_a sigma_t'`, `z_r = 1 / sigma_t'`,
    `z_v = z_r (1 + 4A/3)`, `A = (1 + Fdr) / (1 - Fdr)`, `alpha' = sigma_s' / sigma_t'` and
    `sigma_t' = sigma_a + sigma_s'`. `Fdr` is the diffuse reflectance of the surface from inside.

    **Attributes:**

    - `medium`: coefficients, [channels]. Differentiable.
    - `fresnel`: `ExactFresnel()`, or `EganFresnel()` for the polynomial of published fits.

    **Source:** Jensen, Marschner, Levoy and Hanrahan 2001, Eq. 4 (with both depths positive).
    """

    def boundary(self):
        medium = self.medium
        height = 4 / 3 * self.fresnel.boundary(medium.eta) / medium.sigma_t_prime
        return medium.squared_sigma_tr, height, jnp.ones_like(height), None


@record
class BetterDipole(AbstractDipole):
    r"""D'Eon's dipole, with Grosjean's diffusion coefficient and an exitance that combines fluence
    and flux. It is more accurate than the classical dipole where absorption is strong.

    It is `AbstractDipole` with `D = (2 sigma_a + sigma_s') / (3 sigma_t'^2)`, `sigma_tr^2 = sigma_a
    / D`, `A = (1 + 3 C2) / (1 - 2 C1)`, `z_r = 1 / sigma_t'`, `z_v = z_r + 4 A D`, `C_phi = (1 - 2
    C1) / 4` and `C_E = (1 - 3 C2) / 2`, where `2 C1` and `3 C2` are the moments of the internal
    reflectance (`AbstractFresnel`).

    **Attributes:**

    - `medium`: coefficients, [channels]. Differentiable.
    - `fresnel`: `ExactFresnel()`, or `EganFresnel()` for the polynomial of published fits.

    **Source:** d'Eon 2012, "A better dipole"; diffusion coefficient: Grosjean 1956.
    """

    def boundary(self):
        medium, eta = self.medium, self.medium.eta
        diffusion = (2 * medium.sigma_a + medium.sigma_s_prime) / (
            3 * medium.sigma_t_prime * medium.sigma_t_prime
        )
        first, second = self.fresnel.first_moment(eta), self.fresnel.second_moment(eta)
        height = 4 * (1 + second) / (1 - first) * diffusion
        fluence = (1 - first) / (4 * diffusion)
        return medium.sigma_a / diffusion, height, (1 - second) / 2, fluence


@jax.custom_jvp
def screening(y: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Compute `(1 + sqrt y) exp(-sqrt y)`, where `y = (sigma_tr d)^2` is at least 0; its
    derivative is `-exp(-sqrt y) / 2`.

    The custom derivative is for `y = 0`, where the infinite derivatives of the square roots cancel.
    """
    root = jnp.sqrt(y)
    return (1 + root) * jnp.exp(-root)


screening.defjvps(lambda y_dot, _, y: -0.5 * jnp.exp(-jnp.sqrt(y)) * y_dot)


@jax.custom_jvp
def fluence_difference(
    u: Float[Array, "..."], near: Float[Array, "..."], far: Float[Array, "..."]
) -> Float[Array, "..."]:
    r"""Compute `exp(-sqrt(u near)) / sqrt(near) - exp(-sqrt(u far)) / sqrt(far)`, where near and
    far are squared distances.

    The derivative rule is for `u = 0`, where the infinite derivatives of the two terms cancel.
    """
    s, a, b = jnp.sqrt(u), jnp.sqrt(near), jnp.sqrt(far)
    return jnp.exp(-s * a) / a - jnp.exp(-s * b) / b


def _fluence_along_u(u_dot, _, u, near, far):
    s, a, b = jnp.sqrt(u), jnp.sqrt(near), jnp.sqrt(far)
    return -0.5 * (b - a) * jnp.exp(-s * a) * mean_decay(s * (b - a)) * u_dot


fluence_difference.defjvps(
    _fluence_along_u,
    lambda near_dot, _, u, near, far: (
        -0.5 * screening(u * near) / (near * jnp.sqrt(near)) * near_dot
    ),
    lambda far_dot, _, u, near, far: 0.5 * screening(u * far) / (far * jnp.sqrt(far)) * far_dot,
)


def searchlight_scaling(albedo: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Compute Burley's scaling `s` for a beam, where `free_path` is the mean free path.

    **Source:** Christensen and Burley 2015.
    """
    return 1.85 - albedo + 7 * jnp.abs(albedo - 0.8) ** 3


def diffuse_scaling(albedo: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Compute Burley's scaling `s` for diffuse incident light, where `free_path` is the mean free
    path.

    **Source:** Christensen and Burley 2015, Eq. 6.
    """
    return 1.9 - albedo + 3.5 * (albedo - 0.8) ** 2


def diffuse_mean_free_path_scaling(albedo: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Compute Burley's scaling `s` for a beam, where `free_path` is the diffuse mean free path.

    **Source:** Christensen and Burley 2015.
    """
    return 3.5 + 100 * (albedo - 0.33) ** 4


@record
class Burley(AbstractProfile):
    r"""Normalized diffusion: two exponentials fitted to Monte Carlo profiles, including single
    scattering.

        R(r) = A (exp(-r / d) + exp(-r / 3d)) / (8 pi d r),  d = free_path / s(A)

    It diverges like 1/r at the origin, so the integral of Eq. 3 starts at a cut. Differentiable for
    `r > 0`.

    **Attributes:**

    - `albedo`: surface albedo A, the total reflectance, in [0, 1].
    - `free_path`: mm, positive.
    - `scaling`: the published function `s(A)`: `searchlight_scaling` (default), `diffuse_scaling`
      or `diffuse_mean_free_path_scaling`. Static.

    **Source:** Christensen and Burley 2015, "Approximate reflectance profiles for efficient
    subsurface scattering".
    """

    albedo: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("in [0, 1]", lambda x: (x >= 0) & (x <= 1))
    )
    free_path: Float[Array, " channels"] = eqx.field(
        converter=numbers, metadata=valid("positive (mm)", lambda x: x > 0)
    )
    scaling: Callable[[Array], Array] = eqx.field(static=True, default=searchlight_scaling)

    singular: ClassVar[bool] = True

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        shape = (*r.shape, *self.albedo.shape)
        radius = jnp.broadcast_to(r[..., None], shape)
        d = jnp.broadcast_to(self.length_scale(), shape)
        exponentials = jnp.exp(-radius / d) + jnp.exp(-radius / (3 * d))
        return jnp.broadcast_to(self.albedo, shape) * exponentials / (8 * jnp.pi * d * radius)

    def total_reflectance(self) -> Float[Array, " channels"]:
        return self.albedo

    def length_scale(self) -> Float[Array, " channels"]:
        """Compute `d`, mm."""
        return self.free_path / self.scaling(self.albedo)
