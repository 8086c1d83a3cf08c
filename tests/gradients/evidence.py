"""What a person wants to see when a gradient is wrong: derivative pictures, one above the other."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.image import imsave
from worlds import PLAIN, World, named, with_leaf

import splatjax as sj

ENLARGED = 8
FOLDER = Path("out/gradients")


def write_evidence(title: str, world: World, name: str, way: jax.Array, step: float) -> Path:
    """Write the picture, its derivative along `way` by differences, that of the plain path in
    forward mode, and their difference.

    **Returns:** the path of a PNG; derivatives are red where positive, blue where negative, all in
    one scale.
    """
    plan = sj.make_plan(world.scene, world.camera, PLAIN)

    @jax.jit
    def beauty(leaf):
        moved = with_leaf(world, name, leaf)
        return jnp.mean(sj.render(moved.scene, moved.camera, PLAIN, plan).beauty, axis=-1)

    leaf = named(world)[name]
    difference = (beauty(leaf + step * way) - beauty(leaf - step * way)) / (2 * step)
    derivative = jax.jit(partial(jax.jvp, beauty))((leaf,), (way,))[1]
    scale = max(np.abs(difference).max(), np.abs(derivative).max(), np.finfo(float).tiny)
    rows = [each / scale for each in (difference, derivative, derivative - difference)]
    picture = beauty(leaf)
    pixels = np.concatenate([picture / max(picture.max(), np.finfo(float).tiny), *rows])
    pixels = pixels.repeat(ENLARGED, axis=0).repeat(ENLARGED, axis=1)
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{title.replace(' ', '_')}.png"
    imsave(path, pixels, cmap="bwr", vmin=-1, vmax=1)
    return path
