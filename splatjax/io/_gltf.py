"""Meshes from glTF 2.0 and GLB files."""

import base64
import json
import math
import struct
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ._files import file_beside
from ._library import readable
from ._pictures import read_color
from ._pieces import Piece, Wrap, check_places, moderate
from ._room import check_room

_KNOWN = {
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    "EXT_texture_webp",
    "KHR_lights_punctual",
}
_COUNTS = {
    "count",
    "byteOffset",
    "byteLength",
    "byteStride",
    "bufferView",
    "buffer",
    "mesh",
    "scene",
    "indices",
    "material",
}
_COUNTS |= {"index", "sampler", "source", "texCoord", "children", "nodes", "attributes", "mode"}
_WIDTHS = {"_PLACE": (3,), "_NORMAL": (3,), "_COLOR": (3, 4), "_UV": (2,)}
_WHOLE = {5121, 5123, 5125}
_TRIANGLES, _STRIP, _FAN = _SURFACES = 4, 5, 6
_WRAPS: dict[int, Wrap] = {10497: "wrap", 33071: "edge", 33648: "symmetric"}
_BYTES_PER_CORNER = 300.0  # of a mesh, on its way from the file to splats
_BYTES_PER_ZERO = 80.0  # of a sparse accessor


def read_gltf(path: Path) -> list[Piece]:
    """Read the triangles of the scene that a file shows, moved by its nodes: a piece for each
    primitive of each node.

    Primitives of points and lines are left alone, and so are skins and morph targets: meshes stand
    as they were modeled. trimesh reads buffers, accessors and nodes; it is asked for accessors as
    they stand in the file, for it leaves alone what is normalized and what is sparse.

    **Raises:** `ValueError` for what is no such file, is cut short, or needs an extension that is
    not known here.
    """
    with readable(path, "glTF"):
        from trimesh.exchange.gltf import load_gltf  # takes a second, so only where a mesh is read

        content, chunk = _opened(path)
        _check(path, content)
        buffers = {
            str(i): _buffer(path, entry, chunk, i)
            for i, entry in enumerate(content.get("buffers", []))
        }
        for view in content.get("bufferViews", []):
            end, size = (
                view.get("byteOffset", 0) + view["byteLength"],
                len(buffers[str(view["buffer"])]),
            )
            if end > size:
                raise ValueError(f"its bufferViews promise {end} bytes of a buffer of {size}")
        _stage(content)
        primitives = [primitive for mesh in content["meshes"] for primitive in mesh["primitives"]]
        dresses = [_dress(path, content, buffers, primitive) for primitive in primitives]
        asked = [
            _ask(content, primitive, which)
            for primitive, (which, *_) in zip(primitives, dresses, strict=True)
        ]
        plain = content | {"buffers": [{"uri": name} for name in buffers]}
        found = load_gltf(
            BytesIO(json.dumps(plain).encode()), resolver=buffers, skip_materials=True
        )
        geometry = found["geometry"]
        pieces = {
            name: _piece(path, table, wanted, dress)
            for (name, table), wanted, dress in zip(geometry.items(), asked, dresses, strict=True)
        }
        places = [edge for edge in found["graph"] if "geometry" in edge]
        corners = sum(
            3 * len(pieces[edge["geometry"]].faces) + len(pieces[edge["geometry"]].vertices)
            for edge in places
        )
        check_room(
            f"{path}: a scene of {corners} corners",
            _BYTES_PER_CORNER * corners,
            "export a part of it",
        )
        world, moved = {found["base_frame"]: np.eye(4)}, []
        for edge in found["graph"]:
            world[edge["frame_to"]] = matrix = world[edge["frame_from"]] @ edge["matrix"]
            if not (np.abs(matrix) < 1e12).all():
                raise ValueError("its nodes have transforms that are not finite")
            if "geometry" in edge:
                moved.append(_moved(pieces[edge["geometry"]], matrix))
        return moved


