"""Light that enters a body: its path, and single scattering along it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax.scattering import ExactFresnel, Medium

from ._screened import ScreenedKernel
from ._surface_sums import SurfaceSums

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
    - `inward`: fluence over the irradiance of uniform light that enters, in equilibrium.

    **Source:** Case and Zweifel 1967, "Linear Transport Theory".
    """

    sigma_t: Float[Array, "*channels"]
    albedo: Float[Array, "*channels"]
    diffusion_coefficient: Float[Array, "*channels"]
    squared_kappa: Float[Array, "*channels"]
    z_e: Float[Array, "*channels"]
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
        return cls(sigma_t, albedo, diffusion, medium.sigma_a / diffusion, z_e, inward)


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
    u, shares = (jnp.asarray(each / 2, irradiance.dtype) for each in (nodes[0] + 1, nodes[1]))
    sigma_t, albedo = medium.sigma_t[:, None], medium.albedo[:, None]

    def lengths(beam):
        irradiance, directions = beam
        return surface.first_exits(tuple(directions), irradiance > 0)[0]

    length = jax.lax.map(lengths, (irradiance, directions))
    is_through = jnp.isfinite(length)
    stopped = jnp.where(is_through, -jnp.expm1(-sigma_t * jnp.where(is_through, length, 0.0)), 1.0)
    normals, centers = jnp.stack(surface.normals), jnp.stack(surface.centers)
    cosines = -jnp.sum(directions * normals[None], axis=1)

    def at_depth(u, share):
        # The place before which a part u of what a beam scatters is scattered.
        along = -jnp.log1p(-u * stopped) / sigma_t
        scattered = share * stopped * albedo * irradiance
        depth = along * cosines
        early = _leaves_early(depth * sigma_t, medium)
        places = centers[None] + along[:, None] * directions
        # The others see the plane of beams below each splat.
        unseen = scattered * (1 - early) * kernel.plane_integral(depth)
        return early * scattered, (1 - early) * scattered, places, unseen

    leaving, scattered, places, unseen = jax.vmap(at_depth, out_axes=1)(u, shares)

    def of_channel(given):
        kappa, charges, places = given
        own = ScreenedKernel(kappa[None], kernel.length)

        def add(total, plane):
            charges, places = plane
            return total + surface.potential(own, charges, tuple(places)), None

        return jax.lax.scan(jax.checkpoint(add), jnp.zeros_like(surface.areas), (charges, places))[
            0
        ]

    summed = jax.lax.map(of_channel, (kernel.kappa, surface.areas[None, None] * scattered, places))
    total = summed + jnp.sum(unseen, axis=1)
    return total / medium.diffusion_coefficient[:, None], jnp.sum(leaving, axis=1)


def _leaves_early(
    tau: Float[Array, "channels splats"], medium: DiffusionCoefficients
) -> Float[Array, "channels splats"]:
    """Compute the fraction of light first scattered at optical depth `tau` that leaves before it
    diffuses. Deep below an isotropic source, its light is proportional to `tau + q(tau)`, and that
    of diffusion to `tau + q(inf)`. With absorption the fraction is reduced, so that the Bond albedo
    of a half space is right.
    """
    lost = jnp.sqrt(jnp.maximum(1 - medium.albedo, 1e-12))
    # Fitted to Chandrasekhar's H for albedos from 0.6 to 0.9999, eta 1.
    held = 1 - lost * (6.38 - lost * (18.23 - lost * (26.29 - lost * 21.05)))
    (a, b), (c, d) = _HOPF
    short = a * jnp.exp(-b * tau) + c * jnp.exp(-d * tau)
    return held[:, None] * short / (tau + (medium.z_e * medium.sigma_t)[:, None])
