"""How much a layer errs that is made of fewer splats: `python -m benchmarks.thinning`.

Splats are left out evenly, at random, or merged into clusters; of the bust and of the scanned head,
under three lights with shadows. The factor of each law is fitted on the bust alone. Printed is its
error on both.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import diffusion
from splatjax.baselines import layer_contrast
from splatjax.diffusion._clusters import LayerSources

from .scenes import columns

LIGHTS = (-0.5, -0.4, -0.75), (0.8, -0.6, -0.4), (0.1, -0.9, -0.5)
AMPLIFIED = 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0
KEEP = 2, 4, 8, 16, 32, 64, 128
CELLS = 0.3, 0.45, 0.6, 0.85, 1.2, 1.7, 2.4  # edges, in standard deviations of a layer
WIDEST, COARSEST, DEPTH = (
    25.0,
    2.2,
    0.75,
)  # mm; spacings of what stays and depth of sources, in standard deviations
POINTS, AT_ONCE, REPEATS = 600, 8, 12


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.thinning", description=__doc__)
    parser.add_argument("--splats", type=int, default=60_000, help="(default %(default)s)")
    parser.add_argument(
        "--bodies", nargs="+", default=["bust", "scanned"], help="(default %(default)s)"
    )
    return parser.parse_args()


@jax.jit
def layer(points, centers, areas, source, variance):
    """The layer at points `[points, 3]`, over every splat."""

    def some(x):
        squared = jnp.sum((x[:, None] - centers[None]) ** 2, axis=2)
        weight = areas * jnp.exp(
            -0.5 * (squared - jnp.min(squared, axis=1, keepdims=True)) / variance
        )
        return (weight @ source) / jnp.sum(weight, axis=1, keepdims=True)

    return jax.lax.map(some, points.reshape(-1, AT_ONCE, 3)).reshape(len(points), -1)


def body(name: str, count: int) -> sj.Splats:
    if name == "bust":
        return sj.bust(count)
    array = {key: jnp.asarray(values) for key, values in columns(name, count).items()}
    return sj.Splats(array["p"], array["n"], array["r"], array["area"], array["col"])


def errors(splats: sj.Splats) -> list[tuple[str, float, float]]:
    """Give, for everything that is left out: how, the error, and what the law makes of it but for
    its factor.
    """
    rng = np.random.default_rng(0)
    material = sj.load_material("skin").white()
    scenes = [
        sj.Scene(
            splats, (sj.DirectionalLight(jnp.asarray(direction), jnp.full(3, np.pi)),), material
        )
        for direction in LIGHTS
    ]
    middle = jnp.mean(splats.centers, axis=0)
    camera = sj.Camera.look_at(middle + jnp.asarray([0.0, 0.0, 900.0]), middle, width=16, height=16)
    plan = sj.make_plan(scenes, camera, sj.RenderSettings(diffuser=diffusion.DenseDiffuser()))
    spacing = float(jnp.sqrt(jnp.mean(splats.areas)))
    points = splats.centers[rng.choice(splats.count, POINTS, replace=False)]
    found = []
    for scene in scenes:
        source = sj.compute_irradiance(scene, plan).source.T
        for width in (each * spacing for each in AMPLIFIED if each * spacing < WIDEST):
            variance = jnp.asarray(width**2)
            below = splats.centers - DEPTH * width * splats.normals
            exact = layer(points, below, splats.areas, source, variance)
            contrast = float(layer_contrast(splats, source, variance))

            def error(other, exact=exact):
                return float(jnp.mean((other - exact) ** 2) / jnp.mean(exact**2))

            def record(how, kept, squares, power, width=width, contrast=contrast):
                x = spacing / (width * np.sqrt(kept))
                if x < COARSEST and np.mean(squares) > 2e-4**2:
                    found.append(
                        (how, np.sqrt(np.mean(squares)), contrast * x**power * np.sqrt(1 - kept))
                    )

            for keep in KEEP:
                if spacing * np.sqrt(keep) > COARSEST * width or splats.count // keep < 64:
                    continue
                even = [
                    np.arange(start, splats.count, keep)
                    for start in rng.integers(keep, size=REPEATS)
                ]
                thrown = [
                    np.sort(rng.choice(splats.count, len(kept), replace=False)) for kept in even
                ]
                for how, choices, power in (("evenly", even, 1.5), ("at random", thrown, 1.0)):
                    layers = (
                        layer(points, below[kept], splats.areas[kept], source[kept], variance)
                        for kept in choices
                    )
                    record(how, 1 / keep, [error(each) for each in layers], power)
            for cell in CELLS:
                if cell * width < spacing:
                    continue
                exists = np.ones(splats.count, bool)
                geometry = np.asarray(splats.centers), np.asarray(splats.normals), exists
                tree = LayerSources.build(*geometry, [cell * width])
                sources = diffusion.Sources(
                    (splats.centers - middle[None]).T, splats.normals.T, splats.areas, source.T
                )
                clusters = tree.merged(sources, DEPTH * jnp.sqrt(variance)[None])
                own = np.flatnonzero(clusters.areas > 0)
                given = clusters.centers.T[own], clusters.areas[own], clusters.irradiance.T[own]
                merged = layer(points - middle[None], *given, variance)
                record("merged", len(own) / splats.count, [error(merged)], 1.75)
    return found


def main() -> None:
    options = arguments()
    measured = {name: errors(body(name, options.splats)) for name in options.bodies}
    for how, law in (
        ("evenly", "C s x^1.5"),
        ("at random", "C s x, C = 0.282 by theory"),
        ("merged", "C s x^1.75"),
    ):
        logs = {
            name: np.asarray([np.log(error / law) for each, error, law in rows if each == how])
            for name, rows in measured.items()
        }
        factor = np.mean(logs[options.bodies[0]])
        print(
            f"{how}: {law}, times (1 - q)^0.5; C = {np.exp(factor):.3f}, fitted on "
            f"{options.bodies[0]}"
        )
        for name, values in logs.items():
            off = np.abs(values - factor)
            within = 100 * np.mean(off < np.log(1.5))
            print(
                f"  {name}: {len(off)} layers, {within:.0f}% within a factor of 1.5, the worst "
                f"{np.exp(off.max()):.2f}"
            )


if __name__ == "__main__":
    main()
