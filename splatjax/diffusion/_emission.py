"""Light that leaves a body towards an eye, of the diffusion equation on its surface."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax.scene import Material, Splats

from ._beams import DiffusionCoefficients
from ._diffuser import Beams
from ._surface_sums import GRAZING

_COSINES = 8  # over which a law of angles is averaged
_BRIGHTEST = 2.0  # times an even surface


def radiance_towards(
    eye: Float[Array, "3"],
    splats: Splats,
    material: Material,
    exitance: Float[Array, "channels splats"],
    slopes: Float[Array, "channels 3 splats"],
    beams: Beams,
) -> Float[Array, "channels splats"]:
    r"""Compute `pi` times the radiance of splats towards an eye, but for Fresnel's loss: the source
    integral along the refracted ray `w`, with the fluence `phi = z_e M / D` on the surface,

        L = int (sigma_s' phi + Q) / (4 pi) exp(-sigma_t' s) ds
          = f M / pi - sigma_s' / (4 pi sigma_t'^2) w . grad phi

    - `f` is that of a half-space with this `phi` and these beams, over its mean.
    - Along the surface `phi` is a line: what is seen from the lit side is darker than M, what is
      seen from the dark side brighter, by half beyond the terminator of a sphere.

    **Arguments:**

    - `exitance`: M.
    - `slopes`: of M along the surface, 1/mm.
    """
    normals, medium = splats.normals.T, DiffusionCoefficients.of(_medium(material))
    to_eye = eye[:, None] - splats.centers.T
    to_eye = to_eye / jnp.sqrt(jnp.sum(to_eye * to_eye, axis=0, keepdims=True))
    cosine = jnp.maximum(jnp.sum(to_eye * normals, axis=0), GRAZING)
    albedo, z_e = medium.albedo[:, None], medium.z_e[:, None]
    # Depths are optical. The beams' own part of phi is start entering exp(-depth / entering), and
    # the rest a line that absorption bends.
    entering = jnp.maximum(-jnp.sum(beams.directions * normals[None], axis=1), 0)
    bend = 3 * (1 - albedo)
    bend = bend / (1 + bend)  # below 1 for every albedo
    start = -3 * albedo * beams.irradiance / (1 - bend * entering * entering)
    level = 3 * z_e * medium.sigma_t[:, None] * exitance - start * entering
    rise = 3 * exitance + start

    def radiance(cosine):
        sine = (1 - cosine * cosine) / (material.eta * material.eta)
        mu = jnp.sqrt(jnp.maximum(1 - sine, GRAZING * GRAZING))
        beam = albedo * (start * entering * entering + beams.irradiance) / (entering + mu)
        return albedo * (level + rise * mu) / (1 - bend * mu * mu) + beam

    nodes, weights = (each.tolist() for each in np.polynomial.legendre.leggauss(_COSINES))
    mean = jnp.zeros_like(exitance)
    for node, weight in zip(nodes, weights, strict=True):
        c = (node + 1) / 2
        mean = mean + weight * c * radiance(jnp.full_like(cosine, c)[None])
    shape = radiance(cosine[None]) / jnp.where(mean > 0, mean, 1.0)
    shape = jnp.where(mean > 0, jnp.clip(shape, 0, _BRIGHTEST), 1.0)
    along = (to_eye - cosine[None] * normals) / material.eta
    sideways = 0.75 * albedo * z_e * jnp.sum(slopes * along[None], axis=1)
    return jnp.maximum(exitance * shape - sideways, 0)


def _medium(material: Material):
    assert material.medium is not None
    return material.medium
