"""Files read by trimesh: what it would misread in silence is refused before, what it raises becomes
one sentence, and what it leaves out a warning.
"""

import json
import logging
import re
import warnings
from collections.abc import Callable, Generator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
from PIL import Image

_OBJ_CORNER = rb"[1-9]\d*(?:/(?:[1-9]\d*)?(?:/(?:[1-9]\d*)?)?)?"
_OBJ_READ = rb"v[tn]?(?: +[^\s/_]+){2,7} *|f(?: +%s){3,} *" % _OBJ_CORNER
_OBJ_UNREAD = re.compile(
    rb"^(?!(?:%s)$)[ \t]*(?:f|v[tn]?|curv2?|surf|bzp|bsp)(?:[ \t].*)?$" % _OBJ_READ, re.MULTILINE
)
_GLTF_HARMLESS = re.compile("EXT_texture_webp|KHR_lights_punctual|KHR_materials_.*")
_FAN, _FLOAT = 6, 5126


def count_obj_triangles(data: bytes) -> int:
    """Count the triangles of the polygons in an OBJ file.

    **Raises:** `ValueError` for lines that trimesh passes over or takes for something else.
    """
    data = _whole_lines(data).replace(b"\\\n", b" ")
    faces = re.findall(rb"^f .*", data, re.MULTILINE)
    kinds = set(b" ".join(faces).translate(None, b"0123456789").split())
    if unread := _OBJ_UNREAD.search(data):
        raise ValueError(f"`{unread[0][:60].decode(errors='replace')}` is not read")
    if {b"/", b"//"} <= kinds or data.count(b"\nmtllib ") > 1:
        raise ValueError("it mixes faces of v/vt and v//vn, or names several files of materials")
    return sum(len(face.split()) - 3 for face in faces)


def count_off_triangles(data: bytes) -> int:
    """Count the triangles that the header of an OFF file promises.

    **Raises:** `ValueError` when they are not there, and for other kinds of OFF.
    """
    lines = _whole_lines(data).splitlines()
    rows = [row for line in lines if (row := line.split(b"#")[0].split())]
    if not rows or rows[0] != [b"OFF"]:
        raise ValueError("it does not begin with a line `OFF`, the one kind that is read")
    vertices, count = (int(word) for word in rows[1][:2])
    polygons = rows[2 + vertices : 2 + vertices + count]
    if len(polygons) != count or any(not 2 < int(row[0]) < min(len(row), 5) for row in polygons):
        raise ValueError(
            f"its header promises {vertices} vertices and {count} polygons, of 3 or 4 corners each"
        )
    return sum(int(row[0]) - 2 for row in polygons)


def count_stl_triangles(data: bytes) -> int:
    """Count the triangles of an STL file, binary or text.

    **Raises:** `ValueError` when it is as long as neither would be.
    """
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + 50 * count:
        return count
    text = data.strip().lower()
    if not text.startswith(b"solid") or not text.rsplit(b"\n", 1)[-1].startswith(b"endsolid"):
        raise ValueError(f"it is no text that ends with `endsolid`, nor {count} binary triangles")
    return len(re.findall(rb"^\s*vertex\s", text, re.MULTILINE)) // 3


def check_ply(data: bytes) -> None:
    """Refuse a PLY file of text that is cut short, and one of several textures."""
    if b"format ascii" in data[:100]:
        _whole_lines(data)
    if data[: data.find(b"end_header")].lower().count(b"comment texturefile") > 1:
        raise ValueError("it names several textures")


def check_gltf(data: bytes) -> None:
    """Refuse a glTF or GLB file with anything that trimesh passes over or takes for something
    else.
    """
    is_binary = data[:4] == b"glTF"
    text = data[20 : 20 + int.from_bytes(data[12:16], "little")] if is_binary else data
    content = json.loads(text)
    accessors = content.get("accessors", [])
    primitives = [each for mesh in content.get("meshes", []) for each in mesh["primitives"]]
    attributes = [
        accessors[primitive["attributes"][name]]
        for primitive in primitives
        for name in ("POSITION", "TEXCOORD_0")
        if name in primitive["attributes"]
    ]
    materials, images = content.get("materials", []), content.get("images", [])
    surfaces = [each.get("pbrMetallicRoughness", {}) for each in materials]
    textures = [surface.get("baseColorTexture", {}) for surface in surfaces]
    needed = content.get("extensionsRequired", [])
    faults = {
        f"it needs {', '.join(needed)}": any(not _GLTF_HARMLESS.fullmatch(name) for name in needed),
        "it is compressed, or has sparse accessors": any(
            "sparse" in each or "bufferView" not in each for each in accessors
        ),
        "its vertices are quantized": any(each["componentType"] != _FLOAT for each in attributes),
        "it has triangle fans": any(each.get("mode") == _FAN for each in primitives),
        "its materials are of specular and glossiness": any(
            "KHR_materials_pbrSpecularGlossiness" in each.get("extensions", {})
            for each in materials
        ),
        "its textures are no PNG, JPEG or WebP": any(
            each.get("mimeType", "image/png")[6:] not in ("png", "jpeg", "webp") for each in images
        ),
        "its textures are moved, or have coordinates of their own": any(
            each.get("texCoord") or "KHR_texture_transform" in each.get("extensions", {})
            for each in textures
        ),
    }
    for fault, is_there in faults.items():
        if is_there:
            raise ValueError(f"{fault}, which trimesh does not read")


