"""How fast the passes are, beside the yardstick: `python -m benchmarks`. Writes out/bench.json."""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import diffusion, splatting
from splatjax.render import _passes as wiring

from .yardstick import FOCAL_LENGTH, Yardstick, make_scene

SKIN = (0.0064, 0.0484, 0.187, 0.567, 1.99, 7.41)  # mm^2
# Times of the yardstick, for 683,549 splats at 1024^2.
GOALS = {"passes 2+3": 1.0, "passes 2+3 with gradients": 3.0, "all five passes": 5.0, "all five passes with gradients": 14.0}


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--splats", type=int, default=683_549, help="on the prototype's head (default %(default)s)")
    parser.add_argument("--width", type=int, default=1024, help="of the square picture, pixels (default %(default)s)")
    parser.add_argument("--repeats", type=int, default=7, help="rounds; medians are given (default %(default)s)")
    parser.add_argument("--no-gradients", action="store_true", help="forward passes only")
    return parser.parse_args()


def head(data: dict[str, np.ndarray], width: int) -> tuple[sj.Scene, sj.Camera]:
    """The prototype's scene under one directional light, in skin."""
    array = {name: jnp.asarray(values) for name, values in data.items()}
    splats = sj.Splats(array["p"], array["n"], array["r"], array["area"], array["col"])
    weights = jnp.full((len(SKIN), 3), 1 / len(SKIN))
    material = sj.Material(sj.SumOfGaussians(jnp.asarray(SKIN), weights))
    light = sj.DirectionalLight(jnp.asarray([0.5, 0.6, 0.65]), jnp.full(3, jnp.pi))
    camera = sj.Camera(jnp.zeros(3), jnp.eye(3), jnp.asarray(FOCAL_LENGTH), width, width)
    return sj.Scene(splats, (light,), material), camera


def rasterization(scene: sj.Scene, camera: sj.Camera, plan: sj.Plan, settings: sj.RenderSettings):
    """Passes 2 and 3 with normals and albedo, and the gradient of the picture's mean square in all that they read.

    The picture is what the yardstick makes, and coverage: the front laid over what shows behind it.
    """
    areas = scene.splats.areas

    def picture(camera, centers, normals, radii, albedo):
        view, splats = splatting.PerspectiveView.of(camera), sj.Splats(centers, normals, radii, areas)
        rows = jnp.concatenate([normals.T, albedo.T])
        seen = splatting.splat_surfaces(splats, rows, view, settings.splatting, plan.camera)
        front = seen.front.coverage
        behind = (1 - front) * seen.behind.coverage
        return [
            *(front * a + behind * b for a, b in zip(seen.front.attributes, seen.behind.attributes, strict=True)),
            front + behind,
        ]

    def loss(*inputs):
        return sum(jnp.mean(plane**2) for plane in picture(*inputs))

    s = scene.splats
    return picture, jax.grad(loss, argnums=(1, 2, 3, 4)), (camera, s.centers, s.normals, s.radii, s.albedo)


def passes(scene: sj.Scene, camera: sj.Camera, plan: sj.Plan, settings: sj.RenderSettings) -> dict[str, tuple]:
    """Each pass alone, fed with what the one before gave: name to function and arguments."""
    view = splatting.PerspectiveView.of(camera)

    def shadow(scene):
        return wiring.cast_shadows(scene, settings, plan)

    def visible(scene, light, entering):
        attributes = wiring.surface_attributes(scene, light, entering)
        return wiring.see_surfaces(scene.splats, attributes, view, settings, plan)

    def layers(scene, entering, seen):
        sources = wiring.sources_of(scene.splats, entering.source)
        rest = plan.interval, seen.atlas, plan.diffuser, settings.diffusion.normalization
        return diffusion.diffusion_layers(sources, scene.material, seen.receivers(), *rest)

    light = jax.jit(shadow)(scene)
    entering = jax.jit(wiring.let_light_in)(scene, light)
    seen = jax.jit(visible)(scene, light, entering)
    return {
        "pass 1, shadow map": (shadow, (scene,)),
        "irradiance": (wiring.let_light_in, (scene, light)),
        "passes 2+3, all attributes": (visible, (scene, light, entering)),
        "pass 4, six layers": (layers, (scene, entering, seen)),
    }


def timed(function: Callable, inputs: tuple) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*inputs))
    return 1e3 * (time.perf_counter() - start)


