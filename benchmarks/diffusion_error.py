"""How far pass 4 is from the untruncated sum over all splats: `python -m
benchmarks.diffusion_error`.

Writes out/diffusion_error.png: the layer that errs most, every pixel as the nearest one that was
looked at.
"""

import argparse
import time
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
from splatjax.render import _lighting as lighting, _passes as wiring

from .scenes import BODIES, MATERIALS, columns, lit

AT_ONCE = 8  # pixels


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
    parser.add_argument(
        "--width",
        type=int,
        default=1024,
        help="of the square picture, pixels (default %(default)s)",
    )
    parser.add_argument(
        "--pixels", type=int, default=2000, help="random covered ones (default %(default)s)"
    )
    parser.add_argument(
        "--errors",
        type=float,
        nargs="+",
        default=[2e-3],
        help="settings of ClusterDiffuser (default %(default)s)",
    )
    parser.add_argument("--white", action="store_true", help="without the map of albedo")
    return parser.parse_args()


@jax.jit
def untruncated(sources: diffusion.Sources, points, variance, depth):
    """Means and last exits of a layer at points `[3, pixels]`, over every splat."""
    centers = sources.centers - depth * sources.normals

    def some(x):
        offset = x[:, :, None] - centers[:, None]
        weight = sources.areas * jnp.exp(-0.5 * jnp.sum(offset * offset, axis=0) / variance)
        gathered = weight.sum(axis=1)
        exits = gathered * jnp.exp(0.5 * depth * depth / variance) / (2 * jnp.pi * variance)
        return jnp.concatenate([(sources.irradiance @ weight.T) / gathered, exits[None]])

    found = jax.lax.map(some, points.reshape(3, -1, AT_ONCE).transpose(1, 0, 2))
    return found.transpose(1, 0, 2).reshape(found.shape[1], -1)


@jax.jit
def diffuse(diffuser, *given):
    return diffuser.diffuse(*given)


def main() -> None:
    options = arguments()
    options.pixels -= options.pixels % AT_ONCE
    scene, camera = lit(columns(options.body, options.splats), options.width, options.material)
    if options.white:
        scene = eqx.tree_at(lambda s: s.splats.albedo, scene, None)
    settings = sj.RenderSettings()
    plan = sj.plan(scene, camera, settings)
    view, normalization = splatting.PerspectiveView.of(camera), settings.diffusion.normalization

    @jax.jit
    def seen_by(scene):
        light = wiring.cast_shadows(scene, settings, plan)
        entering = lighting.let_light_in(scene, light)
        seen = wiring.see_surfaces(
            scene.splats, lighting.surface_attributes(scene, light, entering), view, settings, plan
        )
        return wiring.sources_of(scene.splats, entering.source), seen

    sources, seen = seen_by(scene)
    receivers, atlas = seen.receivers(), seen.atlas
    variances = scene.material.gaussians.variances
    kernels = diffusion.Kernels.of(variances, normalization)
    tiles, within = np.nonzero(np.asarray(seen.covered & atlas.in_front[:, None]))
    picked = np.random.default_rng(0).choice(len(tiles), options.pixels, replace=False)
    tiles, within = tiles[picked], within[picked]

    def at_pixels(array):
        """Give the chosen pixels of an array `[tiles, ..., pixels]` as a single tile."""
        return jnp.moveaxis(array[tiles, ..., within], 0, -1)[None]

    front = jax.tree.map(at_pixels, receivers)

    def layers(means, exits, carried):
        """`L_k` at the pixels, by the normalization and the handover."""
        points = diffusion.Points.of(scene.material, front, means, exits, carried)
        return np.asarray(points.layers(plan.interval, normalization, variances)[0])[:, :, 0]

    exact = None
    for error in options.errors:
        diffuser = diffusion.ClusterDiffuser(error=error).planned(
            scene.splats, kernels, plan.interval, [atlas]
        )
        given = diffuser, sources, kernels, seen.points, seen.covered, atlas
        jax.block_until_ready(diffuse(*given))
        start = time.perf_counter()
        found = jax.block_until_ready(diffuse(*given))
        seconds = time.perf_counter() - start
        if float(found.needed) > 1:
            raise SystemExit("the plan does not hold its own scene")
        if exact is None:
            all_kernels = zip(kernels.variances, kernels.depths, strict=True)
            exact = jnp.stack(
                [untruncated(sources, front.points[0], *kernel) for kernel in all_kernels]
            )[None]
            exact_layers = layers(exact[:, :, :-1], exact[:, :, -1], found.carried)
        ours = layers(at_pixels(found.means), at_pixels(found.exits), found.carried)
        scale = np.sqrt(np.mean(exact_layers**2, axis=2, keepdims=True))
        off = np.max(np.abs(ours - exact_layers) / scale, axis=1)
        print(
            f"error={error:g}: pass 4 without the gain {1e3 * seconds:.0f} ms; of the RMS: median, "
            "99th percentile, maximum"
        )
        for k, (each, layer) in enumerate(zip(off, diffuser.layers, strict=True)):
            if not float(found.carried[k]):
                continue
            how = "every pixel gathers" if layer.nodes is None else "through nodes"
            print(
                f"  {variances[k] ** 0.5:5.2f} mm: {np.median(each):.1e} "
                f"{np.quantile(each, 0.99):.1e} {each.max():.1e}  {how}"
            )
    places, side = np.asarray(atlas.tiles), splatting.SIDE
    down = places[tiles] // atlas.grid.across * side + within // side
    across = places[tiles] % atlas.grid.across * side + within % side
    covered = np.asarray(seen.covered, np.float32)[..., None]
    rows, beside = np.nonzero(np.asarray(atlas.front_picture(jnp.asarray(covered))[..., 0]))
    nearest = cKDTree(np.stack([down, across], axis=1)).query(np.stack([rows, beside], axis=1))[1]
    picture = np.zeros((options.width, options.width, 3), np.uint8)
    shades = matplotlib.colormaps["magma"](
        0.1 + 0.9 * np.clip(np.max(off, axis=0) / 1e-2, 0, 1), bytes=True
    )[:, :3]
    picture[rows, beside] = shades[nearest]
    out = Path("out/diffusion_error.png")
    out.parent.mkdir(exist_ok=True)
    Image.fromarray(picture).save(out)
    print(f"written: {out}, brightest where a layer is off by 1e-2 or more")


if __name__ == "__main__":
    main()
