"""Meshes from Wavefront OBJ files, with the materials of their MTL files."""

import warnings
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ._color import srgb_to_linear
from ._files import file_beside
from ._library import readable
from ._pictures import read_color
from ._pieces import Piece, check_places
from ._polygons import check_fans, fan, merged

_TABLES = {"v": range(3, 8), "vt": range(2, 4), "vn": range(3, 4)}
_CURVES = {"curv", "curv2", "surf", "bzp", "bsp", "cdc", "cdp", "res"}


_Corner = tuple[str, tuple[bool, ...]]
"""A corner as trimesh is to read it, and which tables it names."""


class _Part:
    """Faces of one material whose corners name the same tables."""

    def __init__(self):
        self.lines: list[str] = []
        self.counts: list[int] = []


def read_obj(path: Path) -> list[Piece]:
    """Read the polygons of an OBJ file, cut into triangles: a piece for each material and kind of
    corner.

    trimesh reads the numbers; it is given faces as triangles that count from the beginning, sorted
    by the tables that their corners name, for it takes the first face's for all and does not look
    whether what a face names is there.

    **Raises:** `ValueError` for numbers that are none, faces that name what is not there, faces
    that are not convex, and surfaces that are no polygons.
    """
    text = path.read_bytes().decode("utf-8", "replace").replace("\\\r\n", " ").replace("\\\n", " ")
    rows: dict[str, list[str]] = {name: [] for name in _TABLES}
    parts: dict[tuple[str, tuple[bool, ...]], _Part] = {}
    known: dict[str, _Corner] = {}
    most, material, libraries = [0, 0, 0], "", []
    for line in text.splitlines():
        kind, _, rest = line.split("#", 1)[0].strip().replace("\t", " ").partition(" ")
        if kind in rows:
            if (
                len(rest.split()) not in _TABLES[kind] or "_" in rest
            ):  # Python's 1_0 is no number elsewhere
                raise ValueError(
                    f"{path}: `{line[:60]}` is no row of {_TABLES[kind][0]} numbers; write the "
                    "file again"
                )
            rows[kind].append(f"{kind} {rest.strip()}")
        elif kind == "f":
            corners = [
                known.get(word) or _corner(path, word, rows, most, known) for word in rest.split()
            ]
            shapes = {shape for _, shape in corners}
            if len(corners) < 3 or len(shapes) > 1:
                what = "less than three corners" if len(corners) < 3 else "corners of several kinds"
                raise ValueError(f"{path}: the face `{line[:60]}` has {what}; write the file again")
            part = parts.setdefault((material, shapes.pop()), _Part())
            part.lines += [f"f {a} {b} {c}" for a, b, c in fan([corner for corner, _ in corners])]
            part.counts.append(len(corners) - 2)
        elif kind == "usemtl":
            material = rest.strip()
        elif kind == "mtllib":
            libraries.append(rest.strip())
        elif kind in _CURVES:
            raise ValueError(
                f"{path}: has curved surfaces ({kind}), which are not read here; export polygons"
            )
    for name, named in zip(_TABLES, most, strict=True):
        if named > len(rows[name]):
            raise ValueError(
                f"{path}: a face names {name} {named}, but there are {len(rows[name])} {name}; "
                "write the file again"
            )
    if not parts:
        return []
    plain = [line for table in rows.values() for line in table]
    for number, part in enumerate(parts.values()):
        plain += [f"g {number}", *part.lines]
    with readable(path, "OBJ"):
        from trimesh.exchange.obj import load_obj  # takes a second, so only where a mesh is read

        data = BytesIO("\n".join(plain).encode())
        found = load_obj(data, split_groups=True, group_material=False, skip_materials=True)[
            "geometry"
        ]
        materials = _materials(path, libraries)
        return [
            _piece(path, found[str(number)], part.counts, materials.get(name, {}))
            for number, ((name, _), part) in enumerate(parts.items())
        ]


def _corner(
    path: Path, word: str, rows: dict[str, list[str]], most: list[int], known: dict[str, _Corner]
) -> _Corner:
    """Count what a corner `v/vt/vn` names from the beginning, also where -1 is the last that stands
    above.
    """
    parts = word.split("/")
    try:
        if "_" in word:
            raise ValueError
        numbers = [int(part) if part else 0 for part in parts]
        places = [
            n if n >= 0 else len(above) + 1 + n
            for n, above in zip(numbers, rows.values(), strict=False)
        ]
        if (
            len(parts) > 3
            or any(part and place < 1 for part, place in zip(parts, places, strict=True))
            or not parts[0]
        ):
            raise ValueError
    except ValueError:
        raise ValueError(
            f"{path}: a corner of a face is `{word[:60]}`, which names nothing; write the file "
            "again"
        ) from None
    for i, place in enumerate(places):
        most[i] = max(most[i], place)
    shape = tuple(place > 0 for place in (*places, 0, 0)[:3])
    corner = "/".join(str(place) if place else "" for place in places).rstrip("/"), shape
    if "-" not in word:
        known[word] = corner
    return corner


def _piece(path: Path, found: dict[str, Any], counts: list[int], dress: dict[str, Any]) -> Piece:
    vertices, faces, visual = found["vertices"], found["faces"], found["visual"]
    check_places(path, vertices)
    check_fans(path, vertices[faces], np.asarray(counts))
    uvs = None if visual is None else visual.uv[faces]
    normals, colors = found.get("vertex_normals"), found.get("vertex_colors")
    if colors is not None:
        if not (colors.min() >= 0 and colors.max() <= 1):
            raise ValueError(
                f"{path}: colors of vertices range up to {colors.max():g}; they are sRGB in [0, 1]"
            )
        colors = srgb_to_linear(colors)
    if normals is None and uvs is not None:  # texture coordinates make no creases
        kept, faces = merged(vertices, faces)
        vertices, colors = vertices[kept], None if colors is None else colors[kept]
    return Piece(vertices, faces, normals, uvs, colors, **dress)


def _materials(path: Path, libraries: list[str]) -> dict[str, dict]:
    """Give what the materials of the files beside dress their faces in: a texture, or a plain color
    where others have one.
    """
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
                    current["color"] = (
                        1.0,
                        1.0,
                        1.0,
                    )  # programs that lay a map leave a gray Kd behind
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
        raise ValueError(
            f"{library}: `map_Kd {rest[:60]}` lays its texture with options, which are not read; "
            "bake them"
        )
    return read_color(file_beside(library, rest.strip()))
