"""Light that enters a body: its path, and single scattering along it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax.scattering import ExactFresnel, Medium

from ._screened import ScreenedKernel
from ._surface_sums import SurfaceSums, dot

_DEPTHS = 6  # along each beam
_MILNE = 0.710446  # extrapolation distance of the Milne problem, mean free paths, times albedo
_LEAST_ALBEDO = 0.1
# Hopf's q(tau) = _MILNE - sum_i a_i exp(-b_i tau), within 0.0024.
_HOPF = (0.08948, 2.11533), (0.04361, 16.63774)


class DiffusionCoefficients(eqx.Module):
    r"""Coefficients of the diffusion equation and its boundary, one for each channel.

    Far from boundaries and beams the solutions decay as those of light transport do: `kappa` is
    Case's discrete eigenvalue, `kappa / sigma_t = tanh(kappa / sigma_s)`, within 0.2% for albedos
    above 0.5, and `D = sigma_a / kappa^2`.

    **Attributes:**

    - `sigma_t`: reduced extinction coefficient, 1/mm.
    - `albedo`: reduced.
    - `diffusion_coefficient`: `D`, mm.
    - `squared_kappa`: 1/mm^2.
    - `z_e`: extrapolation distance, mm.
    - `lasting`: the fraction of an isotropic source that diffuses; the rest is absorbed within
      about a mean free path. Fitted to the transmittance of a slab of eight mean free paths.
    - `inward`: fluence over the irradiance of uniform light that enters, in equilibrium.

    **Source:** Case and Zweifel 1967, "Linear Transport Theory".
    """

    sigma_t: Float[Array, "*channels"]
    albedo: Float[Array, "*channels"]
    diffusion_coefficient: Float[Array, "*channels"]
    squared_kappa: Float[Array, "*channels"]
    z_e: Float[Array, "*channels"]
    lasting: Float[Array, "*channels"]
    inward: Float[Array, "*channels"]

    @classmethod
    def of(cls, medium: Medium) -> "DiffusionCoefficients":
        fresnel, sigma_t, albedo = ExactFresnel(), medium.sigma_t_prime, medium.albedo_prime
        loss = medium.sigma_a / sigma_t
        diffusion = (1 + loss * (0.45 + 0.5 * loss)) / (3 - 1.05 * loss) / sigma_t
        inward = 4 / (1 - fresnel.first_moment(medium.eta))
        z_e = _MILNE / 4 * (1 + fresnel.second_moment(medium.eta)) * inward / sigma_t
        # A half-space that absorbs returns of even light what Chandrasekhar's H gives.
        inward = inward * (1 + 4.5 * loss) / (1 + 4.95 * loss)
        z_e = z_e / jnp.maximum(albedo, _LEAST_ALBEDO)
        lasting = 1 - loss * (0.53 + 0.265 * loss)
        return cls(sigma_t, albedo, diffusion, medium.sigma_a / diffusion, z_e, lasting, inward)


def scattered_once(
    surface: SurfaceSums,
    medium: DiffusionCoefficients,
    kernel: ScreenedKernel,
    irradiance: Float[Array, "channels splats"],
    directions: Float[Array, "channels 3 splats"],
) -> tuple[Float[Array, "channels splats"], Float[Array, "channels splats"]]:
    """Integrate the single scattering of the beams: `(1 / D) int G Q dV` at every splat, and the
    light that leaves before it diffuses.

    **Arguments:**

    - `kernel`: softened less than on the surface, since the beams decay faster.
    """
    nodes = np.polynomial.legendre.leggauss(_DEPTHS)
    # Denser at the end of the beam, whose scattering passes through thick parts.
    left = (1 - nodes[0]) / 2
    shares, left = (jnp.asarray(x, irradiance.dtype)[:, None] for x in (nodes[1] * left, left**2))
    centers, normals = (jnp.stack(each) for each in (surface.centers, surface.normals))

    def of_channel(given):
        medium, kappa, irradiance, directions = given
        own = ScreenedKernel(kappa[None], kernel.length)

        def exits(row):
            rows = [row, *surface.normals]
            length, cosine, rows = surface.first_exits(tuple(directions), irradiance > 0, rows)
            return rows[0], (length, cosine, dot(rows[1:], surface.normals))

        none = jnp.zeros_like(irradiance)
        _, to_exits, ends = jax.vjp(exits, none, has_aux=True)
        length, exit_cosine, alike = (row[None] for row in ends)
        is_through = jnp.isfinite(length)
        length = jnp.where(is_through, length, 0.0)
        stopped = jnp.where(is_through, -jnp.expm1(-medium.sigma_t * length), 1.0)
        # Places along the beam, beyond which the fractions `left` of its scattering take place.
        along = -jnp.log1p((left - 1) * stopped) / medium.sigma_t
        scattered = shares * stopped * (medium.albedo * irradiance)[None]
        # A beam that grazes a convex surface begins and ends on it, and the surface bends over it.
        bend = jnp.where(is_through, jnp.clip(alike, 0, 1), 0.0)
        passed = along / jnp.where(length > 0, length, jnp.inf)
        depth = -along * jnp.sum(directions * normals, axis=0, keepdims=True) * (1 - bend * passed)
        beyond = jnp.maximum(length - along, 0) * exit_cosine
        early = _leaves_early(depth, medium)
        early_beyond = jnp.where(is_through, (1 - bend) * _leaves_early(beyond, medium), 0.0)
        leaving = jnp.sum(early * scattered, axis=0)
        (there,) = to_exits(surface.areas * jnp.sum(early_beyond * scattered, axis=0))
        leaving = leaving + there / jnp.where(surface.areas > 0, surface.areas, 1.0)
        diffuses = (1 - early - early_beyond) * scattered * medium.lasting
        # The others see the plane of beams below each splat.
        unseen = own.plane_integral(depth[None])[0]

        def add(total, plane):
            charges, along = plane
            places = tuple(centers + along[None] * directions)
            return total + surface.potential(own, surface.areas * charges, places), None

        total, _ = jax.lax.scan(
            jax.checkpoint(add), jnp.sum(diffuses * unseen, axis=0), (diffuses, along)
        )
        return total / medium.diffusion_coefficient, leaving

    return jax.lax.map(of_channel, (medium, kernel.kappa, irradiance, directions))


def _leaves_early(
    depth: Float[Array, "*places"], medium: DiffusionCoefficients
) -> Float[Array, "*places"]:
    """Compute the fraction of light first scattered at a depth, mm, that leaves before it diffuses.
    Deep below an isotropic source, its light is proportional to `tau + q(tau)`, and that of
    diffusion to `tau + q(inf)`. With absorption the Bond albedo of a half space is right.
    """
    loss, tau = 1 - medium.albedo, depth * medium.sigma_t
    # Fitted to Chandrasekhar's H for albedos from 0.6 to 0.9995, eta 1.
    held = 1 + loss * (13.76 + 25.38 * loss - 24.39 * jnp.sqrt(jnp.maximum(loss, 1e-12)))
    (a, b), (c, d) = _HOPF
    short = a * jnp.exp(-b * tau) + c * jnp.exp(-d * tau)
    return held * short / (tau + medium.z_e * medium.sigma_t)
