"""Splat diffusion and its baselines against brute-force integration over the surface: `python -m
benchmarks.baselines`.

Writes out/baselines_BODY_KERNEL.json, and a picture of where each method errs around the
nose; SSIM and FLIP are taken there.
"""

import argparse
import dataclasses
import itertools
import json
import time
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import baselines
from splatjax.diffusion import AbstractDiffusionKernel, EscapeNormalization, PlainMean
from splatjax.splatting import PerspectiveView

from .baselines_pictures import errors
from .heads import HEADS, MAP, Body, body_of, conditions
from .surface_truth import integrate

KERNELS: dict[str, AbstractDiffusionKernel] = {"mean": PlainMean(), "escape": EscapeNormalization()}
STRETCHES = (1.0, 1.25, 1.6, 2.5, np.inf)
RIM = 2  # pixels
JUMP = 3.0  # mm from pixel to pixel: there one surface ends before another
NOSE = (0.5, 0.48)  # of the picture, from the top and from the left


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.baselines", description=__doc__)
    parser.add_argument("--body", choices=HEADS, default="scanned", help="(default %(default)s)")
    parser.add_argument("--kernel", choices=KERNELS, default="mean", help="(default %(default)s)")
    parser.add_argument("--splats", type=int, default=683_549, help="(default %(default)s)")
    parser.add_argument(
        "--width",
        type=int,
        default=1024,
        help="of the square picture, pixels (default %(default)s)",
    )
    parser.add_argument(
        "--pixels", type=int, default=1000, help="random covered ones (default %(default)s)"
    )
    parser.add_argument(
        "--refine",
        action="store_true",
        help="also integrate with twice the samples, and print the change",
    )
    return parser.parse_args()


class Found(NamedTuple):
    """A picture by one method, and the seconds it took, compiled."""

    exitance: np.ndarray
    layers: np.ndarray | None
    covered: np.ndarray
    seconds: float


def timed(function):
    """Give what a function gives, and the least processor seconds of three calls after the first;
    others may use the machine.
    """
    found, seconds = jax.block_until_ready(function()), []
    for _ in range(3):
        start = time.process_time()
        found = jax.block_until_ready(function())
        seconds.append(time.process_time() - start)
    return found, min(seconds)


def methods(body: Body, light, camera, material: sj.Material, kernel) -> dict[str, Found]:
    """Render by every method."""
    scene = sj.Scene(body.splats, (light,), material)
    settings = sj.RenderSettings(kernel=kernel)
    plan = sj.make_plan(scene, camera, settings)
    found = {}

    def keep(name: str, frame: sj.Frame, seconds: float) -> None:
        weights, layers = np.asarray(frame.weights), np.pi * np.asarray(frame.layers)
        whole = np.asarray(baselines.exitance(frame))
        root = np.asarray(frame.diffuse) * np.pi / np.where(whole > 0, whole, 1)
        layers = layers / np.where(root > 0, root, 1)[None] if len(weights) > 1 else None
        found[name] = Found(whole, layers, np.asarray(frame.coverage) > 0, seconds)
        print(f"{name}: {seconds:.1f} s", flush=True)

    frame, seconds = timed(lambda: sj.render(scene, camera, settings, plan))
    keep("splats, by their own shadow map", frame, seconds)
    corrected, opaque = baselines.StretchCorrected(), baselines.OpaqueParts()
    for name, stretch, thin in (
        ("texture space", corrected, baselines.TranslucentShadowMap()),
        ("texture space, no far side", corrected, opaque),
        (
            "texture space, no stretch correction",
            baselines.Uncorrected(),
            baselines.TranslucentShadowMap(),
        ),
    ):
        how = baselines.TextureSpaceSettings(MAP, stretch, thin, kernel)
        texture_plan = baselines.plan_texture_space(body.mesh, (light,), material, camera, how)
        picture, seconds = timed(
            lambda how=how, texture_plan=texture_plan: baselines.render_texture_space(
                body.mesh, (light,), material, camera, how, texture_plan
            )
        )
        keep(name, picture.frame, seconds)
        lost = np.asarray(picture.texture.renormalized)
        print(
            f"  weights that fell between the charts: {', '.join(f'{each:.1e}' for each in lost)}"
        )
        if float(picture.frame.overflow) > 0:
            raise SystemExit("the plan's capacity is exceeded by its own scene")
        frame = (
            picture.frame
        )  # its buffers, but for the layers, are those of any way of spreading light
    for name, blur in (
        ("screen space, Gaussian by Gaussian", baselines.GaussianPasses()),
        ("screen space, shipped kernel", baselines.ShippedKernel()),
    ):
        on_screen = jax.jit(
            lambda frame, blur=blur: baselines.diffuse_on_screen(frame, camera, material, blur)
        )
        diffused, seconds = timed(lambda on_screen=on_screen, frame=frame: on_screen(frame))
        keep(name, diffused, seconds)
    return found


