"""Reading of files by trimesh. Contents that trimesh would misread are detected first, its
exceptions become one-sentence errors, and ignored contents cause a warning.
"""

import json
import logging
import re
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
from PIL import Image

# Suffixes of meshes.
FORMATS = ("glb", "gltf", "obj", "off", "ply", "stl")
_OBJ_CORNER = rb"[1-9]\d*(?:/(?:[1-9]\d*)?(?:/(?:[1-9]\d*)?)?)?"
_OBJ_READ = rb"v[tn]?(?: +[^\s/_]+){2,7} *|f(?: +%s){3,} *" % _OBJ_CORNER
_GLTF = rb"""
    "extensionsRequired"\s*:\s*\[[^]]*"(?!EXT_texture_webp"|KHR_lights_punctual"|KHR_materials_)\w+"
    |"KHR_materials_pbrSpecularGlossiness"\s*: | "sparse"\s*:\s*{ | "mode"\s*:\s*6
    |"image/(?!png"|jpeg"|webp")[^"]*"
    |"baseColorTexture"\s*:\s*{[^{}]*(?:"texCoord"\s*:\s*[1-9]|{\s*"KHR_texture_transform")
    """
# Contents that trimesh ignores or misreads: compressed, transformed and multiple textures, fans,
# curves, polygons with fewer than three corners, and solids without an end.
_UNREAD = {
    "gltf": re.compile(_GLTF, re.VERBOSE),
    "obj": re.compile(
        rb"^(?!(?:%s)$)[ \t]*(?:f|v[tn]?|curv2?|surf|bzp|bsp)(?:[ \t].*)?$" % _OBJ_READ
        + rb"|^mtllib (?=(?s:.*)\nmtllib )",
        re.MULTILINE,
    ),
    "ply": re.compile(rb"comment texturefile.*comment texturefile", re.DOTALL | re.IGNORECASE),
    "stl": re.compile(rb"\A\s*solid(?!.*\bendsolid[^\n]*\s*\Z)", re.DOTALL | re.IGNORECASE),
}
_FLOAT = 5126


def _count_obj(text: bytes) -> int:
    faces = re.findall(rb"^f .*", text, re.MULTILINE)
    if {b"/", b"//"} <= set(b" ".join(faces).translate(None, b"0123456789").split()):
        raise ValueError("it mixes faces of v/vt and v//vn")
    return sum(len(face.split()) - 3 for face in faces)


def _count_off(text: bytes) -> int:
    rows = [row for line in text.splitlines() if (row := line.split(b"#")[0].split())]
    vertices, polygons = (int(word) for word in rows[1][:2])
    promised = rows[2 + vertices : 2 + vertices + polygons]
    if rows[0] != [b"OFF"] or len(promised) != polygons:
        raise ValueError(f"it has no OFF header, or not its {vertices} + {polygons} rows")
    return sum(int(row[0]) - 2 for row in promised)


def _check_gltf(text: bytes) -> None:
    content = json.loads(text)
    primitives = [
        primitive for mesh in content.get("meshes", []) for primitive in mesh["primitives"]
    ]
    for name in ("POSITION", "TEXCOORD_0"):
        used = {primitive["attributes"].get(name) for primitive in primitives} - {None}
        if any(content["accessors"][i]["componentType"] != _FLOAT for i in used):
            raise ValueError("its vertices are quantized")


# Number of triangles that a file declares, for formats that declare it.
_COUNTS = {"obj": _count_obj, "off": _count_off, "gltf": _check_gltf}


