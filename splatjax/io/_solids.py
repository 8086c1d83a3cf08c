"""Meshes from STL and OFF files, which hold triangles and nothing else."""

from pathlib import Path

import numpy as np

from splatjax.geometry import triangulate

from ._pieces import Piece, check_places

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])


def read_stl(path: Path) -> list[Piece]:
    """Read an STL file, binary or text. Corners at one place become one vertex; its normals, of faces, are not used.

    **Raises:** `ValueError` when it is cut short, or no STL.
    """
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + _TRIANGLE.itemsize * count:
        triangles: np.ndarray = np.frombuffer(data, _TRIANGLE, count, 84)
        with np.errstate(invalid="ignore"):  # of NaN that signals
            corners = triangles["corners"].astype(np.float64)
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data:
        corners = _stl_text(path, data.decode("latin-1"))
    else:
        promised = 84 + _TRIANGLE.itemsize * count
        raise ValueError(f"{path}: promises {count} triangles, {promised} bytes, and has {len(data)}: it is cut short, or no STL")
    check_places(path, corners.reshape(-1, 3))
    vertices, faces = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return [Piece(vertices, faces.reshape(-1, 3))]


def _stl_text(path: Path, text: str) -> np.ndarray:
    rows = [words[1:] for line in text.splitlines() if (words := line.split()) and words[0].lower() == "vertex"]
    if len(rows) % 3 or not text.rstrip().splitlines()[-1].split()[0].lower().startswith("endsolid"):
        raise ValueError(f"{path}: ends within a triangle or without `endsolid`: it is cut short")
    return _numbers(path, rows, 3).reshape(-1, 3, 3)


def read_off(path: Path) -> list[Piece]:
    """Read an OFF file of polygons; colors are left alone.

    **Raises:** `ValueError` when it is cut short, no OFF, or names vertices that are not there.
    """
    lines = [line.split("#", 1)[0].split() for line in path.read_bytes().decode("latin-1").splitlines()]
    rows = [words for words in lines if words]
    if not rows or rows[0][0] != "OFF":
        raise ValueError(f"{path}: does not begin with `OFF`; give a plain OFF file")
    rows = [rows[0][1:], *rows[1:]] if len(rows[0]) > 1 else rows[1:]
    if not rows or len(rows[0]) < 2 or not all(word.isdecimal() and len(word) < 16 for word in rows[0][:2]):
        raise ValueError(f"{path}: says no counts of vertices and faces; write it again")
    vertices, faces = int(rows[0][0]), int(rows[0][1])
    if vertices + faces > len(rows) - 1:
        raise ValueError(
            f"{path}: promises {vertices + faces} vertices and faces, and {len(rows) - 1} lines follow: it is cut short"
        )
    places = _numbers(path, [row[:3] for row in rows[1 : 1 + vertices]], 3)
    check_places(path, places)
    polygons = []
    for row in rows[1 + vertices : 1 + vertices + faces]:
        size = int(row[0]) if row[0].isdecimal() and len(row[0]) < 9 else 0
        corners = [int(word) if word.isdecimal() and len(word) < 16 else -1 for word in row[1 : 1 + size]]
        if size < 3 or len(corners) < size or not all(0 <= corner < vertices for corner in corners):
            raise ValueError(f"{path}: the face `{' '.join(row)[:60]}` has no three corners or more among {vertices} vertices")
        polygons.append(corners)
    return [Piece(places, triangulate(places, polygons))]


def _numbers(path: Path, rows: list[list[str]], width: int) -> np.ndarray:
    try:
        found = np.asarray([[float(word) for word in row] for row in rows], np.float64).reshape(-1, width)
    except ValueError as error:
        raise ValueError(f"{path}: a vertex is not {width} numbers ({error}); write the file again") from None
    if len(found) != len(rows):
        raise ValueError(f"{path}: a vertex is not {width} numbers; write the file again")
    return found
