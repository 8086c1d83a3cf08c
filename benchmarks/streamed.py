"""A cloud larger than memory, streamed: `python -m benchmarks.streamed --splats 100000000`. Writes
out/streamed_*.png.

The cloud is written part by part (44 bytes a splat), if it is not there, and then drawn in a
process of its own. Where `--compare` is given, `render` draws it too, in another one, with all of
it in memory.
"""

import argparse
import concurrent.futures
import multiprocessing
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj

from .clouds import write_cloud
from .heads import HEADS, conditions

_NOT_PICTURES = ("weights", "unresolved_fraction", "overflow")


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.streamed", description=__doc__)
    parser.add_argument("--body", choices=HEADS, default="scanned", help="(default %(default)s)")
    parser.add_argument("--splats", type=int, default=10_000_000, help="(default %(default)s)")
    parser.add_argument(
        "--part", type=int, default=1_000_000, help="splats read at a time (default %(default)s)"
    )
    parser.add_argument(
        "--width",
        type=int,
        default=1024,
        help="of the square picture, pixels (default %(default)s)",
    )
    parser.add_argument(
        "--compare",
        action="store_true",
        help="with `render`, which takes about 1 kB of memory a splat",
    )
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path("out"),
        help="of clouds and pictures (default %(default)s)",
    )
    return parser.parse_args()


class Stages:
    """CPU time by what is done, of all threads: as `render_streamed` reports it."""

    def __init__(self, total: int):
        self.total, self.seconds, self.mark = total, {}, time.process_time()

    def __call__(self, what: str, done: int) -> None:
        now = time.process_time()
        self.seconds[what] = self.seconds.get(what, 0.0) + now - self.mark
        self.mark = now
        if done == self.total:
            print(f"  {what:30}{self.seconds[what]:9.0f} s", flush=True)


def peak() -> float:
    """Print the CPU time of this process, and give the most memory that it has held, GB."""
    print(f"  {'in all':30}{time.process_time():9.0f} s of CPU time", flush=True)
    text = Path("/proc/self/status").read_text(encoding="ascii")
    return 1e-6 * float(text.split("VmHWM:")[1].split()[0])


def written(path: Path, body: str, splats: int) -> float:
    """Write the cloud; give the most memory that it took, GB."""
    write_cloud(path, *HEADS[body](), splats)
    return peak()


def streamed(cloud: Path, out: Path, part: int, width: int) -> float:
    """Draw the cloud a part at a time, and write the frame; give the most memory that it
    took, GB.
    """
    light, camera = conditions(width)
    file = sj.SplatFile(cloud, part)
    stages = Stages(file.count)
    save(
        out,
        sj.render_streamed(file, (light,), sj.load_material("skin").white(), camera, report=stages),
    )
    stages("what the pixels show", file.count)
    return peak()


def in_memory(cloud: Path, out: Path, part: int, width: int) -> float:
    """Draw the cloud at once, and write the frame; give the most memory that it took, GB."""
    light, camera = conditions(width)
    splats = jax.tree.map(lambda *parts: jnp.concatenate(parts), *sj.SplatFile(cloud, part)())
    save(out, sj.render(sj.Scene(splats, (light,), sj.load_material("skin").white()), camera))
    return peak()


def save(out: Path, frame: sj.Frame) -> None:
    """Write a frame as a picture and as numbers."""
    sj.write_png(out.with_suffix(".png"), frame)
    found = {name: np.asarray(value) for name, value in vars(frame).items() if value is not None}
    np.savez(out, **{name: value for name, value in found.items() if name not in _NOT_PICTURES})


def compare(one: Path, other: Path) -> None:
    """Print by how much two frames differ: over the largest number of its kind, and of layers over
    their root mean square.
    """
    with np.load(one) as whole, np.load(other) as parts:
        for name in whole:
            if name == "layers":
                continue
            x, y = whole[name].astype(np.float64), parts[name].astype(np.float64)
            seen = np.isfinite(x) & np.isfinite(y)
            differ = int(np.sum(np.isfinite(x) != np.isfinite(y)))
            largest = np.max(np.abs(x[seen] - y[seen])) / np.max(np.abs(x[seen]))
            print(
                f"  {name:12}{largest:9.1e}"
                + (f", and {differ} pixels are finite in one alone" if differ else "")
            )
        for i, (x, y) in enumerate(zip(whole["layers"], parts["layers"], strict=True), 1):
            lit = np.any(x > 0, axis=2)
            off = np.abs(x - y).max(axis=2)[lit] / np.sqrt(np.mean(x[lit] ** 2))
            quantiles = ", ".join(f"{np.quantile(off, share):.1e}" for share in (0.5, 0.99, 1.0))
            print(f"  layer {i}: half of its pixels, 99% and all differ by less than {quantiles}")


def alone(task: Callable[..., float], *inputs) -> float:
    """Run something in a process of its own."""
    with concurrent.futures.ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as process:
        return process.submit(task, *inputs).result()


def main() -> None:
    options = arguments()
    options.folder.mkdir(exist_ok=True)
    cloud = options.folder / f"cloud_{options.body}_{options.splats}.ply"
    if not cloud.exists():
        print(f"writing {cloud}", flush=True)
        print(f"  {alone(written, cloud, options.body, options.splats):.1f} GB at most", flush=True)
    name = f"{options.body}_{options.splats}"
    ways = {"streamed": streamed} | ({"in_memory": in_memory} if options.compare else {})
    made = [options.folder / f"{way}_{name}.npz" for way in ways]
    for (way, draw), out in zip(ways.items(), made, strict=True):
        print(
            f"{way.replace('_', ' ')}: {options.splats:,} splats at {options.width}^2", flush=True
        )
        print(
            f"  {alone(draw, cloud, out, options.part, options.width):.1f} GB at most", flush=True
        )
    if options.compare:
        compare(*reversed(made))


if __name__ == "__main__":
    main()