CHECKS: dict[str, Callable[[bytes], int | None]] = {
    "glb": check_gltf,
    "gltf": check_gltf,
    "obj": count_obj_triangles,
    "ply": check_ply,
    "stl": count_stl_triangles,
    "off": count_off_triangles,
}
"""What is checked in the contents of a file, by its suffix; some count its triangles."""


def _whole_lines(data: bytes) -> bytes:
    if not data.endswith((b"\n", b"\r")):
        raise ValueError("its last line has no end")
    return b"\n" + data.replace(b"\r\n", b"\n")


@contextmanager
def one_sentence(path: Path) -> Generator[None, None, None]:
    """Turn whatever a library raises into an error that names the file, the reason and the remedy.

    **Raises:** `ValueError`; errors that already name the file pass.
    """
    log = logging.getLogger("trimesh")
    before = log.level
    log.setLevel(logging.CRITICAL)  # faults are raised here
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's, of words among numbers
            yield
    except Exception as error:  # each reader fails in its own way
        if isinstance(error, (ValueError, OSError)) and str(error).startswith(str(path)):
            raise
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__} "
        raise ValueError(
            f"{path}: cannot be read ({kind}{' '.join(str(error).split())[:200]}); it is cut "
            "short, or of a kind that is not read: export it again"
        ) from None
    finally:
        log.setLevel(before)


def load_with_trimesh(path: Path, kind: str) -> dict[str, Any]:
    """Read a file of some kind by trimesh.

    Pictures and materials that are missing or unreadable are left out, with a warning.

    **Returns:** the arguments of its meshes, as the file has them; its `contents`; `triangles`,
    how many it promises, where it does; and of a PLY file `columns`, the properties of each
    element.

    **Raises:** `ValueError` for contents that trimesh would misread, and when it reads fewer rows
    than a PLY file promises.
    """
    from trimesh.exchange import load  # takes a second, so only where it is needed

    folder, data = _Folder(path), path.read_bytes()
    loaders, count = cast(dict[str, Any], load.mesh_loaders), CHECKS[kind](data)
    found = loaders[kind](BytesIO(data), resolver=folder, fix_texture=False)
    elements = found.get("metadata", {}).get("_ply_raw", {})
    columns = {name: _columns(name, element) for name, element in elements.items()}
    for fault in folder.faults:
        warnings.warn(f"{path}: {fault}, and its colors are left out", stacklevel=2)
    return found | {"triangles": count, "contents": data, "columns": columns}


def _columns(name: str, element: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the properties of an element of a PLY file: a number or a list for each row."""
    columns = {}
    for key in element["properties"] if element["length"] else ():
        column = np.asarray(element["data"][key])
        if column.dtype.names:
            sizes, column = column["f0"], column["f1"]
            if np.ptp(sizes):
                raise ValueError(f"{key} are lists of several lengths, such as mixed polygons")
        if len(column) != element["length"]:
            raise ValueError(f"its header promises {element['length']} rows of {name}")
        columns[key] = column[:, 0] if column.shape[1:] == (1,) else column
    return columns


class _Folder:
    """The files beside a mesh: a trimesh resolver that never leaves their folder."""

    def __init__(self, path: Path):
        self.file_name, self._folder = path.name, path.parent.resolve()
        self.faults: list[str] = []

    def get(self, name: str) -> bytes:
        plain = name.strip().replace("\\", "/")
        candidates = (plain, unquote(plain), plain.rsplit("/", 1)[-1])
        places = [(self._folder / candidate).resolve() for candidate in candidates]
        file = next((p for p in places if p.is_relative_to(self._folder) and p.is_file()), None)
        if file is None:
            self.faults.append(f"names {name!r}, which is not beside it")
            raise FileNotFoundError(f"it {self.faults[-1]}")
        data = file.read_bytes()
        try:
            if file.suffix.lower() not in (".mtl", ".bin"):
                Image.open(BytesIO(data)).close()
        except Exception:  # each decoder fails in its own way
            self.faults.append(f"names {name!r}, which is no picture that trimesh reads")
        return data

    __getitem__ = get
