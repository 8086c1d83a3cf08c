"""How far the layers of a picture are from the untruncated sums over all splats: `python -m
benchmarks.diffusion_error`.

Also at the splats, before they are blended. Writes out/diffusion_error.png: the layer that errs
most, every pixel as the nearest one that was looked at.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

import splatjax as sj
from splatjax import diffusion, splatting
from splatjax._combination import DeviceMesh

from .scenes import BODIES, MATERIALS, columns, lit

QUANTILES = (0.5, 0.99, 1.0)


def arguments():
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.diffusion_error", description=__doc__
    )
    parser.add_argument("--body", choices=BODIES, default="synthetic", help="(default %(default)s)")
    parser.add_argument(
        "--material", choices=MATERIALS, default="skin", help="(default %(default)s)"
    )
    parser.add_argument(
        "--splats", type=int, default=683_549, help="on the prototype's head (default %(default)s)"
    )
    size = "of the square picture, pixels (default %(default)s)"
    parser.add_argument("--width", type=int, default=1024, help=size)
    zoom = "of the middle of the picture (default %(default)s)"
    parser.add_argument("--zoom", type=float, default=1.0, help=zoom)
    points = "random covered pixels, and random splats (default %(default)s)"
    parser.add_argument("--points", type=int, default=2000, help=points)
    errors = "settings of ClusterDiffuser (default %(default)s)"
    parser.add_argument("--errors", type=float, nargs="+", default=[2e-3], help=errors)
    parser.add_argument("--white", action="store_true", help="without the map of albedo")
    return parser.parse_args()


def timed(function: Callable, *given):
    """Return what a function computes, and the seconds of its second call."""
    function = eqx.filter_jit(function)
    jax.block_until_ready(function(*given))
    start = time.perf_counter()
    found = jax.block_until_ready(function(*given))
    return found, time.perf_counter() - start


def untruncated(
    sources: diffusion.Sources, points, light: diffusion.LayersAtPoints
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the means and the mass of every layer at points `[3, points]`, over every splat.

    Layers that no splat resolves are 0.
    """
    layer, channels = jax.jit(diffusion.dense_layer), len(sources.irradiance)
    values = np.zeros((len(light.variances), channels + 1, points.shape[1]), np.float32)
    for k in np.flatnonzero(np.any(light.mass > 0, axis=1)):
        own = light.variances[k], light.kernel.depths(light.variances)[k]
        values[k] = layer(sources, points, *own).values
    return values[:, :channels], values[:, channels]


def layers_of(
    light: diffusion.LayersAtPoints, picked, gaussians: sj.SumOfGaussians, exact
) -> tuple[np.ndarray, np.ndarray]:
    """Compute `L_k` at some of the points, and by exact means and mass there."""
    along = {name: getattr(light, name) for name in light.ALONG_POINTS}
    own = dataclasses.replace(light, **jax.tree.map(lambda row: row[..., picked], along))
    means, mass = (jnp.asarray(each) for each in exact)
    truth, none = dataclasses.replace(own, means=means, mass=mass), jnp.zeros(means.shape[1])
    return tuple(np.asarray(each.weigh(gaussians, none)[0]) for each in (own, truth))


def seen_in_front(basis: sj.DiffusionBasis) -> np.ndarray:
    """Return the indices of the points of the surface in front."""
    return np.flatnonzero(
        (basis.in_front > 0) & (jnp.max(basis.pixel_radiance_per_exitance, axis=0) > 0)
    )


