"""Whether layers shimmer under a slow turntable: `python -m benchmarks.shimmer`. Writes
out/shimmer.png.

From frame to frame of a tenth of a degree a layer changes. Reported is by how much more or less it
changes in the picture than by the untruncated sums at the points that the pixels see, of the
layer's root mean square.
"""

import argparse
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from PIL import Image

import splatjax as sj
from splatjax import diffusion

from .diffusion_error import layers_of, seen_in_front, untruncated
from .scenes import BODIES, columns, lit

VARIANCES = (4.0, 8.0, 16.0, 32.0)  # mm^2: what splats a millimeter apart carry


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.shimmer", description=__doc__)
    parser.add_argument("--body", choices=BODIES, default="synthetic", help="(default %(default)s)")
    parser.add_argument(
        "--splats", type=int, default=100_000, help="on the prototype's head (default %(default)s)"
    )
    parser.add_argument(
        "--width", type=int, default=256, help="of the square picture, pixels (default %(default)s)"
    )
    parser.add_argument(
        "--steps", type=int, default=4, help="from frame to frame (default %(default)s)"
    )
    parser.add_argument(
        "--degrees", type=float, default=0.1, help="of a step (default %(default)s)"
    )
    return parser.parse_args()


def turned(camera: sj.Camera, middle: np.ndarray, degrees: float) -> sj.Camera:
    """Turn a camera about the vertical through a point."""
    cosine, sine = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.asarray([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    position = turn @ (np.asarray(camera.position) - middle) + middle
    moved = (
        jnp.asarray(position, jnp.float32),
        jnp.asarray(np.asarray(camera.rotation) @ turn.T, jnp.float32),
    )
    return eqx.tree_at(lambda c: (c.position, c.rotation), camera, moved)


def main() -> None:
    options = arguments()
    scene, camera = lit(columns(options.body, options.splats), options.width)
    weights = jnp.full((len(VARIANCES), 3), 1 / len(VARIANCES))
    scene = eqx.tree_at(
        lambda s: s.material, scene, sj.Material(sj.SumOfGaussians(jnp.asarray(VARIANCES), weights))
    )
    middle = np.mean(np.asarray(scene.splats.centers), axis=0)
    cameras = [turned(camera, middle, options.degrees * step) for step in range(options.steps + 1)]
    settings = sj.RenderSettings()
    plan = sj.make_plan(scene, cameras, settings)
    light = sj.illuminate(scene, plan, settings)
    source, splats = sj.compute_irradiance(scene, plan, settings).source, scene.splats
    sources = diffusion.Sources(splats.centers.T, splats.normals.T, splats.areas, source)
    layers = {"fast": [], "exact": []}
    for i, each in enumerate(cameras):
        basis = sj.diffusion_basis(scene, each, settings, plan)
        frame = sj.render(scene, each, settings, plan, light=light)
        front = seen_in_front(basis)
        pixels = np.asarray(basis.pixels)[front]
        exact = untruncated(sources, frame.position.reshape(-1, 3)[pixels].T, basis.light)
        both = layers_of(basis.light, front, scene.material.gaussians, exact)
        for name, found in zip(layers, both, strict=True):
            picture = np.zeros((len(VARIANCES), options.width**2, 3), np.float32)
            picture[:, pixels] = np.moveaxis(found, 1, 2)
            layers[name].append(picture.reshape(-1, options.width, options.width, 3))
        print(f"  frame {i + 1} of {len(cameras)}", flush=True)
    layers = {name: np.stack(pictures) for name, pictures in layers.items()}
    scale = np.sqrt(np.mean(layers["exact"] ** 2, axis=(0, 2, 3), where=layers["exact"] > 0))
    scale = scale[None, :, None, None]
    changes = {name: np.diff(each, axis=0) / scale for name, each in layers.items()}
    more = np.abs(changes["fast"] - changes["exact"]).max(axis=-1)
    covered = layers["exact"][1:].max(axis=(1, 4)) > 0
    print(
        f"{options.degrees:g} degrees, {options.steps} steps; fast frames change so much beyond "
        "the exact ones, of the RMS:"
    )
    for k, variance in enumerate(VARIANCES):
        median, high, largest = (np.quantile(more[:, k][covered], q) for q in (0.5, 0.99, 1.0))
        exact = np.quantile(np.abs(changes["exact"])[:, k].max(axis=-1)[covered], 0.99)
        print(
            f"  {variance**0.5:5.2f} mm: {median:.1e} {high:.1e} {largest:.1e}; the exact change's "
            f"99th percentile {exact:.1e}"
        )
    out = Path("out/shimmer.png")
    out.parent.mkdir(exist_ok=True)
    Image.fromarray(np.clip(255 * more.max(axis=(0, 1)) / 5e-3, 0, 255).astype(np.uint8)).save(out)
    print(f"written: {out}, white where a layer changes by 5e-3 more or less than it should")


if __name__ == "__main__":
    main()