def same_light(body: Body, maps: baselines.MeshLight, camera, material, kernel) -> Found:
    """Diffuse by splats the light that the shadow map of the triangles lets through, which the
    baselines use.
    """
    scene = sj.Scene(body.splats, maps.lights, material)
    settings = sj.RenderSettings(kernel=kernel)
    plan = sj.make_plan(scene, camera, settings)
    # The shadow's edge is as hard for splats as for the points of the triangles.
    source = jax.jit(lambda splats: maps.entering(splats, material).source.T)(
        dataclasses.replace(body.splats, radii=jnp.zeros_like(body.splats.radii))
    )
    layers, seconds = timed(lambda: sj.diffuse_irradiance(scene, source, camera, settings, plan))
    whole = np.einsum("gyxc,gc->yxc", np.asarray(layers), np.asarray(material.gaussians.weights))
    return Found(whole, np.asarray(layers), np.ones(whole.shape[:2], bool), seconds)


def main() -> None:
    options = arguments()
    kernel = KERNELS[options.kernel]
    start = time.perf_counter()
    body = body_of(options.body, options.splats)
    print(
        f"{options.body}: {len(body.mesh.faces)} triangles, {body.splats.count} splats "
        f"({time.perf_counter() - start:.0f} s)"
    )
    light, camera = conditions(options.width)
    material = sj.load_material("skin").white()
    # Nothing depends on the angles of entry and exit.
    dull = dataclasses.replace(
        material.surface_of(material.gaussians), eta=jnp.ones(()), specular=jnp.zeros(())
    )
    settings = baselines.TextureSpaceSettings().shadows
    capacities = baselines.shadow_capacities(body.mesh, (light,), settings)
    maps = baselines.mesh_light(body.mesh, (light,), settings, capacities)
    found = {"splats": same_light(body, maps, camera, dull, kernel)}
    found |= methods(body, light, camera, dull, kernel)
    seen = Seen.of(body, camera, found)
    pixels = seen.choose(options.pixels)
    faces, shares = seen.on_mesh(pixels)
    start = time.perf_counter()
    truth = integrate(body.mesh, maps, dull, faces, shares, kernel)
    print(f"the truth at {len(faces)} pixels: {time.perf_counter() - start:.0f} s", flush=True)
    layers = truth.layers(dull, kernel)
    weights = np.asarray(dull.gaussians.weights)
    whole = np.einsum("gpc,gc->pc", layers, weights)
    if options.refine:
        finer = integrate(body.mesh, maps, dull, faces, shares, kernel, 2**0.5).layers(dull, kernel)
        print(
            "twice the samples change it by",
            point_errors(np.einsum("gpc,gc->pc", finer, weights), whole),
        )
        layers, whole = finer, np.einsum("gpc,gc->pc", finer, weights)
    around = in_crop(body, maps, dull, kernel, seen, found, options)
    deviations = np.sqrt(np.asarray(dull.gaussians.variances))
    report(found, pixels, layers, whole, deviations, stretched(body, faces), around, options)


