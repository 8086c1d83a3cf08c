"""Light that leaves a body towards an eye, of the diffusion equation on its surface."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax.scene import Material

from ._beams import DiffusionCoefficients
from ._diffuser import Beams
from ._hierarchy import Planes
from ._surface_sums import GRAZING, SurfaceSums, dot

_COSINES = 8  # over which a law of angles is averaged
_BRIGHTEST = 2.0  # times an even surface
_LONGEST = 60.0  # ray, mean free paths
_ENDLESS = 1e9  # mm: the length of a ray without an end
_SMALL = 1e-3  # exponent


class SurfaceLight(eqx.Module):
    """Light at the surface, where rays through the body begin or end.

    **Attributes:**

    - `fluence`: times `D / z_e`.
    - `flux`: net, outward.
    - `irradiance`: of the beam that enters, and `entering`, the cosine of it inside: 0 without one.
    - `direction`: of the beam, mean over the channels.
    """

    fluence: Float[Array, "channels splats"]
    flux: Float[Array, "channels splats"]
    irradiance: Float[Array, "channels splats"]
    entering: Float[Array, "channels splats"]
    direction: Float[Array, "3 splats"]

    def at_exits(self, surface: SurfaceSums, way: Planes):
        """Follow rays into the body: return the light at their ends, none where they do not end,
        the cosine of the exit, and the length of the ray, mm, finite for its derivative.
        """
        parts = self.fluence, self.flux, self.irradiance, self.entering, self.direction
        length, cosine, read = surface.first_exits(
            way, surface.areas > 0, [row for part in parts for row in part]
        )
        ends = jnp.isfinite(length)
        read = jnp.where(ends, jnp.stack(read), 0.0)
        rows = jnp.split(read, np.cumsum([len(part) for part in parts])[:-1])
        return (
            SurfaceLight(*rows),
            jnp.where(ends, cosine, 1.0),
            jnp.where(ends, length, _ENDLESS),
        )


class SolvedLight(eqx.Module):
    """The light of a body, which does not depend on the eye.

    **Attributes:** along the splats

    - `exitance`: radiant exitance.
    - `slopes`: of it along the surface, 1/mm.
    - `surface`: the light there.
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
        exitance: Float[Array, "channels filled_up"],
        beams: Beams,
        bounced: Float[Array, "channels splats"] | None,
    ) -> "SolvedLight":
        """Gather the light of a body whose radiant exitance is known.

        **Arguments:** as for `AbstractDiffusionPlan.light`.
        """
        coefficients, normals = _coefficients(material), jnp.stack(surface.normals)
        more = (0, exitance.shape[1] - beams.irradiance.shape[1])
        directions = jnp.pad(beams.directions, ((0, 0), (0, 0), more))
        fluence = flux = exitance
        if bounced is not None:
            even = jnp.pad(bounced, ((0, 0), more))
            balance = coefficients.diffusion_coefficient / coefficients.z_e * coefficients.inward
            fluence, flux = fluence + (balance - 1)[:, None] * even, flux - even
        light = SurfaceLight(
            fluence,
            flux,
            jnp.pad(beams.irradiance, ((0, 0), more)),
            jnp.maximum(-jnp.sum(directions * normals[None], axis=1), 0),
            jnp.mean(directions, axis=0),
        )
        far, _, thickness = light.at_exits(surface, tuple(-normals))
        nodes, weights = (each.tolist() for each in np.polynomial.legendre.leggauss(_COSINES))
        mean = jnp.zeros_like(exitance)
        for node, weight in zip(nodes, weights, strict=True):
            cosine = (node + 1) / 2
            mu = _inside(jnp.full_like(thickness, cosine), material.eta)
            seen = source_integral(light, far, mu, mu, thickness / mu, coefficients)
            mean = mean + weight * cosine * seen
        return cls(exitance, surface.slopes(exitance), light, mean)


