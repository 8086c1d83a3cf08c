"""Kill processes at random moments while they write, and look at what they leave: `python
tools/kill_writers.py [kills]`.

For each kind of file, processes write it again and again, in two versions that differ, and are
killed after a random time. After each kill the file must be one of the two versions, whole, and the
next write must leave nothing of the one that was killed. A turntable, whose pictures are noise here
so that it does nothing but write, is killed as often; in the end the same command must make of its
folder what it makes of an empty one.
"""

import hashlib
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import splatjax as sj
from splatjax.cli import _turntable, main as splatjax
from splatjax.io import save_material, write_exr, write_png, write_record, write_splats
from splatjax.scene import Frame, Material, Splats

KILLS = 50
SEED = 7
LONGEST = {".exr": 0.5, ".png": 0.3, ".ply": 0.1, ".toml": 0.1, ".json": 0.1}
"""Seconds until a kill, at most: some writes of each kind."""

TURNTABLE = [
    "turntable",
    "--count",
    "300",
    "--width",
    "64",
    "--height",
    "64",
    "--frames",
    "40",
    "--no-scattering",
]


def frame(seed: int, size: int = 300) -> Frame:
    """Give a frame of noise; NumPy arrays, so that nothing but writing takes time."""
    noise = np.random.default_rng(seed).uniform(size=(size, size, 3)).astype(np.float32)
    gray, weights = noise[..., 0], np.ones((1, 3), np.float32)
    more = {
        "diffuse": noise,
        "specular": noise,
        "handed_over": weights[0, :1],
        "overflow": np.float32(0),
    }
    return Frame(
        noise, gray, gray, noise, noise, noise, gray[None], noise, noise[None], weights, **more
    )  # ty: ignore


def writers(path: Path) -> dict[str, Callable[[int], None]]:
    """Give what writes either version of each kind of file."""
    points = np.random.default_rng(0).normal(size=(60_000, 3))
    clouds = [
        Splats(points, points, radii, radii)
        for radii in (np.full(60_000, 1.0), np.full(60_000, 2.0))
    ]  # ty: ignore
    frames = [frame(0), frame(1)]
    skin = Material(sj.SumOfGaussians(np.ones(1), np.ones((1, 3))), 1.4, 0.1, 0.3)  # ty: ignore
    return {
        ".exr": lambda k: write_exr(path.with_suffix(".exr"), frames[k]),
        ".png": lambda k: write_png(path.with_suffix(".png"), frames[k]),
        ".ply": lambda k: write_splats(path.with_suffix(".ply"), clouds[k]),
        ".toml": lambda k: save_material(
            skin, path.with_suffix(".toml"), source={"citation": "ab"[k] * 300_000}
        ),
        ".json": lambda k: write_record(path.with_suffix(".json"), {"x": "ab"[k] * 300_000}),
    }


def kill_after(seconds: float, work: Callable[[], object]) -> bool:
    """Do something in a process of its own, and kill it after some time; tell whether it was still
    at work.
    """
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        work()
        os._exit(0)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1] == signal.SIGKILL


def kill_writer(suffix: str, kills: int, chance: random.Random) -> int:
    """Kill writers of files of one kind; give how often what they left was not as it should be."""
    with tempfile.TemporaryDirectory() as made:
        path = Path(made) / f"a{suffix}"
        write = writers(path)[suffix]
        versions = set()
        for k in (0, 1):
            write(k)
            versions.add(_digest(path))

        def again_and_again() -> None:
            while True:
                write(0)
                write(1)

        spoilt = left = litter = 0
        for _ in range(kills):
            kill_after(chance.uniform(0, LONGEST[suffix]), again_and_again)
            spoilt += not path.exists() or _digest(path) not in versions
            left += len(list(path.parent.iterdir())) - 1
            write(0)
            litter += len(list(path.parent.iterdir())) != 1
    print(
        f"{suffix}: {kills} kills, {left} within a write; {spoilt} files spoilt or lost, {litter} "
        "leftovers after the next write"
    )
    return spoilt + litter


def _make_turntable_write_noise() -> None:
    # ty: ignore
    splats = Splats(*(np.ones(shape) for shape in ((300, 3), (300, 3), (300,), (300,))))
    _turntable.Turntable.load = lambda self: (splats, sj.load_material("skin"))  # ty: ignore
    sj.plan = lambda scenes, cameras: None  # ty: ignore
    _turntable.draw = lambda scene, camera, plan: frame(
        round(1e3 * float(abs(camera.position).sum())), 64
    )  # ty: ignore


def kill_turntable(kills: int, chance: random.Random) -> int:
    """Kill a turntable, each time after some frames were taken away; compare with one that nobody
    killed.
    """
    with tempfile.TemporaryDirectory() as made:
        whole, killed = Path(made) / "whole", Path(made) / "killed"

        def turn(folder: Path) -> Callable[[], object]:
            def run() -> None:
                _make_turntable_write_noise()
                os._exit(splatjax([*TURNTABLE, "--output", str(folder)]))

            return run

        begin = time.monotonic()
        _whole(turn(whole))
        longest = time.monotonic() - begin
        expected = {path.name: _digest(path) for path in whole.iterdir()}
        wrong = at_work = litter = 0
        for _ in range(kills):
            at_work += kill_after(longest * chance.uniform(0.2, 1.0), turn(killed))
            there = list(killed.iterdir()) if killed.is_dir() else []
            wrong += sum(
                _digest(path) != expected[path.name] for path in there if path.name[0] != "."
            )
            litter += sum(path.name[0] == "." for path in there)
            for path in chance.sample(there, len(there) // 2):
                if path.name[:6] == "frame_":
                    path.unlink()
        _whole(turn(killed))
        wrong += {path.name: _digest(path) for path in killed.iterdir()} != expected
    print(
        f"turntable: {kills} kills, {at_work} at work, {litter} within a write; {wrong} files or "
        "folders wrong in the end",
        flush=True,
    )
    return wrong


def _whole(work: Callable[[], object]) -> None:
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
        work()
    assert os.waitpid(child, 0)[1] == 0


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def main() -> None:
    """Kill writers of every kind."""
    kills = int(sys.argv[1]) if len(sys.argv) > 1 else KILLS
    chance = random.Random(SEED)
    wrong = [
        kill_turntable(kills, chance)
    ]  # first: processes cannot be forked to compute once JAX has begun to
    wrong += [kill_writer(suffix, kills, chance) for suffix in LONGEST]
    sys.exit(1 if any(wrong) else 0)


if __name__ == "__main__":
    main()