def _opened(path: Path) -> tuple[dict[str, Any], bytes | None]:
    """Give the JSON and, of GLB, the binary chunk of a file."""
    data = path.read_bytes()
    if data[:4] == b"glTF":
        text, chunk = _chunks(data)
    elif path.suffix.lower() == ".glb":
        raise ValueError("it does not begin with `glTF`")
    else:
        text, chunk = data, None
    return json.loads(text), chunk


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Give the JSON and the binary chunk of a GLB file."""
    if len(data) < 20:
        raise ValueError("it is cut short")
    version, length, text_length, kind = struct.unpack_from("<III4s", data, 4)
    if version != 2:
        raise ValueError(f"it is GLB of version {version}, and version 2 is read")
    if length > len(data) or 20 + text_length > length:
        raise ValueError(
            f"its header promises {max(length, 20 + text_length)} bytes, and it has {len(data)}: "
            "it is cut short"
        )
    if kind != b"JSON":
        raise ValueError("its first chunk is not JSON")
    start = 20 + text_length
    text, chunk = data[20:start], None
    while start + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, start)
        if start + 8 + size > length:
            raise ValueError("its last chunk is cut short")
        if kind == b"BIN\0" and chunk is None:
            chunk = data[start + 8 : start + 8 + size]
        start += 8 + size
    return text, chunk


def _check(path: Path, content: dict[str, Any]) -> None:
    """Refuse what trimesh would pass over in silence: other versions and extensions, counts below
    zero, accessors of nothing.
    """
    version = str(content["asset"]["version"])
    if not version.startswith("2."):
        raise ValueError(f"it is of version {version[:20]}, and version 2 is read")
    unknown = sorted(set(content.get("extensionsRequired", ())) - _KNOWN)
    unknown = [name for name in unknown if not name.startswith("KHR_materials_")]
    if unknown:
        raise ValueError(
            f"it needs the extension {unknown[0]}, which is not read here; export without it"
        )
    _check_counts(content)
    for accessor in content.get("accessors", []):
        if "bufferView" not in accessor:
            if "sparse" not in accessor:
                raise ValueError("it has an accessor without data: export it without compression")
            check_room(
                f"{path}: an accessor of {accessor['count']} zeros",
                _BYTES_PER_ZERO * accessor["count"],
                "write it again",
            )


def _check_counts(value: Any) -> None:
    waiting = [value]
    while waiting:
        value = waiting.pop()
        if isinstance(value, list):
            waiting.extend(value)
        for key, each in value.items() if isinstance(value, dict) else ():
            if (key in _COUNTS and not isinstance(each, dict | list)) or key in (
                "children",
                "nodes",
                "attributes",
            ):
                several = (
                    each.values()
                    if isinstance(each, dict)
                    else each
                    if isinstance(each, list)
                    else [each]
                )
                wrong = [
                    one
                    for one in several
                    if not isinstance(one, dict) and (type(one) is not int or one < 0)
                ]
                if wrong:
                    raise ValueError(f"it has {wrong[0]!r} in the place of a count, its {key}")
            if key != "extras":
                waiting.append(each)


def _buffer(path: Path, entry: dict[str, Any], chunk: bytes | None, index: int) -> bytes:
    if "uri" in entry:
        return _named(path, entry["uri"])
    if index or chunk is None:
        raise ValueError(f"its buffer {index} is nowhere")
    return chunk


def _named(path: Path, uri: str) -> bytes:
    """Give what a URI stands for: data written out within it, or a file beside."""
    if not uri.startswith("data:"):
        return file_beside(path, uri, encoded=True).read_bytes()
    return base64.b64decode(uri.partition(";base64,")[2], validate=True)


def _stage(content: dict[str, Any]) -> None:
    """Make the scene plain: one that is shown, nodes that trimesh does not pass over, each in one
    place.
    """
    meshes = content.setdefault("meshes", [])
    for mesh in meshes:
        mesh["primitives"] = [
            each for each in mesh["primitives"] if each.get("mode", _TRIANGLES) in _SURFACES
        ]
    content["nodes"] = content.get("nodes") or [{"mesh": i} for i in range(len(meshes))]
    nodes: Any = content["nodes"]
    children = [child for node in nodes for child in node.get("children", [])]
    if content.get("scenes"):
        roots = content["scenes"][content.get("scene", 0)].get("nodes", [])
    else:
        roots = [i for i in range(len(nodes)) if i not in set(children)]
    content["scenes"], content["scene"] = [{"nodes": roots}], 0
    named, counts = np.unique(np.asarray(children + roots, np.int64), return_counts=True)
    if (counts > 1).any():
        raise ValueError(f"its node {named[counts.argmax()]} has two parents")
    for node in nodes:
        for key in ("name", "camera", "extras", "extensions"):
            node.pop(key, None)
        if "mesh" in node and not meshes[node["mesh"]]["primitives"]:
            del node["mesh"]
        if "rotation" in node and not any(node["rotation"]):
            raise ValueError(f"its nodes have a rotation {node['rotation']!r}")


def _ask(
    content: dict[str, Any], primitive: dict[str, Any], which: str
) -> dict[str, dict[str, Any]]:
    """Let a primitive name, beside its places, all that is needed as attributes of its own; give
    their accessors.
    """
    if primitive.get("mode", _TRIANGLES) == _FAN:
        raise ValueError("it has triangle fans, which are not read here; export triangles")
    accessors, attributes = content["accessors"], primitive["attributes"]
    if "indices" in primitive:
        order = accessors[primitive["indices"]]
        if order["componentType"] not in _WHOLE or order["type"] != "SCALAR" or "sparse" in order:
            raise ValueError(
                "its indices are no plain whole numbers; export it without compression"
            )
    wanted = {"_PLACE": "POSITION", "_NORMAL": "NORMAL", "_COLOR": "COLOR_0", "_UV": which}
    asked = {name: accessors[attributes[old]] for name, old in wanted.items() if old in attributes}
    primitive["attributes"] = {"POSITION": attributes["POSITION"]}
    primitive["attributes"] |= {name: attributes[wanted[name]] for name in asked}
    primitive.pop("extensions", None)
    for name, accessor in asked.items():
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            for end, entry, kind in (
                ("_AT", sparse["indices"], {"type": "SCALAR"}),
                ("_OF", sparse["values"], accessor),
            ):
                part = {"componentType": kind.get("componentType", 0), "type": kind["type"]} | entry
                primitive["attributes"][name + end] = len(accessors)
                accessors.append(part | {"count": sparse["count"]})
    return asked


def _tables(
    found: dict[str, np.ndarray], asked: dict[str, dict[str, Any]]
) -> dict[str, np.ndarray]:
    """Give the values of attributes, with what is sparse in its place and what is normalized as
    floats.
    """
    tables = {}
    for name, accessor in asked.items():
        table = found[name]
        if f"{name}_AT" in found:
            table = table.copy()
            table[found[f"{name}_AT"][:, 0].astype(np.uint32)] = found[f"{name}_OF"]
        if (
            table.ndim != 2
            or table.shape[1] not in _WIDTHS[name]
            or len(table) != len(found["_PLACE"])
        ):
            raise ValueError(
                f"its {len(found['_PLACE'])} vertices have {table.shape} numbers for "
                f"{name[1:].lower()}"
            )
        with np.errstate(invalid="ignore"):  # of NaN that signals
            tables[name] = table.astype(np.float64)
        if accessor.get("normalized") and table.dtype.kind in "iu":
            tables[name] = np.maximum(tables[name] / np.iinfo(table.dtype).max, -1.0)
    return tables


def _piece(
    path: Path, found: dict[str, Any], asked: dict[str, dict[str, Any]], dress: tuple
) -> Piece:
    tables, faces = _tables(found["vertex_attributes"], asked), np.asarray(found["faces"], np.int64)
    normals, colors, uvs = (tables.get(name) for name in ("_NORMAL", "_COLOR", "_UV"))
    check_places(path, tables["_PLACE"])
    if len(faces) and faces.max() >= len(tables["_PLACE"]):
        raise ValueError(f"a face names vertex {faces.max()} of {len(tables['_PLACE'])}")
    return Piece(
        tables["_PLACE"],
        faces,
        None if normals is None else moderate(normals),
        None if uvs is None else (_laid(uvs, dress[1]) * [1, -1] + [0, 1])[faces],
        None if colors is None else colors[:, :3],
        **dress[2],
    )


def _dress(
    path: Path, content: dict[str, Any], buffers: dict[str, bytes], primitive: dict[str, Any]
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Give which texture coordinates a primitive wears, how they are laid, and the base color of
    its material.
    """
    if "material" not in primitive:
        return "TEXCOORD_0", {}, {}
    surface = content["materials"][primitive["material"]].get("pbrMetallicRoughness", {})
    color = tuple(float(share) for share in surface.get("baseColorFactor", (1, 1, 1, 1)))
    if len(color) != 4 or not all(0 <= share <= 1 for share in color):
        raise ValueError(f"its materials have a base color {color!r}")
    if "baseColorTexture" not in surface:
        return "TEXCOORD_0", {}, {"color": color[:3]}
    laid = surface["baseColorTexture"]
    lay = laid.get("extensions", {}).get("KHR_texture_transform", {})
    texture = partial(_texture, path, content, buffers, laid["index"])
    dress = {"color": color[:3], "texture": texture, "wraps": _wraps(content, laid["index"])}
    return f"TEXCOORD_{lay.get('texCoord', laid.get('texCoord', 0))}", lay, dress


