"""Absorption that varies over a body, against path tracing: `python -m benchmarks.maps [FOLDER]`.

A block with stripes or freckles is rendered, and its error printed beside those of the two
materials alone, whose absorption differs by a factor of four. Then the map of absorption of a ball
is recovered from one and from two path-traced pictures, with bars that contain the model's error.
Path-traced pictures are kept in FOLDER (default out/maps). Only missing ones are traced, which
needs `mitsuba` (the dependency group `truth`).
"""

import dataclasses
import functools
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import optax
from scipy.ndimage import binary_erosion
from scipy.spatial import KDTree

import splatjax as sj

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import make_bodies as bodies
from path_traced_bodies import trace

NODES = np.geomspace(2**-0.5, 2**2.5, 7)  # absorption at the nodes of the table
ALONE = {"uniform 1": 1.0, "uniform 4": 4.0}
MIDDLE = 2.0  # absorption of the angles of all maps, and of the start of the fit
VOXELS = 160, 160, 80
SMOOTHNESS, STEPS, DRAWS = 1.0, 40, 8  # mm; of the fit; fits of perturbed pictures
LIT = 0.1  # least cosine to a light, and to the camera, of the splats that count
BAR = 1.64  # deviations that contain 90% of a normal distribution
BALL, SHADOWED = (
    next(body for body in bodies.BODIES if body.name == name) for name in ("sphere", "block")
)
BLOCKS = [
    SHADOWED._replace(
        name="straight",
        what="block of 40 x 40 x 20, lit and seen from straight above",
        light=bodies.lamp(0, 0, -1),
        eye=(0, 0.01, 80),
        blocker=None,
    ),
    SHADOWED._replace(
        name="slanted",
        what="block of 40 x 40 x 20, lit and seen at an angle",
        light=bodies.lamp(-0.6, -0.4, -1),
        eye=(20, 30, 75),
        blocker=None,
    ),
    SHADOWED,
]
BALLS = [
    BALL._replace(name=f"ball_{i}", light=light, count=5000)
    for i, light in enumerate((BALL.light, bodies.lamp(1, -0.6, -1)), 1)
]


def striped(width: float, points: np.ndarray) -> np.ndarray:
    return np.where(np.floor(points[:, 0] / width) % 2 == 0, 1.0, 4.0)


def freckled(points: np.ndarray) -> np.ndarray:
    spots = np.random.default_rng(1).uniform(-20, 20, (80, 2))
    return 1 + 3 * np.exp(-((KDTree(spots).query(points[:, :2])[0] / 1.5) ** 4))


def smooth(points: np.ndarray) -> np.ndarray:
    """Return a map of the ball that is the same at every depth."""
    x, y, _ = 10 * points.T / np.linalg.norm(points, axis=1)
    return 4 ** (0.5 + 0.5 * np.sin(0.5 * x) * np.cos(0.5 * y - 0.5))


MAPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    **{name: lambda points, v=value: np.full(len(points), v) for name, value in ALONE.items()},
    "stripes of 4 mm": functools.partial(striped, 4.0),
    "stripes of 1 mm": functools.partial(striped, 1.0),
    "freckles": freckled,
    "smooth": smooth,
}


def medium(absorption) -> sj.Medium:
    """Make a medium of the same extinction, whose absorption is multiplied."""
    sigma_a = absorption * bodies.SIGMA_T * (1 - jnp.asarray(bodies.ALBEDO))
    return sj.Medium(sigma_a, bodies.SIGMA_T - sigma_a, jnp.ones(3))


def profile(absorption):
    return sj.fitting.TransportModel().profile(medium(absorption))


@functools.cache
def material(absorption: float = float(NODES[0]), angles: float = MIDDLE) -> sj.Material:
    """Fit the material of an absorption, with the angles of another; by default that of the
    table.
    """
    law = sj.fitting.TransportModel().angles(medium(angles))
    return dataclasses.replace(bodies.fitted(profile(absorption), 1.0), angles=law)


@functools.cache
def table() -> sj.fitting.WeightTable:
    return sj.fitting.weight_table(profile, {"absorption": NODES}, material().gaussians)


def truth_of(body: bodies.Body, name: str, folder: Path) -> bodies.Truth:
    """Read a path-traced picture, or trace it with the map as a volume of albedo."""
    body = body._replace(name=f"{body.name} {name}".replace(" ", "_"))
    path = folder / f"{body.name}.npz"
    if not path.exists():
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
        low, high = body.shape().bounds
        z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in VOXELS[::-1]), indexing="ij")
        points = low + (high - low) * np.stack([x, y, z], axis=-1).reshape(-1, 3)
        albedo = 1 - MAPS[name](points)[:, None] * (1 - np.asarray(bodies.ALBEDO))
        volume = {
            "type": "gridvolume",
            "grid": mi.VolumeGrid(albedo.reshape(*x.shape, 3).astype(np.float32)),
            "raw": True,
            "filter_type": "nearest",
            "to_world": mi.ScalarTransform4f().translate(low.tolist()).scale((high - low).tolist()),
        }
        trace(mi, body, path, volume)
    return bodies.read_truth(body, folder)


