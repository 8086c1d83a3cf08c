"""How well albedo, lights, cameras and shape come back first-order: `python -m
benchmarks.fit_scene`.

The bust in skin, pictures under three lights that cast shadows, with noise; each part starts off by
something and moves alone.
"""

import argparse
import time
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial.transform import Rotation

import splatjax as sj

from .recover import Compilations

LIGHTS = (-1.0, -0.3, -0.6), (1.0, -0.3, -0.6), (0.2, -1.0, -0.8)


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fit_scene", description=__doc__)
    parser.add_argument("--splats", type=int, default=20_000, help="(default %(default)s)")
    parser.add_argument(
        "--width",
        type=int,
        default=128,
        help="of the square pictures, pixels (default %(default)s)",
    )
    parser.add_argument("--steps", type=int, default=60, help="(default %(default)s)")
    parser.add_argument(
        "--noise",
        type=float,
        default=0.01,
        help="over a picture's root mean square (default %(default)s)",
    )
    return parser.parse_args()


def degrees(a, b) -> np.ndarray:
    a, b = np.asarray(a, float), np.asarray(b, float)
    cosine = np.sum(a * b, axis=-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def main() -> None:
    options = arguments()
    compiled, rng = Compilations(), np.random.default_rng(0)
    splats, material = sj.bust(options.splats), sj.load_material("skin").white()
    camera = sj.Camera.look_at(
        jnp.asarray([60.0, 0.0, 560.0]),
        jnp.asarray([0.0, -30.0, 0.0]),
        fov=30.0,
        width=options.width,
        height=options.width,
    )
    lights = [sj.DirectionalLight(jnp.asarray(way), jnp.full(3, jnp.pi)) for way in LIGHTS]
    well = np.asarray(splats.normals) @ np.asarray(camera.rotation[2]) < -0.5

    def pictures(splats: sj.Splats) -> list[tuple[np.ndarray, np.ndarray]]:
        found = []
        for light in lights:
            picture = np.asarray(sj.render(sj.Scene(splats, (light,), material), camera).beauty)
            deviation = np.full(picture.shape, options.noise * np.sqrt(np.mean(picture**2)))
            found.append((picture + deviation * rng.normal(size=picture.shape), deviation))
        return found

    def fit(
        name: str, true: sj.Splats, begin: sj.Splats, shots, parts, background, error: Callable
    ) -> None:
        together = zip(pictures(true), shots, strict=True)
        seen = [
            sj.inverse.Observation(picture, cam, (light,), deviation=sd)
            for (picture, sd), (cam, light) in together
        ]
        optimizer = optax.adam(optax.cosine_decay_schedule(2.0, options.steps), b2=0.9)
        times, programs = [], []

        def progress(message, loss):
            times.append(time.perf_counter())
            programs.append(compiled.count)

        found = sj.inverse.fit_scene(
            seen,
            begin,
            material,
            parts,
            optimizer,
            steps=options.steps,
            background=background,
            progress=progress,
        )
        print(
            f"{name}: {error(begin, [cam for cam, _ in shots], [light for _, light in shots])} "
            "before, "
            f"{error(found.splats, found.cameras, [light for (light,) in found.lights])} after; "
            f"loss {found.losses[0]:.4g} to "
            f"{found.losses[found.best]:.4g} at step {found.best}; "
            f"{np.median(np.diff(times[3:])):.2f} s a step; planned "
            f"{found.plans} times, {programs[-1] - programs[2]} programs compiled after the first "
            "step",
            flush=True,
        )

    right = [(camera, light) for light in lights]
    filled, black = sj.inverse.UnknownBackground(), sj.inverse.BlackBackground()
    gray = eqx.tree_at(lambda s: s.albedo, splats, jnp.full_like(splats.albedo, 0.5))

    def of_albedo(body, cameras, lights):
        error = np.median(np.abs(np.asarray(body.albedo - splats.albedo))[well])
        return f"{error:.4f} of albedo (median)"

    fit("albedo", splats, gray, right, [sj.inverse.AlbedoMap()], filled, of_albedo)

    turns = [
        Rotation.from_rotvec(np.radians(12) * way / np.linalg.norm(way))
        for way in rng.normal(size=(3, 3))
    ]
    dim = [
        (
            camera,
            sj.DirectionalLight(
                jnp.asarray(turn.apply(way), jnp.float32), light.irradiance * factor
            ),
        )
        for turn, way, light, factor in zip(turns, LIGHTS, lights, (0.7, 1.3, 0.8), strict=True)
    ]

    def of_lights(body, cameras, found):
        way = max(
            float(degrees(ours.direction, light.direction))
            for ours, light in zip(found, lights, strict=True)
        )
        off = max(float(jnp.max(jnp.abs(ours.irradiance / jnp.pi - 1))) for ours in found)
        return f"{way:.2f} degrees and {100 * off:.2f}% (worst)"

    fit(
        "lights",
        splats,
        splats,
        dim,
        [sj.inverse.LightStrengths(), sj.inverse.LightPlaces()],
        filled,
        of_lights,
    )

    turn = Rotation.from_rotvec([0.02, -0.03, 0.02])
    turned = jnp.asarray(turn.as_matrix(), jnp.float32)
    moved = eqx.tree_at(
        lambda c: (c.position, c.rotation),
        camera,
        (turned @ camera.position + jnp.asarray([4.0, -3.0, 6.0]), camera.rotation @ turned.T),
    )

    def of_cameras(body, found, lights):
        way = max(float(np.max(degrees(each.rotation, camera.rotation))) for each in found)
        off = max(float(jnp.linalg.norm(each.position - camera.position)) for each in found)
        return f"{way:.3f} degrees and {off:.2f} mm (worst)"

    poses = [sj.inverse.CameraPoses(turn=1e-3, shift=0.5)]
    fit("camera", splats, splats, [(moved, light) for light in lights], poses, black, of_cameras)

    part = sj.inverse.NormalOffsets(step=0.1, smoothness=6.0, deviation=1.5)
    tables = part.prepared(splats)
    x = jnp.asarray(
        rng.normal(size=splats.count) * 1.5 / part.step / float(tables.mean.gain), jnp.float32
    )
    pictured = sj.inverse._observation.PicturedScene(splats, camera, tuple(lights))
    bumpy = part.moved(pictured, x, tables).splats

    def of_shape(body, cameras, lights):
        return (
            f"{np.mean(degrees(body.normals, bumpy.normals)[well]):.2f} degrees of normals (mean)"
        )

    fit("shape", bumpy, splats, right, [part], filled, of_shape)


if __name__ == "__main__":
    with jax.enable_x64(False):
        main()
