"""What trimesh would misread in silence, found in the contents of a file before it reads them."""

import json
import re
from collections.abc import Callable
from typing import Any

_OBJ_CORNER = rb"[1-9]\d*(?:/(?:[1-9]\d*)?(?:/(?:[1-9]\d*)?)?)?"
_OBJ_READ = rb"v[tn]?(?: +[^\s/_]+){2,7} *|f(?: +%s){3,} *" % _OBJ_CORNER
_OBJ_UNREAD = re.compile(
    rb"^(?!(?:%s)$)[ \t]*(?:f|v[tn]?|curv2?|surf|bzp|bsp)(?:[ \t].*)?$" % _OBJ_READ, re.MULTILINE
)
_GLTF_HARMLESS = re.compile("EXT_texture_webp|KHR_lights_punctual|KHR_materials_.*")
_GLTF_COUNTS = {"count", "byteOffset", "byteLength", "byteStride", "bufferView", "buffer", "mesh"}
_GLTF_COUNTS |= {"scene", "indices", "material", "index", "sampler", "source", "texCoord", "mode"}
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
    content = json.loads(text, object_hook=_with_counts)
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


def _with_counts(entry: dict[str, Any]) -> dict[str, Any]:
    for name in _GLTF_COUNTS & entry.keys():
        value = entry[name]
        if not (isinstance(value, dict) or (isinstance(value, int) and value >= 0)):
            raise ValueError(f"its {name} is {value!r}")
    return entry
