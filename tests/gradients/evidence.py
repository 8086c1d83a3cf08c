"""What a person wants to see when a gradient is wrong: derivative pictures, one above the other."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
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
    picture = np.asarray(beauty(leaf))
    difference = np.asarray(beauty(leaf + step * way) - beauty(leaf - step * way)) / (2 * step)
    derivative = np.asarray(jax.jit(partial(jax.jvp, beauty))((leaf,), (way,))[1])
    scale = max(np.abs(difference).max(), np.abs(derivative).max(), np.finfo(float).tiny)
    # Wide layers, continued to faint pixels of a dark rim, may be a little below zero.
    gray = np.maximum(picture, 0) / max(picture.max(), np.finfo(float).tiny)
    gray = np.repeat(gray[..., None], 3, axis=-1) ** 0.45
    rows = [
        gray,
        *(signed(each / scale) for each in (difference, derivative, derivative - difference)),
    ]
    pixels = (255 * np.clip(np.concatenate(rows), 0, 1)).astype(np.uint8)
    FOLDER.mkdir(parents=True, exist_ok=True)
    path = FOLDER / f"{title.replace(' ', '_')}.png"
    Image.fromarray(pixels).resize(
        (ENLARGED * pixels.shape[1], ENLARGED * pixels.shape[0]), Image.Resampling.NEAREST
    ).save(path)
    return path


def signed(values: np.ndarray) -> np.ndarray:
    """Color values in [-1, 1]: white for none, red above, blue below."""
    above, below = np.maximum(values, 0), np.maximum(-values, 0)
    return np.stack([1 - below, 1 - above - below, 1 - above], axis=-1)
