"""Meshes from Wavefront OBJ files, with the materials of their MTL files."""

import warnings
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from splatjax.geometry import triangulate

from ._color import srgb_to_linear
from ._files import file_beside
from ._pictures import read_color
from ._pieces import Piece, check_places

_CURVES = {"curv", "curv2", "surf", "bzp", "bsp", "cdc", "cdp", "res"}


class _Corners(NamedTuple):
    """What stands at each corner of a face, and the tables that corners point into; -1 where they point nowhere."""

    places: np.ndarray
    colors: np.ndarray | None
    coordinates: np.ndarray
    normals: np.ndarray
    indices: np.ndarray


def read_obj(path: Path) -> list[Piece]:
    """Read the polygons of an OBJ file, cut into triangles: a piece for each material.

    **Raises:** `ValueError` for numbers that are none, faces that name what is not there, and surfaces that are no polygons.
    """
    text = path.read_bytes().decode("utf-8", "replace").replace("\\\r\n", " ").replace("\\\n", " ")
    tables: dict[str, list[str]] = {"v": [], "vt": [], "vn": []}
    seen: dict[str, int] = {}
    faces: dict[str, list[list[int]]] = {}
    libraries: list[str] = []
    current = faces.setdefault("", [])
    for line in text.splitlines():
        kind, _, rest = line.split("#", 1)[0].strip().replace("\t", " ").partition(" ")
        if kind in tables:
            tables[kind].append(rest)
        elif kind == "f":
            words = [_absolute(word, tables) for word in rest.split()] if "-" in rest else rest.split()
            if len(words) < 3:
                raise ValueError(f"{path}: the face `{line[:60]}` has less than three corners; write the file again")
            current.append([seen.setdefault(word, len(seen)) for word in words])
        elif kind == "usemtl":
            current = faces.setdefault(rest.strip(), [])
        elif kind == "mtllib":
            libraries.append(rest.strip())
        elif kind in _CURVES:
            raise ValueError(f"{path}: has curved surfaces ({kind}), which are not read here; export polygons")
    corners = _corners(path, tables, list(seen))
    materials = _materials(path, libraries) if any(faces) else {}
    return [_piece(path, polygons, corners, materials.get(name, {})) for name, polygons in faces.items() if polygons]


def _absolute(word: str, tables: dict[str, list[str]]) -> str:
    """Count what is counted from the end, -1 for the last that stands above, from the beginning."""
    parts = word.split("/")
    for i, (part, above) in enumerate(zip(parts, tables.values(), strict=False)):
        if part[:1] == "-" and part[1:].isdecimal():
            parts[i] = str(len(above) + 1 - int(part[1:]))
    return "/".join(parts)


def _table(path: Path, name: str, rows: list[str], least: int) -> np.ndarray:
    """Give the numbers of rows; those that have fewer are filled up with NaN, as of `vt u` or the colors of some vertices."""
    try:
        return np.loadtxt(rows, np.float64, comments=None, ndmin=2) if rows else np.zeros((0, least))
    except ValueError:
        pass
    cells = [row.split() for row in rows]
    width = max(least, *map(len, cells))
    table = np.full((len(rows), min(width, 7)), np.nan)
    try:
        for i, row in enumerate(cells):
            table[i, : len(row)] = [float(cell) for cell in row]
    except ValueError as error:
        raise ValueError(f"{path}: `{name} {rows[i][:60]}` is no row of {least} numbers ({error})") from None
    return table


def _corners(path: Path, tables: dict[str, list[str]], words: list[str]) -> _Corners:
    places, coordinates, normals = (_table(path, name, tables[name], least) for name, least in (("v", 3), ("vt", 2), ("vn", 3)))
    if places.shape[1] < 3 or coordinates.shape[1] < 2 or normals.shape[1] < 3:
        raise ValueError(f"{path}: its v, vt and vn need three, two and three numbers; write the file again")
    counts = (len(places), len(coordinates), len(normals))
    indices = np.full((len(words), 3), -1)
    for i, word in enumerate(words):
        parts = word.split("/")
        for j, part in enumerate(parts):
            if part and part.isdecimal() and len(part) < 16 and j < 3 and 1 <= int(part) <= counts[j]:
                indices[i, j] = int(part) - 1
            elif part or j == 0:
                name = "v", "vt", "vn", "that"
                have = f"there are {counts[j]} {name[j]}" if j < 3 else "a corner is v/vt/vn"
                raise ValueError(f"{path}: a corner of a face is `{word[:60]}`, but {have}; write the file again")
    check_places(path, places[:, :3])
    colors = None
    if places.shape[1] >= 6 and np.isfinite(places[:, 3:6]).all():
        if places[:, 3:6].min() < 0 or places[:, 3:6].max() > 1:
            raise ValueError(f"{path}: colors of vertices range up to {places[:, 3:6].max():g}; they are sRGB in [0, 1]")
        colors = srgb_to_linear(places[:, 3:6])
    return _Corners(places[:, :3], colors, coordinates[:, :2], normals[:, :3], indices)


def _piece(path: Path, polygons: list[list[int]], corners: _Corners, dress: dict) -> Piece:
    triangles = corners.indices[triangulate(corners.places[corners.indices[:, 0]], polygons)]
    # A vertex for each pair of place and normal, so that creases stay sharp; texture coordinates belong to corners.
    pairs, faces = np.unique(triangles[..., [0, 2]].reshape(-1, 2), axis=0, return_inverse=True)
    normals = uvs = None
    if (pairs[:, 1] >= 0).any():
        normals = np.where(pairs[:, 1:] >= 0, corners.normals[pairs[:, 1]], 0.0)
    if (triangles[..., 1] >= 0).all():
        uvs = corners.coordinates[triangles[..., 1]]
    colors = None if corners.colors is None else corners.colors[pairs[:, 0]]
    return Piece(corners.places[pairs[:, 0]], faces.reshape(-1, 3), normals, uvs, colors, **dress)


def _materials(path: Path, libraries: list[str]) -> dict[str, dict]:
    """Give what the materials of the files beside dress their faces in: a texture, or a plain color where others have one."""
    materials: dict[str, dict] = {}
    for name in libraries:
        try:
            library = file_beside(path, name)
        except FileNotFoundError as error:
            warnings.warn(f"{error}; no texture is worn", stacklevel=2)
            continue
        current: dict = {}
        for line in library.read_bytes().decode("utf-8", "replace").splitlines():
            kind, _, rest = line.split("#", 1)[0].strip().replace("\t", " ").partition(" ")
            match kind.lower():
                case "newmtl":
                    current = materials.setdefault(rest.strip(), {})
                case "kd" if "texture" not in current:
                    current["color"] = _color(library, rest)
                case "map_kd":
                    current["texture"] = partial(_texture, library, rest)
                    current["color"] = (1.0, 1.0, 1.0)  # programs that lay a map leave a gray Kd behind
    return materials


def _color(library: Path, rest: str) -> tuple[float, ...]:
    try:
        color = tuple(float(word) for word in rest.split())
    except ValueError:
        color = ()
    if len(color) not in (1, 3) or not all(0 <= share <= 1 for share in color):
        raise ValueError(f"{library}: `Kd {rest[:60]}` is no color; give three numbers in [0, 1]")
    return color * (3 // len(color))


def _texture(library: Path, rest: str) -> np.ndarray:
    if rest.strip()[:1] == "-":
        raise ValueError(f"{library}: `map_Kd {rest[:60]}` lays its texture with options, which are not read; bake them")
    return read_color(file_beside(library, rest.strip()))