def _wraps(content: dict[str, Any], index: int) -> tuple[Wrap, Wrap]:
    """Give how a texture goes on beyond its borders, along u and v."""
    number = content["textures"][index].get("sampler")
    sampler = {} if number is None else content["samplers"][number]
    along_u, along_v = (_WRAPS.get(sampler.get(name, 10497)) for name in ("wrapS", "wrapT"))
    if along_u is None or along_v is None:
        raise ValueError(
            f"its textures are wrapped by {sampler.get('wrapS')!r} and {sampler.get('wrapT')!r}, "
            "which is unknown"
        )
    return along_u, along_v


def _laid(uvs: np.ndarray, lay: dict[str, Any]) -> np.ndarray:
    turn = float(lay.get("rotation", 0))
    turned = np.asarray([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    uvs = (uvs * np.asarray(lay.get("scale", (1, 1)), np.float64).reshape(1, 2)) @ turned.T
    return uvs + np.asarray(lay.get("offset", (0, 0)), np.float64).reshape(1, 2)


def _texture(
    path: Path, content: dict[str, Any], buffers: dict[str, bytes], index: int
) -> np.ndarray:
    with readable(path, "glTF"):
        texture = content["textures"][index]
        source = (
            texture.get("extensions", {})
            .get("EXT_texture_webp", {})
            .get("source", texture.get("source"))
        )
        if source is None:
            raise ValueError(
                "its texture is packed in a way that is not read here, export it as PNG or JPEG"
            )
        image = content["images"][source]
        if "bufferView" not in image:
            return read_color(path, _named(path, image["uri"]))
        view = content["bufferViews"][image["bufferView"]]
        start = view.get("byteOffset", 0)
        return read_color(path, buffers[str(view["buffer"])][start : start + view["byteLength"]])


def _moved(piece: Piece, matrix: np.ndarray) -> Piece:
    """Give a piece in the world. A mirror turns its triangles around, so that they face outward
    again.
    """
    linear = matrix[:3, :3]
    vertices = piece.vertices @ linear.T + matrix[:3, 3]
    # The cofactors are the inverse's transpose times the determinant, and exist where there is no
    # inverse.
    cofactors = np.stack(
        [
            np.cross(linear[1], linear[2]),
            np.cross(linear[2], linear[0]),
            np.cross(linear[0], linear[1]),
        ]
    )
    mirrored = np.linalg.det(linear) < 0
    normals = (
        None if piece.normals is None else piece.normals @ (-cofactors if mirrored else cofactors).T
    )
    if mirrored:
        turned = None if piece.uvs is None else piece.uvs[:, ::-1]
        piece = piece._replace(faces=piece.faces[:, ::-1], uvs=turned)
    return piece._replace(vertices=vertices, normals=normals)
