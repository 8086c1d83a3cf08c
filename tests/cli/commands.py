"""Files for the command line, and what it says when it fails."""

import numpy as np

from splatjax.cli import main

PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex {count}\n{properties}end_header\n"


def write_ply(path, rows, names):
    properties = "".join(f"property float {name}\n" for name in names)
    lines = [" ".join(f"{value}" for value in row) for row in rows]
    path.write_text(
        PLY_HEAD.format(count=len(rows), properties=properties) + "\n".join(lines) + "\n"
    )
    return path


def plate(path, radius=1.5):
    """Write an even plate of 20 x 20 mm that faces +z, without albedo."""
    places = np.linspace(-9.5, 9.5, 20)
    rows = [(x, y, 0, 0, 0, 1, radius, 1) for x in places for y in places]
    return write_ply(path, rows, ("x", "y", "z", "nx", "ny", "nz", "radius", "area"))


def failure(args, capsys, outputs=()):
    """Run a command that must fail; give its one line on stderr."""
    status = main([str(word) for word in args])
    captured = capsys.readouterr()
    assert status == 2
    assert captured.out == ""
    assert captured.err.startswith("splatjax: ")
    assert captured.err.count("\n") == 1
    for output in outputs:
        assert not output.exists()
    return captured.err


def ball(path, radius=10.0, count=300):
    """Write an even ball, without albedo. From all around it looks alike, so that one program
    serves every view.
    """
    z = 1 - (2 * np.arange(count) + 1) / count
    longitude = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - z * z)
    normals = np.stack([across * np.sin(longitude), z, across * np.cos(longitude)], axis=1)
    area = 4 * np.pi * radius**2 / count
    rows = [(*(radius * normal), *normal, 0.9 * np.sqrt(area), area) for normal in normals]
    return write_ply(path, rows, ("x", "y", "z", "nx", "ny", "nz", "radius", "area"))
