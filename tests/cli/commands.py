"""Files for the command line, and how tests run it."""

from pathlib import Path

from bodies import sheet, sphere

import splatjax as sj
from splatjax.cli import main

SCRIPT = Path(__file__).with_name("one_process.py")


def run(*words):
    return main([str(word) for word in words])


def failure(words, capsys):
    """Run a command that must fail with status 2; return its one line on stderr."""
    assert run(*words) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert captured.err.startswith("splatjax: ")
    return captured.err


def plate(path):
    sj.write_splats(path, sheet(9.5, 1.0))
    return path


def ball(path, radius=10.0, count=300):
    """Write an even ball, without albedo. From all around it looks alike, so that one program
    serves every view.
    """
    sj.write_splats(path, sphere(count, radius, jitter=0.0))
    return path


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def frame_names(*numbers):
    return {f"frame_{i:04}.{suffix}" for i in numbers for suffix in ("exr", "png")}
