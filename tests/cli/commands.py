"""Files for the command line, and how tests run it."""

import numpy as np

from splatjax.cli import main


def run(*words):
    """Run a command; return its exit status."""
    return main([str(word) for word in words])


def failure(words, capsys):
    """Run a command that must fail with status 2; return its one line on stderr."""
    assert run(*words) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("splatjax: ")
    assert captured.err.count("\n") == 1
    return captured.err


def write_ply(path, rows, names):
    properties = [f"property float {name}" for name in names]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}", *properties, "end_header"]
    path.write_text("\n".join([*head, *(" ".join(map(str, row)) for row in rows)]) + "\n")
    return path


def write_splats(path, centers, normals, radius, area):
    rows = [
        (*center, *normal, radius, area) for center, normal in zip(centers, normals, strict=True)
    ]
    return write_ply(path, rows, ("x", "y", "z", "nx", "ny", "nz", "radius", "area"))


def plate(path):
    """Write an even plate of 20 x 20 mm that faces +z, without albedo."""
    places = np.linspace(-9.5, 9.5, 20)
    centers = [(x, y, 0) for x in places for y in places]
    return write_splats(path, centers, len(centers) * [(0, 0, 1)], 1.5, 1)


def ball(path, radius=10.0, count=300):
    """Write an even ball, without albedo. From all around it looks alike, so that one program
    serves every view.
    """
    z = 1 - (2 * np.arange(count) + 1) / count
    longitude = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    across = np.sqrt(1 - z * z)
    normals = np.stack([across * np.sin(longitude), z, across * np.cos(longitude)], axis=1)
    area = 4 * np.pi * radius**2 / count
    return write_splats(path, radius * normals, normals, 0.9 * np.sqrt(area), area)