def inside(picture: np.ndarray, truth: bodies.Truth) -> np.ndarray:
    """Return the pixels that are at least 3 pixels from the outline."""
    return binary_erosion(picture.any(axis=-1), iterations=3) & truth.sound


def compared(body: bodies.Body, splats: sj.Splats, name: str, folder: Path) -> np.ndarray:
    """Render a body with a map, and a uniform one by its own material too. Print and return the
    error inside, per channel, over the truth, whose noise is subtracted.
    """
    truth = truth_of(body, name, folder)
    weights = table().factors({"absorption": MAPS[name](np.asarray(splats.centers, np.float64))})
    cases = {"by weights": (dataclasses.replace(splats, weights=weights), material())}
    if name in ALONE:
        cases["alone"] = splats, material(ALONE[name], ALONE[name])
    errors = {}
    for title, (covered, of) in cases.items():
        picture, _ = bodies.splatted(body, covered, of, sj.RenderSettings())
        mask = inside(picture, truth)
        squares = ((picture - truth.picture) ** 2 - truth.variance)[mask].mean(axis=0)
        errors[title] = np.sqrt(np.maximum(squares, 0) / (truth.picture[mask] ** 2).mean(axis=0))
        print(f"{body.what}, {name}, {title}: {(100 * errors[title]).round(1)}%", flush=True)
    return errors["by weights"]


def recovered(splats: sj.Splats, count: int, error: np.ndarray, alike: float, folder: Path) -> None:
    """Recover the smooth map from pictures, and print how far it is off. The model's error is the
    same in `alike` pixels.
    """
    seen = []
    for body in BALLS[:count]:
        truth = truth_of(body, "smooth", folder)
        mask = inside(truth.picture > 0, truth)
        power = np.mean(truth.picture[mask] ** 2, axis=0)
        deviation = np.sqrt(truth.variance + alike * error**2 * power)
        camera = sj.Camera.look_at(
            body.eye, body.target, fov=body.fov, width=bodies.SIZE, height=bodies.SIZE
        )
        seen.append(sj.inverse.Observation(truth.picture, camera, body.light, mask, deviation))
    part = sj.inverse.ParameterMap(table(), {"absorption": MIDDLE}, smoothness=SMOOTHNESS)
    fit = functools.partial(sj.inverse.fit_scene, splats=splats, material=material(), parts=[part])
    adam = optax.adam(optax.cosine_decay_schedule(4.0, 20), b2=0.9)
    lbfgs = optax.chain(optax.lbfgs(1.0, memory_size=50, linesearch=None), optax.clip(3.0))
    start = time.perf_counter()
    near = fit(seen, optimizer=adam, steps=20)
    found = fit(seen, optimizer=lbfgs, steps=STEPS, start=near.restarted())
    seconds = time.perf_counter() - start
    again = functools.partial(fit, optimizer=lbfgs, steps=STEPS // 2)
    draws = sj.inverse.randomized_fits(again, seen, found, DRAWS)
    all_seconds = time.perf_counter() - start
    centers, normals = (np.asarray(each, np.float64) for each in (splats.centers, splats.normals))
    ways = [-np.asarray(body.light.direction) for body in BALLS[:count]]
    to_lights = np.max([normals @ way / np.linalg.norm(way) for way in ways], axis=0)
    toward = np.asarray(BALL.eye) - centers
    to_camera = np.sum(normals * toward, axis=1) / np.linalg.norm(toward, axis=1)
    lit = np.minimum(to_lights, to_camera) > LIT
    logs = np.log([each.maps["absorption"][lit] for each in (found, *draws)])
    bars, off = np.std(logs[1:], axis=0, ddof=1), np.abs(logs[0] - np.log(smooth(centers[lit])))
    ratio = off / bars
    print(
        f"{count} pictures, the model's error the same in {alike:.0f} pixels: of {len(off)} lit "
        f"splats {np.mean(ratio < BAR):.1%} are within {BAR} bars, {np.mean(ratio < 1):.1%} within "
        f"one, 90% within {np.quantile(ratio, 0.9):.2f}; off by {np.median(off):.1%} (median), "
        f"{np.quantile(off, 0.9):.1%} (90th percentile), bar {np.median(bars):.1%} (median); "
        f"losses {near.losses[0]:.3g}, {near.losses[-1]:.3g}, {found.losses[found.best]:.3g}; "
        f"{seconds:.0f} s, with bars {all_seconds:.0f} s",
        flush=True,
    )


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out/maps")
    folder.mkdir(parents=True, exist_ok=True)
    for body in BLOCKS:
        splats = bodies.splats_of(body)
        for name in list(MAPS)[:-1]:
            compared(body, splats, name, folder)
    splats = bodies.splats_of(BALLS[0])
    error = np.max([compared(BALLS[0], splats, name, folder) for name in ALONE], axis=0)
    pixel = 2 * BALL.eye[2] * np.tan(np.radians(BALL.fov / 2)) / bodies.SIZE
    patch = 4 * np.pi * (SMOOTHNESS / pixel) ** 2  # pixels that a blur averages
    for count, alike in ((1, patch), (2, patch), (2, 1.0)):
        recovered(splats, count, error, alike, folder)


if __name__ == "__main__":
    main()
