"""How a frame's time and memory grow with splats and pixels: `python -m benchmarks.scale`. Writes out/scale.json.

Each size runs in a process of its own, whose greatest resident memory is told: with planning, compiling and the scene itself.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

import splatjax as sj

from .__main__ import head
from .yardstick import Yardstick, make_scene

SIZES = [(10_000, 512), (100_000, 512), (100_000, 1024), (683_549, 512), (683_549, 1024), (683_549, 2048), (10_000_000, 2048)]
GOALS = {(100_000, 512): 6.0, (683_549, 1024): 5.0}  # in yardsticks of that size


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--one", type=int, nargs=2, metavar=("SPLATS", "WIDTH"), help="this size alone, in this process")
    parser.add_argument("--repeats", type=int, default=5, help="frames of which the median is given (default %(default)s)")
    return parser.parse_args()


def measured(splats: int, width: int, repeats: int) -> dict[str, float | int | None]:
    """Plan, compile and time a frame of all five passes in six layers."""
    data = make_scene(splats)
    scene, camera = head(data, width)

    def seconds(function) -> float:
        start = time.perf_counter()
        jax.block_until_ready(function())
        return time.perf_counter() - start

    seconds(lambda: sj.plan(scene, camera).interval)
    planned = seconds(lambda: sj.plan(scene, camera).interval)
    plan = sj.plan(scene, camera)
    if float(sj.render(scene, camera, plan=plan).overflow) > 0:
        raise SystemExit(f"{splats} splats at {width}^2: the plan does not hold its own scene")
    times, yard = [], []
    with tempfile.TemporaryDirectory() as folder:
        yardstick = Yardstick.build(Path(folder), data, width)
        for _ in range(repeats):
            if yardstick is not None:
                yard.append(yardstick.milliseconds())
            times.append(1e3 * seconds(lambda: sj.render(scene, camera, plan=plan)))
    unit = float(np.median(yard)) if yard else None
    value = float(np.median(times))
    return {
        "name": "all five passes",
        "splats": splats,
        "width": width,
        "milliseconds": value,
        "yardstick_milliseconds": unit,
        "ratio": value / unit if unit else None,
        "planning_milliseconds": 1e3 * planned,
        "peak_gigabytes": 1e-6 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "goal": GOALS.get((splats, width)),
    }


def main() -> None:
    options = arguments()
    if options.one:
        print(json.dumps(measured(*options.one, options.repeats)))
        return
    print(f"{'splats':>12}{'width':>7}{'ms':>9}{'ratio':>8}{'goal':>7}{'ns per splat':>14}{'planning, ms':>14}{'peak, GB':>10}")
    rows = []
    for splats, width in SIZES:
        command = [sys.executable, "-m", "benchmarks.scale", "--one", str(splats), str(width), "--repeats", str(options.repeats)]
        row = json.loads(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()[-1])
        rows.append(row)
        ratio, goal = (f"{row[name]:.1f}" if row[name] else "" for name in ("ratio", "goal"))
        numbers = f"{1e6 * row['milliseconds'] / splats:14.0f}{row['planning_milliseconds']:14.0f}{row['peak_gigabytes']:10.2f}"
        print(f"{splats:12,}{width:7}{row['milliseconds']:9.0f}{ratio:>8}{goal:>7}{numbers}", flush=True)
    out = Path("out/scale.json")
    out.parent.mkdir(exist_ok=True)
    out.write_text(json.dumps(rows, indent=1) + "\n")
    print(f"\nwritten: {out}")


if __name__ == "__main__":
    main()