def radiance_towards(
    eye: Float[Array, "3"], surface: SurfaceSums, material: Material, light: SolvedLight
) -> Float[Array, "channels splats"]:
    r"""Compute `pi` times the radiance of splats towards an eye, without the Fresnel loss: the
    source integral along the refracted ray `w` up to its exit from the body, over its mean,

        L = f M / pi - sigma_s' / (4 pi sigma_t'^2) w . grad phi

    Along the surface `phi` is linear: seen from the lit side a splat is darker than M, and from the
    dark side brighter, by half beyond the terminator of a sphere.
    """
    coefficients, normals, eta = _coefficients(material), surface.normals, material.eta
    to_eye = [e - c for e, c in zip(eye, surface.centers, strict=True)]
    # Padding is at the origin, where an eye may be.
    squared = jnp.where(surface.areas > 0, dot(to_eye, to_eye), 1.0)
    to_eye = [axis / jnp.sqrt(squared) for axis in to_eye]
    cosine = jnp.maximum(dot(to_eye, normals), GRAZING)
    along = [(e - cosine * n) / eta for e, n in zip(to_eye, normals, strict=True)]
    mu = _inside(cosine, eta)
    way = tuple(-(a + mu * n) for a, n in zip(along, normals, strict=True))
    far, far_mu, length = light.surface.at_exits(surface, way)
    seen = source_integral(light.surface, far, mu, far_mu, length, coefficients)
    shape = seen / jnp.where(light.mean > 0, light.mean, 1.0)
    shape = jnp.where(light.mean > 0, jnp.clip(shape, 0, _BRIGHTEST), 1.0)
    optical = jnp.minimum(length[None] * coefficients.sigma_t[:, None], _LONGEST)
    slope = jnp.sum(light.slopes * jnp.stack(along)[None], axis=1)
    spread = 4 * coefficients.diffusion_coefficient * coefficients.sigma_t
    depth = (coefficients.albedo * coefficients.z_e / spread)[:, None]
    sideways = depth * slope * (1 - (1 + optical) * jnp.exp(-optical))
    return jnp.maximum(light.exitance * shape - sideways, 0)


def source_integral(
    near: SurfaceLight,
    far: SurfaceLight,
    mu: Float[Array, " splats"],
    far_mu: Float[Array, " splats"],
    length: Float[Array, " splats"],
    medium: DiffusionCoefficients,
) -> Float[Array, "channels splats"]:
    r"""Integrate the light scattered towards the near end of a ray, `pi` times the radiance,

        (1 / 4) int (sigma_s' phi + Q) exp(-sigma_t' s) ds

    If the faces at its ends are parallel, `phi` fulfills the diffusion equation in between, and
    integration by parts gives the integral in closed form by its values and slopes at the ends, and
    `Q`.

    **Arguments:**

    - `near`, `far`: light at the ends.
    - `mu`, `far_mu`: cosines of the ray inside, there.
    - `length`: of the ray, mm.
    """
    albedo, z_e = medium.albedo[:, None], (medium.z_e * medium.sigma_t)[:, None]
    mu, far_mu, length = mu[None], far_mu[None], length[None]
    s = jnp.minimum(length * medium.sigma_t[:, None], _LONGEST)
    spread = (medium.diffusion_coefficient * medium.sigma_t)[:, None]
    bend = (1 - albedo) / spread * mu * mu  # below 1: a solution decays slower than a beam
    at_near, at_far = z_e * near.fluence + mu * near.flux, z_e * far.fluence - far_mu * far.flux
    diffused = albedo / spread * (at_near - jnp.exp(-s) * at_far) / (1 - bend)
    # A beam that enters at one end decays towards the other, at these rates along the ray.
    entering, far_entering = (jnp.maximum(x.entering, GRAZING) for x in (near, far))
    rate, far_rate = mu / entering, far_mu / far_entering
    # Light of one direction reaches every point through one end: the nearer one along it.
    alike = jnp.clip(jnp.sum(near.direction * far.direction, axis=0), 0, 1)
    alike = jnp.where((near.entering > 0) & (far.entering > 0), alike, 0.0)
    cut = s * far_rate / (rate + far_rate)
    near_part, far_part = s - alike * (s - cut), s - alike * cut
    beams = near.irradiance / (entering + mu) * -jnp.expm1(-near_part * (1 + rate))
    exponent = (1 - far_rate) * far_part
    size = jnp.abs(exponent)
    is_small, safe = size < _SMALL, jnp.maximum(size, _SMALL)
    mean = jnp.where(is_small, 1 - 0.5 * size, -jnp.expm1(-safe) / safe)
    mean = mean * jnp.exp(jnp.maximum(exponent, 0) - s)
    beams = beams + far.irradiance / far_entering * far_part * mean
    return diffused + albedo * beams * (1 - albedo / spread * mu * mu / (1 - bend))


def _coefficients(material: Material) -> DiffusionCoefficients:
    assert material.medium is not None
    return DiffusionCoefficients.of(material.medium)


def _inside(cosine: Float[Array, " splats"], eta: Float[Array, ""]) -> Float[Array, " splats"]:
    """Compute the cosine of a refracted ray."""
    sine = (1 - cosine * cosine) / (eta * eta)
    return jnp.sqrt(jnp.maximum(1 - sine, GRAZING * GRAZING))
