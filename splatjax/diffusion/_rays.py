"""Light along rays through a body: single scattering of the beams that enter, and radiance that
leaves towards an eye.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from splatjax._chunking import split_rows, stack_rows
from splatjax._smooth import mean_decay
from splatjax.scattering import reflectance
from splatjax.scene import Material

from ._coefficients import DiffusionCoefficients
from ._diffuser import Beams
from ._screened_kernel import ScreenedKernel, integrate
from ._surface_sums import GRAZING, SurfaceSums, dot

_DEPTHS = 6  # quadrature nodes along each beam
# Hopf's q(tau) = q(inf) - sum_i a_i exp(-b_i tau), within 0.0024.
_HOPF = (0.08948, 2.11533), (0.04361, 16.63774)
_COSINES = 8  # quadrature nodes of the mean over the hemisphere
_BRIGHTEST = 2.0  # largest radiance relative to a surface that radiates evenly
_LONGEST = 60.0  # largest ray length used, mean free paths
_ENDLESS = 1e9  # mm: the length of a ray without an end


def scattered_once(
    surface: SurfaceSums, medium: DiffusionCoefficients, kernel: ScreenedKernel, beams: Beams
) -> tuple[Float[Array, "channels splats"], Float[Array, "channels splats"]]:
    """Integrate the single scattering of the beams: `(1 / D) int G Q dV` at every splat, and the
    light that leaves before it diffuses.

    **Arguments:**

    - `kernel`: softened less than on the surface, since the beams decay faster.
    """
    nodes = np.polynomial.legendre.leggauss(_DEPTHS)
    # Denser towards the end of the beam: light scattered there crosses thick parts.
    left = (1 - nodes[0]) / 2
    shares, left = (
        jnp.asarray(x, beams.irradiance.dtype)[:, None] for x in (nodes[1] * left, left**2)
    )
    centers, normals = surface.centers, surface.normals
    same = jnp.all(beams.directions[:, None] == beams.directions[None], axis=(2, 3))
    first_of = jnp.argmax(same, axis=0)  # the first channel with the directions of each channel
    channels, starts = jnp.arange(len(first_of)), jnp.any(beams.irradiance > 0, axis=0)

    def exits(rows):
        all_rows = jnp.concatenate([rows, normals])

        def follow(directions):
            length, cosine, ends = surface.first_exits(directions, starts, all_rows)
            return jnp.stack([*ends[: len(rows)], length, cosine, dot(ends[len(rows) :], normals)])

        def of_channel(channel):
            directions, is_first = channel
            return jax.lax.cond(is_first, follow, lambda _: jnp.zeros_like(all_rows), directions)

        ends = jax.lax.map(of_channel, (beams.directions, first_of == channels))[first_of]
        return ends[channels, channels], ends[:, len(rows) :]

    # The transpose of reading at the exits: it adds power to the splats of the exits.
    _, to_exits, ends = jax.vjp(exits, jnp.zeros_like(beams.irradiance), has_aux=True)

    def of_channel(channel):
        medium, kappa, irradiance, directions, ends = channel
        channel_kernel = ScreenedKernel(kappa[None], kernel.length)
        length, exit_cosine, alike = (row[None] for row in ends)
        is_through = jnp.isfinite(length)
        length = jnp.where(is_through, length, 0.0)
        stopped = jnp.where(is_through, -jnp.expm1(-medium.sigma_t * length), 1.0)
        # Distances along the beam beyond which the fractions `left` of its scattering take place.
        along = -jnp.log1p((left - 1) * stopped) / medium.sigma_t
        scattered = shares * stopped * (medium.albedo * irradiance)[None]
        # A beam that grazes a convex surface begins and ends on it, and the surface bends over it.
        bend = jnp.where(is_through, jnp.clip(alike, 0, 1), 0.0)
        passed = along / jnp.where(length > 0, length, jnp.inf)
        depth = -along * jnp.sum(directions * normals, axis=0, keepdims=True) * (1 - bend * passed)
        beyond = jnp.maximum(length - along, 0) * exit_cosine
        early = _leaves_early(depth, medium)
        early_beyond = jnp.where(is_through, (1 - bend) * _leaves_early(beyond, medium), 0.0)
        leaving, emerging = (jnp.sum(part * scattered, axis=0) for part in (early, early_beyond))
        diffuses = (1 - early - early_beyond) * scattered * medium.lasting
        # What softening removes: the near part of the plane of beams below each splat.
        unseen = channel_kernel.plane_integral(depth[None])[0]

        def add(total, plane):
            charges, along = plane
            places = centers + along[None] * directions
            return total + surface.potential(channel_kernel, surface.areas * charges, places), None

        total, _ = jax.lax.scan(
            jax.checkpoint(add), jnp.sum(diffuses * unseen, axis=0), (diffuses, along)
        )
        return total / medium.diffusion_coefficient, leaving, surface.areas * emerging

    source, leaving, power = jax.lax.map(
        of_channel, (medium, kernel.kappa, beams.irradiance, beams.directions, ends)
    )
    (emerging,) = to_exits(power)
    return source, leaving + emerging / jnp.where(surface.areas > 0, surface.areas, 1.0)[None]


def _leaves_early(
    depth: Float[Array, "*places"], medium: DiffusionCoefficients
) -> Float[Array, "*places"]:
    """Compute the fraction of light first scattered at a depth, mm, that leaves before it diffuses.
    Far below an isotropic source the fluence is proportional to `tau + q(tau)`, and its diffusing
    part to `tau + q(inf)`. With absorption the Bond albedo of a half space is right.
    """
    loss, tau = 1 - medium.albedo, depth * medium.sigma_t
    # Fitted to Chandrasekhar's H for albedos from 0.6 to 0.9995, eta 1.
    held = 1 + loss * (13.76 + 25.38 * loss - 24.39 * jnp.sqrt(jnp.maximum(loss, 1e-12)))
    (a, b), (c, d) = _HOPF
    short = a * jnp.exp(-b * tau) + c * jnp.exp(-d * tau)
    return held * short / (tau + medium.z_e * medium.sigma_t)


class SurfaceLight(eqx.Module):
    """Light at the surface, where rays through the body begin or end.

    **Attributes:**

    - `fluence`: fluence times `D / z_e`.
    - `flux`: net outward flux.
    - `irradiance`, `entering`: irradiance of the entering beam, and its cosine inside; 0 without.
    - `direction`: direction of the beam, averaged over the channels.
    """

    fluence: Float[Array, "channels splats"]
    flux: Float[Array, "channels splats"]
    irradiance: Float[Array, "channels splats"]
    entering: Float[Array, "channels splats"]
    direction: Float[Array, "3 splats"]


class SolvedLight(eqx.Module):
    """The light of a body, which does not depend on the eye.

    **Attributes:** along the splats

    - `exitance`: radiant exitance.
    - `slopes`: slopes of the radiant exitance along the surface, 1/mm.
    - `surface`: the light at the surface.
    - `mean`: the mean of `source_integral` over the hemisphere, by its cosine.
    """

    exitance: Float[Array, "channels splats"]
    slopes: Float[Array, "channels 3 splats"]
    surface: SurfaceLight
    mean: Float[Array, "channels splats"]

    @classmethod
    def of(
        cls,
        surface: SurfaceSums,
        material: Material,
        exitance: Float[Array, "channels splats"],
        beams: Beams,
        bounced: Float[Array, "channels splats"] | None,
    ) -> "SolvedLight":
        """Gather the light of a body whose radiant exitance is known.

        **Arguments:** as for `AbstractDiffusionPlan.light`, padded.
        """
        coefficients = DiffusionCoefficients.of(material.medium)
        normals, directions = surface.normals, beams.directions
        fluence = flux = exitance
        if bounced is not None:
            balance = coefficients.diffusion_coefficient / coefficients.z_e * coefficients.inward
            fluence, flux = fluence + (balance - 1)[:, None] * bounced, flux - bounced
        entering = jnp.maximum(-jnp.sum(directions * normals[None], axis=1), 0)
        lit = jnp.sum(jnp.any(directions != 0, axis=1), axis=0).astype(directions.dtype)
        direction = jnp.sum(directions, axis=0) / jnp.maximum(lit, 1)[None]  # of the lit channels
        light = SurfaceLight(fluence, flux, beams.irradiance, entering, direction)
        far, _, thickness = at_exits(light, surface, -normals, surface.areas > 0)

        def towards(cosine):
            mu = _inside(jnp.full_like(thickness, cosine), material.eta)
            reflected = _internal_reflectance(mu, material.eta)
            gathered = source_integral(light, far, mu, mu, thickness / mu, reflected, coefficients)
            return 2 * cosine * gathered

        mean = integrate(towards, _COSINES, exitance)
        return cls(exitance, surface.slopes(exitance), light, mean)


def at_exits(
    light: PyTree[Array],
    surface: SurfaceSums,
    way: Float[Array, "3 splats"],
    starts: Bool[Array, " splats"],
):
    """Follow rays into the body: return the light at their ends, 0 for a ray without an end; the
    cosine of the exit; and the length of the ray, mm, finite for its derivative.
    """
    length, cosine, rows = surface.first_exits(way, starts, stack_rows(light))
    ends = jnp.isfinite(length)
    light = split_rows(jnp.where(ends[None], rows, 0.0), light)
    return light, jnp.where(ends, cosine, 1.0), jnp.where(ends, length, _ENDLESS)


def radiance_towards(
    eye: Float[Array, "3"],
    surface: SurfaceSums,
    material: Material,
    light: SolvedLight,
    seen: Bool[Array, " splats"],
) -> Float[Array, "channels splats"]:
    r"""Compute `pi` times the radiance of `seen` splats towards an eye, without the Fresnel loss:
    the source integral along the refracted ray `w` up to its exit from the body, over its mean,

        L = f M / pi + sigma_s' / (4 pi sigma_t'^2) [w . grad phi]

    with the slopes along the surface at the near end, less those at the far end times `(1 - F)
    exp(-sigma_t' s)`: seen from the lit side a splat is darker than M, and from the dark side
    brighter, by half beyond the terminator of a sphere.
    """
    coefficients = DiffusionCoefficients.of(material.medium)
    normals, eta = surface.normals, material.eta
    to_eye = eye[:, None] - surface.centers
    # Padding is at the origin, where an eye may be.
    squared = jnp.where(surface.areas > 0, dot(to_eye, to_eye), 1.0)
    to_eye = to_eye / jnp.sqrt(squared)[None]
    cosine = jnp.maximum(dot(to_eye, normals), GRAZING)
    along = (to_eye - cosine[None] * normals) / eta
    mu = _inside(cosine, eta)
    way = -(along + mu[None] * normals)
    near = light.surface, light.slopes
    (far, far_slopes), far_mu, length = at_exits(near, surface, way, seen)
    reflected = _internal_reflectance(far_mu, eta)
    gathered = source_integral(light.surface, far, mu, far_mu, length, reflected, coefficients)
    shape = gathered / jnp.where(light.mean > 0, light.mean, 1.0)
    shape = jnp.where(light.mean > 0, jnp.clip(shape, 0, _BRIGHTEST), 1.0)
    optical = jnp.minimum(length[None] * coefficients.sigma_t[:, None], _LONGEST)
    slope, far_slope = (jnp.sum(rows * way[None], axis=1) for rows in (light.slopes, far_slopes))
    spread = 4 * coefficients.diffusion_coefficient * coefficients.sigma_t
    depth = (coefficients.albedo * coefficients.z_e / spread)[:, None]
    sideways = depth * (slope - (1 - reflected)[None] * jnp.exp(-optical) * far_slope)
    return jnp.maximum(light.exitance * shape + sideways, 0)


def source_integral(
    near: SurfaceLight,
    far: SurfaceLight,
    mu: Float[Array, " splats"],
    far_mu: Float[Array, " splats"],
    length: Float[Array, " splats"],
    reflected: Float[Array, " splats"],
    medium: DiffusionCoefficients,
) -> Float[Array, "channels splats"]:
    r"""Integrate the light scattered towards the near end of a ray, `pi` times the radiance,

        (1 / 4) int (sigma_s' phi + Q) exp(-sigma_t' s) ds

    If the faces at its ends are parallel, `phi` fulfills the diffusion equation in between, and
    integration by parts gives the integral in closed form by its values and slopes at the ends, and
    `Q`. Within a mean free path of a surface the fluence is smaller, by the difference of Hopf's
    function from its limit; around `Q` it is larger by `excess`, at a surface by half of it. Light
    that the far end reflects is treated as light from a thick body behind it.

    **Arguments:**

    - `near`, `far`: light at the ends.
    - `mu`, `far_mu`: cosines of the ray inside, there.
    - `length`: of the ray, mm.
    - `reflected`: internal reflectance at the far end.
    """
    albedo, z_e = medium.albedo[:, None], (medium.z_e * medium.sigma_t)[:, None]
    mu, far_mu, length, reflected = mu[None], far_mu[None], length[None], reflected[None]
    s = jnp.minimum(length * medium.sigma_t[:, None], _LONGEST)
    spread = (medium.diffusion_coefficient * medium.sigma_t)[:, None]
    bend = (1 - albedo) / spread * mu * mu  # below 1: a solution decays slower than a beam
    at_near = z_e * near.fluence + mu * near.flux
    at_far = (1 - reflected) * z_e * far.fluence - (1 + reflected) * far_mu * far.flux
    diffused = (at_near - jnp.exp(-s) * at_far) / (1 - bend)

    def along_end(rate, part):
        exponent = (1 - rate) * part
        decay = mean_decay(jnp.abs(exponent)) * jnp.exp(jnp.maximum(exponent, 0) - s)
        return part * decay

    for a, b in _HOPF:
        along_start = -jnp.expm1(-s * (1 + b * mu)) / (1 + b * mu)
        diffused -= a * (near.flux * along_start + far.flux * along_end(b * far_mu, s))
    # A beam that enters at one end decays towards the other, at these rates along the ray.
    entering, far_entering = (jnp.maximum(x.entering, GRAZING) for x in (near, far))
    rate, far_rate = mu / entering, far_mu / far_entering
    # Light of one direction reaches each point of the ray through one end: along the shorter path.
    alike = jnp.clip(jnp.sum(near.direction * far.direction, axis=0), 0, 1)
    alike = jnp.where((near.entering > 0) & (far.entering > 0), alike, 0.0)
    cut = s * far_rate / (rate + far_rate)
    near_part, far_part = s - alike * (s - cut), s - alike * cut
    beams = near.irradiance / (entering + mu) * -jnp.expm1(-near_part * (1 + rate))
    beams += far.irradiance / far_entering * along_end(far_rate, far_part)
    scattered_again = 0.5 * albedo * medium.excess[:, None] - albedo / spread * mu * mu / (1 - bend)
    return albedo * (diffused / spread + beams * (1 + scattered_again))


def _inside(cosine: Float[Array, " splats"], eta: Float[Array, ""]) -> Float[Array, " splats"]:
    """Compute the cosine of a refracted ray."""
    sine = (1 - cosine * cosine) / (eta * eta)
    return jnp.sqrt(jnp.maximum(1 - sine, GRAZING * GRAZING))


def _internal_reflectance(
    inside: Float[Array, " splats"], eta: Float[Array, ""]
) -> Float[Array, " splats"]:
    """Compute the reflectance of the surface for light that arrives at a cosine inside."""
    squared = 1 - (1 - inside * inside) * (eta * eta)
    is_partial = squared > GRAZING * GRAZING
    outside = jnp.sqrt(jnp.where(is_partial, squared, 1.0))
    ratio = jnp.broadcast_to(eta, inside.shape)
    return jnp.where(is_partial, reflectance(inside, outside, ratio), 1.0)
