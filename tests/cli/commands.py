"""Files for the command line, and how tests run it."""

import numpy as np

import splatjax as sj
from splatjax.cli import main


def run(*words):
    return main([str(word) for word in words])


def failure(words, capsys):
    """Run a command that must fail with status 2; return its one line on stderr."""
    assert run(*words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("splatjax: ")
    assert captured.err.count("\n") == 1
    return captured.err


def plate(path):
    places = np.linspace(-9.5, 9.5, 20)
    y, x = map(np.ravel, np.meshgrid(places, places, indexing="ij"))
    normals = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    sj.write_splats(path, sj.Splats(np.stack([x, y, 0 * x], axis=1), normals, 1.5, 1.0))
    return path


def ball(path, radius=10.0, count=300):
    """Write an even ball, without albedo. From all around it looks alike, so that one program
    serves every view.
    """
    z = 1 - (2 * np.arange(count) + 1) / count
    longitude = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - z * z)
    normals = np.stack([across * np.sin(longitude), z, across * np.cos(longitude)], axis=1)
    area = 4 * np.pi * radius**2 / count
    sj.write_splats(path, sj.Splats(radius * normals, normals, 0.9 * np.sqrt(area), area))
    return path


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def frame_names(*numbers):
    return {f"frame_{i:04}.{suffix}" for i in numbers for suffix in ("exr", "png")}