def _count_triangles(kind: str, data: bytes) -> int | None:
    """Return the declared number of triangles; raise for contents that trimesh would misread."""
    if kind == "glb":
        kind, text = "gltf", data[20:][: int.from_bytes(data[12:16], "little")]
    elif kind == "stl" and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little"):
        text = b""  # a binary file
    elif kind == "ply":
        text = data.partition(b"end_header")[0]
    else:
        text = data.replace(b"\r\n", b"\n").replace(b"\\\n", b" ")
    is_lines = kind in ("obj", "off") or (kind == "ply" and b"format ascii" in text)
    if is_lines and not data.endswith((b"\n", b"\r")):
        raise ValueError("its last line has no end")
    if kind in _UNREAD and (unread := _UNREAD[kind].search(text)):
        raise ValueError(f"`{unread[0][:200].decode(errors='replace')}` is not read")
    return _COUNTS[kind](text) if kind in _COUNTS else None


@contextmanager
def one_sentence(path: Path) -> Generator[None, None, None]:
    """Convert exceptions of a library to errors that name the file, the reason and the remedy.

    **Raises:** `ValueError`; errors that already name the file pass unchanged.
    """
    log = logging.getLogger("trimesh")  # it logs errors and ignored contents
    before = log.level
    log.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's, for words among numbers
            yield
    except Exception as error:  # readers raise exceptions of any kind
        if isinstance(error, (ValueError, OSError)) and str(error).startswith(str(path)):
            raise
        if isinstance(error, ValueError) and "; " in str(error):  # with its remedy
            raise ValueError(f"{path}: {error}") from None
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__} "
        raise ValueError(
            f"{path}: cannot be read ({kind}{' '.join(str(error).split())[:200]}); it is "
            "truncated, or of an unsupported kind; re-export it"
        ) from None
    finally:
        log.setLevel(before)


def load_with_trimesh(path: Path, kind: str) -> dict[str, Any]:
    """Read a file of a given kind by trimesh.

    Missing or unreadable pictures and materials are ignored with a warning.

    **Returns:** the arguments of the meshes, as in the file; `contents`, the bytes of the file;
    `triangles`, the declared number, or `None`; and `columns`, the properties of each element of a
    PLY file.

    **Raises:** `ValueError` for contents that trimesh would misread, and if it reads fewer rows
    than a PLY file declares.
    """
    from trimesh.exchange import load  # takes a second, so imported only here

    folder, data = _Folder(path), path.read_bytes()
    loaders, count = cast(dict[str, Any], load.mesh_loaders), _count_triangles(kind, data)
    content = loaders[kind](BytesIO(data), resolver=folder, fix_texture=False)
    columns = {
        name: _columns(name, element)
        for name, element in content.get("metadata", {}).get("_ply_raw", {}).items()
    }
    for fault in folder.faults:
        warnings.warn(f"{path}: {fault}, and its colors are ignored", stacklevel=2)
    return content | {"triangles": count, "contents": data, "columns": columns}


def _columns(name: str, element: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the properties of an element of a PLY file, with a number or a list per row."""
    columns = {}
    for key in element["properties"] if element["length"] else ():
        column = np.asarray(element["data"][key])
        if column.dtype.names:
            sizes, column = column["f0"], column["f1"]
            if np.ptp(sizes):
                raise ValueError(f"{key} are lists of unequal lengths, such as mixed polygons")
        if len(column) != element["length"]:
            raise ValueError(f"its header declares {element['length']} rows of {name}")
        columns[key] = column[:, 0] if column.shape[1:] == (1,) else column
    return columns


class _Folder:
    """A resolver for files beside a mesh that records missing files."""

    def __init__(self, path: Path):
        from trimesh.resolvers import FilePathResolver  # stays within the folder

        self._files, self.file_name = FilePathResolver(str(path)), path.name
        self.faults: list[str] = []

    def get(self, name: str) -> bytes:
        try:
            data = self._files.get(unquote(name.replace("\\", "/")))
            if not name.strip().lower().endswith((".mtl", ".bin")):
                Image.open(BytesIO(data)).close()
        except Exception:  # decoders raise exceptions of any kind
            self.faults.append(f"names {name!r}, which is missing, or is not a picture")
            raise
        return data

    __getitem__ = get