class Seen(NamedTuple):
    """What the camera sees of the triangles."""

    faces: np.ndarray
    shares: np.ndarray
    there: np.ndarray
    """Where every method shows the surface."""
    ends: np.ndarray
    """Where the surface ends before another one."""

    @classmethod
    def of(cls, body: Body, camera, found: dict[str, Found]) -> "Seen":
        """Look at the triangles."""
        landing = baselines.Landing.in_view(body.mesh.corners(), PerspectiveView.of(camera))
        seen = baselines.see_faces(landing, baselines.capacity_for(landing))
        there = np.asarray(seen.covered)
        for each in found.values():
            there = there & each.covered
        faces, shares = np.asarray(seen.faces), np.asarray(baselines.barycentrics(landing, seen))
        places = np.einsum("yxk,yxkc->yxc", shares, np.asarray(body.mesh.corners())[faces])
        ends = np.zeros(there.shape, bool)
        for axis in (0, 1):
            jumps = np.linalg.norm(np.diff(places, axis=axis), axis=2) > JUMP
            for pad in ((0, 1), (1, 0)):
                ends |= np.pad(jumps, [pad if each == axis else (0, 0) for each in (0, 1)])
        return cls(faces, shares, there, ends)

    def choose(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Choose pixels at random, at least two from where anything ends."""
        steps, (height, width) = range(2 * RIM + 1), self.there.shape
        padded = np.pad(self.there & ~self.ends, RIM)
        inside = np.all(
            [padded[i : i + height, j : j + width] for i in steps for j in steps], axis=0
        )
        rows, columns = np.nonzero(inside)
        picked = np.random.default_rng(0).choice(len(rows), min(count, len(rows)), replace=False)
        return rows[picked], columns[picked]

    def on_mesh(self, pixels) -> tuple[np.ndarray, np.ndarray]:
        """Give faces and barycentric coordinates under pixels."""
        return self.faces[pixels], self.shares[pixels]


def stretched(body: Body, faces: np.ndarray) -> np.ndarray:
    """Give how stretched, or squeezed, the chart is on faces: the greater of the factors along u
    and along v, from the mean.
    """
    lengths = np.stack([np.asarray(each) for each in body.mesh.lengths()])[:, faces]
    a, b, c = np.moveaxis(np.asarray(body.mesh.uvs, np.float64), 1, 0)
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    mean = np.sqrt(np.sum(np.asarray(body.splats.areas)) / np.sum(0.5 * np.abs(doubled)))
    ratio = np.maximum(lengths, 1e-9) / mean
    return np.max(np.maximum(ratio, 1 / ratio), axis=0)


def in_crop(body: Body, maps, material, kernel, seen: Seen, found: dict[str, Found], options):
    """Integrate at every pixel of a part of the picture, around the nose; draw what each method
    makes of it.
    """
    size = options.width // 6
    top, left = (int(share * options.width) for share in NOSE)
    crop = slice(top, top + size), slice(left, left + size)
    covered = seen.there[crop]
    rows, columns = np.nonzero(covered)
    faces, shares = seen.on_mesh((rows + top, columns + left))
    truth = integrate(body.mesh, maps, material, faces, shares, kernel)
    whole, root = np.zeros((size, size, 3)), np.zeros((size, size, 3))
    whole[covered] = np.einsum(
        "gpc,gc->pc", truth.layers(material, kernel), np.asarray(material.gaussians.weights)
    )
    root[covered] = np.sqrt(np.maximum(truth.albedo, 1e-4))
    pictures = {name: each.exitance[crop] for name, each in found.items()}
    return errors(
        pictures,
        whole,
        covered,
        root,
        Path(f"out/baselines_errors_{options.body}_{options.kernel}.png"),
    )


def point_errors(values: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Return errors relative to the truth's root mean square per channel: median, 99th percentile
    and largest of the worst channel of each point, and the root mean square of all.
    """
    error = (values - truth) / np.sqrt(np.mean(truth**2, axis=0))[None]
    worst = np.max(np.abs(error), axis=1)
    names, rms = ("median", "most", "largest"), float(np.sqrt(np.mean(error**2)))
    return dict(zip(names, np.quantile(worst, (0.5, 0.99, 1.0)).tolist(), strict=True)) | {
        "rms": rms
    }


def report(found, pixels, layers, whole, deviations, stretch, around, options) -> None:
    """Print the tables and write them."""
    rows = []
    print(
        f"\n{'':42}{'median':>9}{'99th pct':>9}{'maximum':>9}{'RMS':>9}"
        f"{'SSIM':>8}{'FLIP':>8}{'CPU s':>9}",
        end="   ",
    )
    print("RMS of the layers of", ", ".join(f"{each:.2f}" for each in deviations), "mm")
    for name, each in found.items():
        errors = point_errors(each.exitance[pixels], whole)
        by_layer = []
        if each.layers is not None:
            by_layer = [
                point_errors(each.layers[k][pixels], layers[k])["rms"] for k in range(len(layers))
            ]
        print(f"{name:42}" + "".join(f"{value:9.1e}" for value in errors.values()), end="")
        alike, seen = around[name]["ssim"], around[name]["flip"]
        print(
            f"{alike:8.4f}{'none' if seen is None else f'{seen:.4f}':>8}{each.seconds:9.2f}  ",
            end=" ",
        )
        print(" ".join(f"{value:.1e}" for value in by_layer))
        rows.append(
            {
                "name": name,
                **errors,
                **around[name],
                "seconds": each.seconds,
                "layers": by_layer,
            }
        )
    print("\nRMS of the widest layer where the chart is stretched by")
    bins = list(itertools.pairwise(STRETCHES))
    inside = [(stretch >= low) & (stretch < high) for low, high in bins]
    print(f"{'':42}" + "".join(f"{f'{low:g} to {high:g}':>13}" for low, high in bins))
    print(f"{'share of the pixels':42}" + "".join(f"{each.mean():13.2f}" for each in inside))
    scale = np.sqrt(np.mean(layers[-1] ** 2))
    for row, (name, each) in zip(rows, found.items(), strict=True):
        if each.layers is not None:
            off = np.mean((each.layers[-1][pixels] - layers[-1]) ** 2, axis=1)
            row["by_stretch"] = [
                float(np.sqrt(off[part].mean()) / scale) if part.any() else None for part in inside
            ]
            print(
                f"{name:42}"
                + "".join(
                    f"{value:13.1e}" if value is not None else f"{'':13}"
                    for value in row["by_stretch"]
                )
            )
    out = Path(f"out/baselines_{options.body}_{options.kernel}.json")
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(rows, indent=1, default=float) + "\n")
    print(f"\nwritten: {out}")


if __name__ == "__main__":
    main()
