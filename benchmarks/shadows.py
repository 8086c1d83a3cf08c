"""What coarse shadow maps of the samples of environments cost and save, against full ones:
`python -m benchmarks.shadows`. The last line is all rows as JSON.
"""

import argparse
import dataclasses
import json
import time

import jax
import numpy as np

import splatjax as sj
from splatjax.splatting import ShadowSettings

from .scenes import columns, lit

SKIES = {
    "studio": sj.scene.studio,
    "overcast": sj.scene.overcast_sky,
    "sun": sj.scene.sun_and_sky,
}
COARSE = sj.RenderSettings()
FULL = dataclasses.replace(COARSE, sample_shadows=ShadowSettings())


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.shadows", description=__doc__)
    parser.add_argument("--bust", type=int, default=200_000, help="splats (default %(default)s)")
    parser.add_argument("--head", type=int, default=683_549, help="splats (default %(default)s)")
    return parser.parse_args()


def scene_of(body: str, count: int) -> tuple[sj.Scene, sj.Camera]:
    """Return a body before a camera that sees its face."""
    if body == "scanned":
        scene, camera = lit(columns(body, count), 512)
        return scene, camera
    camera = sj.Camera.look_at((0, -20, 800), (0, -20, 0), fov=30, width=512, height=512)
    return sj.Scene(sj.bust(count), (), sj.load_material("skin").white()), camera


def compare(body: str, count: int, sky: str) -> dict:
    """Light a body with both kinds of maps: processor seconds, and the error of what enters."""
    scene, camera = scene_of(body, count)
    turned = (0, -1, 0) if body == "scanned" else (0, 1, 0)
    light = sj.EnvironmentLight(SKIES[sky](), up=turned)
    scene = sj.Scene(scene.splats, (light,), scene.material)
    entering, seconds = {}, {}
    for name, settings in (("coarse", COARSE), ("full", FULL)):
        plan = sj.make_plan(scene, camera, settings)
        for _ in range(2):
            start = time.process_time()
            values = jax.block_until_ready(sj.compute_irradiance(scene, plan, settings))
            seconds[name] = time.process_time() - start
        entering[name] = np.asarray(values.entering, float)
    error, mean = entering["coarse"] - entering["full"], np.mean(entering["full"])
    return {
        "body": body,
        "splats": count,
        "sky": sky,
        "coarse_seconds": seconds["coarse"],
        "full_seconds": seconds["full"],
        "splats_per_disc": plan_of(scene, camera),
        "rms_over_mean": float(np.sqrt(np.mean(error**2)) / mean),
        "mean_over_mean": float(np.mean(error) / mean),
        "largest_over_mean": float(np.max(np.abs(error)) / mean),
    }


def plan_of(scene: sj.Scene, camera: sj.Camera) -> int:
    (shadows,) = sj.make_plan(scene, camera, COARSE).shadows
    return shadows.splats_per_disc


def main() -> None:
    options, rows = arguments(), []
    for body, count in (("bust", options.bust), ("scanned", options.head)):
        for sky in SKIES:
            rows.append(compare(body, count, sky))
            print(rows[-1], flush=True)
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
