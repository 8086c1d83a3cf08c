"""Layers narrower than the splats are handed over to the surface itself."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.scene import Splats

from ._settings import DiffusionSettings

PLACES = 64
"""Splats that are asked how evenly all are spread."""


@eqx.filter_jit
def irregularity(splats: Splats) -> Float[Array, ""]:
    r"""Give how unevenly the splats are spread: 0 on a regular grid, about 0.5 at random.

    It is the relative standard deviation of the distance to the nearest splat over the root of the
    area, on 64 splats. A number of the geometry's; not differentiated.
    """
    if splats.count < 2:
        return jnp.zeros((), splats.centers.dtype)
    places = jnp.linspace(0, splats.count - 1, min(PLACES, splats.count)).astype(jnp.int32)
    centers = stop_gradient(splats.centers).T

    def nearest(place):
        offset = centers - centers[:, place][:, None]
        squared = jnp.sum(offset * offset, axis=0).at[place].set(jnp.inf)
        return jnp.sqrt(jnp.min(squared) / stop_gradient(splats.areas[place]))

    distance = jax.lax.map(nearest, places)
    return jnp.std(distance) / jnp.maximum(jnp.mean(distance), jnp.finfo(distance.dtype).tiny)


def handover_interval(
    unevenness: Float[Array, ""], settings: DiffusionSettings
) -> Float[Array, "2"]:
    """Give standard deviations per spacing between which a layer passes from the surface to the
    diffusion integral.
    """
    scattered = jnp.clip(unevenness / 0.05, 0, 1)
    regular = jnp.asarray(settings.regular, unevenness.dtype)
    return regular + scattered * (jnp.asarray(settings.scattered, unevenness.dtype) - regular)


def resolved_share(
    variance: Float[Array, "..."], area: Float[Array, "..."], interval: Float[Array, "2"]
) -> Float[Array, "..."]:
    """Give how much of a layer is the diffusion integral: a smooth step of variance over area per
    splat.
    """
    begin, end = interval[0] ** 2, interval[1] ** 2
    t = jnp.clip((variance / area - begin) / (end - begin), 0, 1)
    return t * t * (3 - 2 * t)