def deviations(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Compute how far rows `[gaussians, channels, points]` are off, of the root mean square of
    each: the worst channel, `[gaussians, points]`.
    """
    scale = np.sqrt(np.mean(exact**2, axis=2, keepdims=True))
    return np.max(np.abs(found - exact) / scale, axis=1)


def main() -> None:
    options = arguments()
    scene, camera = lit(columns(options.body, options.splats), options.width, options.material)
    camera = dataclasses.replace(camera, focal_length=options.zoom * camera.focal_length)
    if options.white:
        scene = eqx.tree_at(lambda s: s.splats.albedo, scene, None)
    gaussians, kernel, exact = scene.material.gaussians, sj.RenderSettings().kernel, None
    rng = np.random.default_rng(0)
    chosen = rng.choice(scene.splats.count, options.points, replace=False)
    for error in options.errors:
        settings = sj.RenderSettings(diffuser=diffusion.ClusterDiffuser(error=error))
        plan = sj.make_plan(scene, camera, settings)
        source = sj.compute_irradiance(scene, plan, settings).source
        splats = scene.splats
        sources = diffusion.Sources(splats.centers.T, splats.normals.T, splats.areas, source)

        # Pass 4 alone, of the splats that the camera may see and of all.
        placed = jax.tree.map(lambda rows, plan=plan: rows[..., plan.order], sources)
        placed = dataclasses.replace(placed, areas=jnp.where(plan.exists, placed.areas, 0))
        view, body = splatting.PerspectiveView.of(camera), splats.take(plan.order)
        body = eqx.tree_at(lambda s: s.radii, body, jnp.where(plan.exists, body.radii, 0))
        seen, _ = plan.raster.choose(body, view)

        def diffuse(placed, targets, plan=plan):
            return plan.diffusion.diffuse(
                placed, gaussians.variances, kernel, DeviceMesh(), targets
            )

        _, seconds = timed(diffuse, placed, seen)
        diffused, all_seconds = timed(diffuse, placed, None)
        frame, frame_seconds = timed(sj.render, scene, camera, settings, plan)
        if not float(frame.overflow) <= 0:
            raise SystemExit("the plan's capacity is exceeded by its own scene")

        # The layers at the pixels: blended, and by the sums over all splats at the same points.
        basis = sj.diffusion_basis(scene, camera, settings, plan)
        if exact is None:
            picked = rng.choice(seen_in_front(basis), options.points, replace=False)
            pixels = np.asarray(basis.pixels[picked])
            points = frame.position.reshape(-1, 3)[pixels].T
            exact = untruncated(sources, points, basis.light)
            means_at_splats, _ = untruncated(sources, splats.centers[chosen].T, basis.light)
        resolved = np.flatnonzero(np.any(basis.light.mass > 0, axis=1))
        found, truth = layers_of(basis.light, picked, gaussians, exact)
        off = deviations(found[resolved], truth[resolved])
        order = np.empty(splats.count, int)
        order[np.asarray(plan.order)[np.asarray(plan.exists)]] = np.flatnonzero(plan.exists)
        planned = np.asarray(plan.diffusion.gaussians).tolist()
        layers = [planned.index(k) for k in resolved]
        means = np.asarray(diffused.layers.values[:, :-1])[layers][:, :, order[chosen]]
        off_at_splats = deviations(means, means_at_splats[resolved])
        print(
            f"error={error:g}: pass 4 {1e3 * seconds:.0f} ms, at all splats "
            f"{1e3 * all_seconds:.0f} ms; frame {1e3 * frame_seconds:.0f} ms\n"
            "of the RMS at pixels, then of the means at splats: median, 99th percentile, maximum"
        )
        sources = [len(np.unique(plan.diffusion.sources.parents[layer])) for layer in layers]
        each = zip(resolved, sources, off, off_at_splats, strict=True)
        for k, count, at_pixels, means in each:
            numbers = (
                " ".join(f"{np.quantile(each, q):.1e}" for q in QUANTILES)
                for each in (at_pixels, means)
            )
            width = float(gaussians.variances[k]) ** 0.5
            print(f"  {width:5.2f} mm: {'; '.join(numbers)}  {count} sources", flush=True)
    draw(np.max(off, axis=0), pixels, np.asarray(frame.coverage) > 0)


def draw(off: np.ndarray, pixels: np.ndarray, covered: np.ndarray) -> None:
    """Draw every covered pixel as the nearest one that was looked at."""
    looked_at = np.stack(np.divmod(pixels, covered.shape[1]), axis=1)
    rows, across = np.nonzero(covered)
    nearest = cKDTree(looked_at).query(np.stack([rows, across], axis=1))[1]
    picture = np.zeros((*covered.shape, 3), np.uint8)
    brightness = 0.1 + 0.9 * np.clip(off / 1e-2, 0, 1)
    picture[rows, across] = matplotlib.colormaps["magma"](brightness, bytes=True)[nearest, :3]
    out = Path("out/diffusion_error.png")
    out.parent.mkdir(exist_ok=True)
    Image.fromarray(picture).save(out)
    print(f"written: {out}, brightest where a layer is off by 1e-2 or more")


if __name__ == "__main__":
    main()
