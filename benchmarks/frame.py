"""One body at one size, in a process of its own: `python -m benchmarks.frame`. The last line is all
rows as JSON.
"""

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax import splatting
from splatjax._combination import DeviceMesh

from .scenes import BODIES, columns, lit
from .yardstick import Yardstick


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.frame", description=__doc__)
    parser.add_argument("--body", choices=BODIES, default="synthetic", help="(default %(default)s)")
    parser.add_argument("--splats", type=int, default=683_549, help="(default %(default)s)")
    parser.add_argument(
        "--width",
        type=int,
        default=1024,
        help="of the square picture, pixels (default %(default)s)",
    )
    parser.add_argument(
        "--repeats", type=int, default=7, help="rounds; medians are given (default %(default)s)"
    )
    parser.add_argument(
        "--frame-only",
        action="store_true",
        help="the whole frame alone, without its passes and gradients",
    )
    parser.add_argument(
        "--summed", action="store_true", help="sum the layers at the splats (ExitanceDiffuser)"
    )
    return parser.parse_args()


def rasterization(scene: sj.Scene, camera: sj.Camera, plan: sj.Plan, settings: sj.RenderSettings):
    """Passes 2 and 3 with normals and albedo, and the gradient of the picture's mean square in all
    that they read.

    The picture is what the yardstick makes, and coverage: the front over what shows behind it.
    """
    areas = scene.splats.areas

    def picture(camera, centers, normals, radii, albedo):
        view = splatting.PerspectiveView.of(camera)
        splats = sj.Splats(centers, normals, radii, areas, albedo)
        splats = splats.take(plan.raster.choose(splats, view)[0])
        rows = jnp.concatenate([splats.normals.T, splats.albedo.T])
        seen = splatting.visible_surfaces(
            splats, rows, view, plan.splatting, plan.raster, DeviceMesh()
        )
        attributes = splatting.Surface.of(seen.sums, view, seen.needed).attributes
        return seen.picture(attributes), seen.picture(jnp.ones_like(seen.share))

    def loss(*inputs):
        attributes, coverage = picture(*inputs)
        return jnp.sum(jnp.mean(attributes**2, axis=(0, 1))) + jnp.mean(coverage**2)

    s = scene.splats
    return (
        picture,
        jax.grad(loss, argnums=(1, 2, 3, 4)),
        (camera, s.centers, s.normals, s.radii, s.albedo),
    )


def passes(
    scene: sj.Scene, camera: sj.Camera, plan: sj.Plan, settings: sj.RenderSettings
) -> dict[str, tuple]:
    """Parts of a frame, fed with what the part before gave: name to function and arguments."""

    def entering(scene):
        return sj.compute_irradiance(scene, plan, settings)

    def light(scene):
        return sj.illuminate(scene, plan, settings)

    def picture(scene, light):
        return sj.render(scene, camera, settings, plan, light=light)

    lit = jax.jit(light)(scene)
    jax.clear_caches()  # so that each is compiled again, and timed
    return {
        "pass 1, irradiance": (entering, (scene,)),
        "passes 1 and 4, for any camera": (light, (scene,)),
        "passes 2, 3 and 5": (picture, (scene, lit)),
    }


def timed(function: Callable, inputs: tuple) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function(*inputs))
    return 1e3 * (time.perf_counter() - start)


def cases_of(
    scene: sj.Scene,
    camera: sj.Camera,
    plan: sj.Plan,
    settings: sj.RenderSettings,
    frame_only: bool,
    summed: bool,
) -> dict[str, tuple]:
    """Return what is timed, by name: functions and their arguments."""

    def frame(scene):
        return sj.render(scene, camera, settings, plan)

    def mean(scene):
        return jnp.mean(frame(scene).beauty)

    def jacobian(scene):
        return sj.picture_jacobian(scene, camera, settings, plan)

    if frame_only:
        return {"all five passes": (frame, (scene,))}
    forward, backward, inputs = rasterization(scene, camera, plan, settings)
    return {
        "passes 2+3": (forward, inputs),
        "passes 2+3 with gradients": (backward, inputs),
        "all five passes": (frame, (scene,)),
        "all five passes with gradients": (jax.grad(mean), (scene,)),
        **passes(scene, camera, plan, settings),
        **({} if summed else {"all five passes with the Jacobian": (jacobian, (scene,))}),
    }


def main() -> None:
    options = arguments()
    data = columns(options.body, options.splats)
    scene, camera = lit(data, options.width)
    diffuser = sj.diffusion.ClusterDiffuser()
    settings = sj.RenderSettings(
        diffuser=sj.diffusion.ExitanceDiffuser(diffuser) if options.summed else diffuser
    )
    sj.make_plan(scene, camera, settings)
    start = time.perf_counter()
    plan = sj.make_plan(scene, camera, settings)
    planning = 1e3 * (time.perf_counter() - start)
    if float(sj.render(scene, camera, settings, plan).overflow) > 0:
        raise SystemExit(
            f"{options.splats} splats at {options.width}^2: the plan's capacity is exceeded"
        )
    rows, compiled = {}, {}
    cases = cases_of(scene, camera, plan, settings, options.frame_only, options.summed)
    for name, (function, inputs) in cases.items():
        start = time.perf_counter()
        compiled[name] = jax.jit(function).lower(*inputs).compile(), inputs
        seconds = time.perf_counter() - start
        held = compiled[name][0].memory_analysis()
        bytes_held = (
            held.temp_size_in_bytes + held.argument_size_in_bytes + held.output_size_in_bytes
        )
        rows[name] = {"compile_seconds": seconds, "gigabytes": 1e-9 * bytes_held}
        timed(*compiled[name])
    times = {name: [] for name in compiled}
    with tempfile.TemporaryDirectory() as folder:
        yardstick = Yardstick(Path(folder), data, options.width)
        for _ in range(options.repeats):
            yardstick.run()
            for name, case in compiled.items():
                times[name].append(timed(*case))
    medians = yardstick.medians()
    common = {
        "body": options.body,
        "splats": options.splats,
        "width": options.width,
        **{f"{name.replace(' ', '_')}_milliseconds": value for name, value in medians.items()},
        "planning_milliseconds": planning,
        "process_gigabytes": 1e-6 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    }
    unit = medians["yardstick"]
    for name, row in rows.items():
        value = float(np.median(times[name]))
        row |= {
            "name": name,
            **common,
            "milliseconds": value,
            "ratio": value / unit if unit else None,
        }
    print(json.dumps(list(rows.values())))


if __name__ == "__main__":
    main()
