"""Light that enters a body: its way through, and what it scatters once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatjax._chunking import map_chunks
from splatjax.scattering import ExactFresnel, Medium
from splatjax.scene import Splats

from ._screened import ScreenedKernel

AT_ONCE = 64  # points
GRAZING = 1e-3  # cosine
_DEPTHS = 8  # along each beam
_OVERLAP = 1.5  # radius of a splat over the root of its area
_MILNE = 0.710446  # extrapolation distance of the Milne problem, mean free paths
# Hopf's q(tau) = _MILNE - sum_i a_i exp(-b_i tau), within 0.0024.
_HOPF = (0.08948, 2.11533), (0.04361, 16.63774)


class Beams(eqx.Module):
    """Light that enters a body, one beam for each splat: of many lights their sum, with the mean
    of their directions.

    **Attributes:** (differentiable)

    - `irradiance`: that enters, after the loss at the surface.
    - `directions`: in which it travels inside, by which the place of its first scattering moves
      per mean free path: unit for one light, shorter for several.
    """

    irradiance: Float[Array, "channels splats"]
    directions: Float[Array, "channels 3 splats"]


class DiffusionCoefficients(eqx.Module):
    """Of the diffusion equation and its boundary, one for each channel.

    **Attributes:**

    - `sigma_t`: reduced extinction coefficient, 1/mm.
    - `albedo`: reduced.
    - `squared_kappa`: of the effective transport coefficient, 1/mm^2.
    - `z_e`: extrapolation distance, mm.
    """

    sigma_t: Float[Array, "*channels"]
    albedo: Float[Array, "*channels"]
    squared_kappa: Float[Array, "*channels"]
    z_e: Float[Array, "*channels"]

    @classmethod
    def of(cls, medium: Medium) -> "DiffusionCoefficients":
        fresnel, sigma_t = ExactFresnel(), medium.sigma_t_prime
        boundary = (1 + fresnel.second_moment(medium.eta)) / (1 - fresnel.first_moment(medium.eta))
        z_e = _MILNE * boundary / sigma_t
        return cls(sigma_t, medium.albedo_prime, medium.squared_sigma_tr, z_e)

    @property
    def diffusion_coefficient(self):
        """`D`, mm."""
        return 1 / (3 * self.sigma_t)


def offsets(x: Float[Array, "points 3"], y: Float[Array, "splats 3"]) -> list:
    """Compute the components of `y - x` of all pairs, each a plane."""
    return [y[None, :, axis] - x[:, None, axis] for axis in range(3)]


def dot(one, other):
    """Multiply vectors whose components are planes."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def scattered_once(
    splats: Splats,
    medium: DiffusionCoefficients,
    kernel: ScreenedKernel,
    irradiance: Float[Array, " splats"],
    directions: Float[Array, "splats 3"],
) -> tuple[Float[Array, " splats"], Float[Array, " splats"]]:
    """Integrate what the beams of one channel scatter once: `(1 / D) int G Q dV` at every splat,
    and the light that leaves before it diffuses.

    **Arguments:**

    - `kernel`: sums narrower Gaussians than on the surface, since the beams get dark faster.
    """
    nodes = np.polynomial.legendre.leggauss(_DEPTHS)
    u, shares = (jnp.asarray(each / 2, irradiance.dtype) for each in (nodes[0] + 1, nodes[1]))
    length = beam_lengths(splats, directions, irradiance > 0)
    stopped = -jnp.expm1(-medium.sigma_t * length)

    def at_depth(u, share):
        # The place before which a part u of what a beam scatters is scattered.
        along = -jnp.log1p(-u * stopped) / medium.sigma_t
        scattered = share * stopped * medium.albedo * irradiance
        depth = -along * jnp.sum(directions * splats.normals, axis=-1)
        early = _leaves_early(depth * medium.sigma_t, medium)
        place = splats.centers + along[:, None] * directions
        unseen = kernel.plane_integral(depth)  # by Gaussians too narrow to be summed
        return early * scattered, (1 - early) * scattered, place, unseen

    leaving, scattered, places, unseen = jax.vmap(at_depth)(u, shares)
    strength = splats.areas[None] * scattered

    def at(x):
        def add(total, plane):
            places, strength = plane
            offset = offsets(x, places)
            return total + kernel(dot(offset, offset))[0] @ strength, None

        return jax.lax.scan(jax.checkpoint(add), jnp.zeros_like(x[:, 0]), (places, strength))[0]

    summed = map_chunks(at, splats.centers, at_once=AT_ONCE)
    # The others see the plane of beams below each splat.
    total = summed + jnp.sum(scattered * unseen, axis=0)
    return total / medium.diffusion_coefficient, jnp.sum(leaving, axis=0)


def _leaves_early(
    tau: Float[Array, "*points"], medium: DiffusionCoefficients
) -> Float[Array, "*points"]:
    """Compute the fraction of light first scattered at optical depth `tau` that leaves before it
    diffuses: seen from deep below, an isotropic source shines as `tau + q(tau)`, and diffuses as
    `tau + q(inf)`. Where light is absorbed, less, so that the Bond albedo of a half-space is right.
    """
    lost = jnp.sqrt(jnp.maximum(1 - medium.albedo, 1e-12))
    # Fitted to Chandrasekhar's H for albedos from 0.6 to 0.9999, eta 1.
    held = 1 - 6 * lost / (1 + 1.4 * lost + 2.6 * lost * lost)
    (a, b), (c, d) = _HOPF
    short = a * jnp.exp(-b * tau) + c * jnp.exp(-d * tau)
    return held * short / (tau + medium.z_e * medium.sigma_t)


def beam_lengths(
    splats: Splats, directions: Float[Array, "splats 3"], is_lit: Bool[Array, " splats"]
) -> Float[Array, " splats"]:
    """Compute how far each beam goes from its splat to the first one that it leaves the body by,
    in lengths of its direction; 0 where there is none. Which splat that is, is discontinuous.
    """
    squared_radii = _OVERLAP**2 * splats.areas

    def at(beams):
        start, way = beams
        way = [way[:, None, axis] for axis in range(3)]
        normals = [splats.normals[None, :, axis] for axis in range(3)]
        offset, cosine = offsets(start, splats.centers), dot(way, normals)
        outward = cosine > GRAZING
        t = dot(offset, normals) / jnp.where(outward, cosine, 1.0)
        miss = [offset[axis] - t * way[axis] for axis in range(3)]
        missed = dot(miss, miss)
        hit = outward & (t > 0) & (missed < squared_radii[None])
        first = jnp.min(jnp.where(hit, t, jnp.inf), axis=1, keepdims=True)
        # Blend the splats that lie there.
        near = hit & (t < first + jnp.sqrt(splats.areas)[None])
        exponent = jnp.where(near, 2 * missed / jnp.where(near, splats.areas[None], 1.0), 0.0)
        weight = jnp.where(near, jnp.exp(-exponent), 0.0)
        total = jnp.sum(weight, axis=1)
        return jnp.sum(weight * t, axis=1) / jnp.where(total > 0, total, 1.0)

    lengths = map_chunks(at, (splats.centers, directions), at_once=AT_ONCE)
    return jnp.where(is_lit, lengths, 0.0)