def measure(cases: dict[str, tuple[Callable, tuple]], yardstick: Yardstick | None, repeats: int):
    """Compile all cases, then time them in rounds, the yardstick among them: medians in milliseconds."""
    compiled, seconds, gigabytes = {}, {}, {}
    for name, (function, inputs) in cases.items():
        start = time.perf_counter()
        compiled[name] = jax.jit(function).lower(*inputs).compile(), inputs
        seconds[name] = time.perf_counter() - start
        held = compiled[name][0].memory_analysis()
        gigabytes[name] = 1e-9 * (held.temp_size_in_bytes + held.argument_size_in_bytes + held.output_size_in_bytes)
        timed(*compiled[name])
        print(f"  {name}: compiled in {seconds[name]:.1f} s", flush=True)
    times = {name: [] for name in cases}
    yard = []
    for _ in range(repeats):
        if yardstick is not None:
            yard.append(yardstick.milliseconds())
        for name, case in compiled.items():
            times[name].append(timed(*case))
    milliseconds = {name: float(np.median(each)) for name, each in times.items()}
    return milliseconds, seconds, gigabytes, float(np.median(yard)) if yard else None


def report(milliseconds, seconds, gigabytes, yard, options) -> list[dict]:
    """Print a table and give its rows."""
    full_size = (options.splats, options.width) == (683_549, 1024)
    print(f"\n{options.splats:,} splats at {options.width}^2, medians of {options.repeats} rounds")
    print(f"yardstick, passes 2+3 in C on one thread: {f'{yard:.0f} ms' if yard else 'none'}\n")
    print(f"{'':50}{'ms':>9}{'ratio':>8}{'goal':>7}{'compile, s':>12}{'memory, GB':>12}")
    rows = []
    for name, value in milliseconds.items():
        ratio, goal = value / yard if yard else None, GOALS.get(name) if full_size else None
        numbers = f"{_number(ratio):>8}{_number(goal):>7}{_number(seconds[name]):>12}{gigabytes[name]:12.2f}"
        print(f"{name:50}{value:9.0f}{numbers}")
        rows.append(
            {
                "name": name,
                "splats": options.splats,
                "width": options.width,
                "milliseconds": value,
                "yardstick_milliseconds": yard,
                "ratio": ratio,
                "gigabytes": gigabytes[name],
                "goal": goal,
            }
        )
    return rows


def _number(value: float | None) -> str:
    """Write a number; nothing for none, and for the compile time of what was compiled to make the others' input."""
    return "" if value is None or value < 0.05 else f"{value:.2f}"


def shares(parts: dict[str, float], whole: float) -> None:
    print("\nOf a frame, each pass run alone:")
    rest = whole - sum(parts.values())
    for name, value in [*parts.items(), ("pass 5 and the rest (difference)", rest)]:
        print(f"{name:50}{value:9.0f} ms{value / whole:8.0%}")


def main() -> None:
    options = arguments()
    data = make_scene(options.splats)
    scene, camera = head(data, options.width)
    settings = sj.RenderSettings()
    start = time.perf_counter()
    plan = sj.plan(scene, camera, settings)
    print(f"planned in {time.perf_counter() - start:.1f} s")
    forward, backward, inputs = rasterization(scene, camera, plan, settings)

    def frame(scene):
        return sj.render(scene, camera, settings, plan)

    def mean(scene):
        return jnp.mean(frame(scene).beauty)

    def jacobian(scene):
        return sj.picture_jacobian(scene, camera, settings, plan)

    parts = passes(scene, camera, plan, settings)
    cases = {"passes 2+3": (forward, inputs), "all five passes": (frame, (scene,)), **parts}
    if not options.no_gradients:
        cases["passes 2+3 with gradients"] = backward, inputs
        cases["all five passes with gradients"] = jax.grad(mean), (scene,)
        cases["all five passes with the Jacobian in the material"] = jacobian, (scene,)
    if float(frame(scene).overflow) > 0:
        raise SystemExit("the plan does not hold its own scene: the figures would be those of an empty picture")
    with tempfile.TemporaryDirectory() as folder:
        yardstick = Yardstick.build(Path(folder), data, options.width)
        milliseconds, seconds, gigabytes, yard = measure(cases, yardstick, options.repeats)
    rows = report(milliseconds, seconds, gigabytes, yard, options)
    frame_time = milliseconds["all five passes"]
    for name in [name for name in milliseconds if name.startswith("all five passes with")]:
        print(f"{name}, over a frame: {milliseconds[name] / frame_time:.2f}")
    shares({name: milliseconds[name] for name in parts}, milliseconds["all five passes"])
    out = Path("out/bench.json")
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"\nwritten: {out}")


if __name__ == "__main__":
    main()
