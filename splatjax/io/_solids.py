"""Meshes from STL and OFF files, which hold little but triangles."""

from io import BytesIO
from pathlib import Path

import numpy as np

from ._color import srgb_to_linear
from ._library import readable
from ._pieces import Piece, check_places
from ._polygons import check_fans, fan, merged

_OFF = ("OFF", "NOFF", "COFF", "CNOFF")


def read_stl(path: Path) -> list[Piece]:
    """Read an STL file, binary or text. Corners at one place become one vertex; its normals, of
    faces, are not used.

    **Raises:** `ValueError` when it is cut short, or no STL.
    """
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    if len(data) < 84 or len(data) != 84 + 50 * count:
        if data.lstrip()[:5].lower() != b"solid" or b"\0" in data:
            promised = f"promises {count} triangles, {84 + 50 * count} bytes, and has {len(data)}"
            raise ValueError(f"{path}: {promised}: it is cut short, or no STL")
        lines = [
            line.strip() for line in data.decode("latin-1").lower().splitlines() if line.strip()
        ]
        count = sum(line.split()[0] == "vertex" and len(line.split()) == 4 for line in lines) / 3
        if not lines[-1].startswith("endsolid"):
            raise ValueError(f"{path}: ends without `endsolid`: it is cut short")
        data = "\n".join(lines).encode()
    with readable(path, "STL"):
        from trimesh.exchange.stl import load_stl  # takes a second, so only where a mesh is read

        found = load_stl(BytesIO(data))
        parts = list(found["geometry"].values()) if "geometry" in found else [found]
        vertices = np.concatenate(
            [np.zeros((0, 3)), *(np.asarray(part["vertices"], np.float64) for part in parts)]
        )
        if len(vertices) != 3 * count:
            raise ValueError(
                f"{count:g} triangles were expected, and {len(vertices) / 3:g} were read"
            )
    check_places(path, vertices)
    kept, faces = merged(vertices, np.arange(len(vertices)).reshape(-1, 3))
    return [Piece(vertices[kept], faces)]


def read_off(path: Path) -> list[Piece]:
    """Read an OFF file of polygons, with normals and colors of its vertices where it begins with
    NOFF, COFF or CNOFF.

    Whole numbers are sRGB up to 255, others linear; colors of faces are left alone.

    trimesh reads it, given faces as triangles, for it passes over faces of less than three corners
    and does not look whether a line holds as many as it says.

    **Raises:** `ValueError` when it is cut short, no OFF, or names vertices that are not there.
    """
    lines = [
        line.split("#", 1)[0].split() for line in path.read_bytes().decode("latin-1").splitlines()
    ]
    rows = [words for words in lines if words]
    if not rows or rows[0][0] not in _OFF:
        raise ValueError(
            f"{path}: does not begin with `OFF`; give a plain OFF file, or one with "
            f"{', '.join(_OFF[1:])}"
        )
    kind = rows[0][0]
    rows = [rows[0][1:], *rows[1:]] if len(rows[0]) > 1 else rows[1:]
    if (
        not rows
        or len(rows[0]) < 2
        or not all(word.isdecimal() and len(word) < 16 for word in rows[0][:2])
    ):
        raise ValueError(f"{path}: says no counts of vertices and faces; write it again")
    count, faces = int(rows[0][0]), int(rows[0][1])
    if count + faces > len(rows) - 1:
        raise ValueError(
            f"{path}: promises {count + faces} vertices and faces, and {len(rows) - 1} lines "
            "follow: it is cut short"
        )
    triangles, counts = [], []
    for row in rows[1 + count : 1 + count + faces]:
        size = int(row[0]) if row[0].isdecimal() and len(row[0]) < 9 else 0
        if size < 3 or len(row) <= size or not all(word.isdecimal() for word in row[1 : 1 + size]):
            raise ValueError(
                f"{path}: the face `{' '.join(row)[:60]}` has no three corners or more among "
                f"{count} vertices"
            )
        triangles += [f"3 {a} {b} {c}" for a, b, c in fan(row[1 : 1 + size])]
        counts.append(size - 2)
    normals, colors = _off_columns(path, kind, rows[1 : 1 + count])
    places = [row if kind == "OFF" else row[:3] for row in rows[1 : 1 + count]]
    plain = ["OFF", f"{count} {len(triangles)} 0", *(" ".join(row) for row in places), *triangles]
    with readable(path, "OFF"):
        from trimesh.exchange.off import load_off  # takes a second, so only where a mesh is read

        found = load_off(BytesIO("\n".join(plain).encode()))
    vertices = np.asarray(found["vertices"], np.float64)
    check_places(path, vertices)
    check_fans(path, vertices[found["faces"]], np.asarray(counts, np.int64))
    return [Piece(vertices, found["faces"], normals, None, colors)]


def _off_columns(
    path: Path, kind: str, rows: list[list[str]]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Give normals and linear colors of vertices, as far as the kind of file has them."""
    first = 6 if "N" in kind else 3  # of the colors' columns
    widths = {first + 3, first + 4} if "C" in kind else {first}
    if kind == "OFF":
        return None, None
    if len({len(row) for row in rows}) != 1 or len(rows[0]) not in widths:
        raise ValueError(
            f"{path}: its vertices have not all the {min(widths)} numbers of {kind}; write it again"
        )
    words = [row[3:] for row in rows]
    with readable(path, "OFF"):
        values = np.asarray(words, np.float64)
    normals, colors = values[:, : first - 3], values[:, first - 3 : first]
    whole = all(word.isdecimal() for row in words for word in row[first - 3 : first])
    if not (colors >= 0).all() or not (colors <= (255 if whole else 1)).all():
        raise ValueError(
            f"{path}: has colors of vertices that reach {colors.max():g}; write whole numbers up "
            "to 255, or up to 1.0"
        )
    return normals if "N" in kind else None, None if "C" not in kind else srgb_to_linear(
        colors / 255
    ) if whole else colors
