"""Meshes from glTF 2.0 and GLB files."""

import math
from collections.abc import Generator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ._gltf_data import GltfData
from ._pictures import read_color
from ._pieces import Piece, check_places, moderate
from ._room import check_room

_KNOWN = {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual"}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_BYTES_PER_CORNER = 300.0  # of a mesh, on its way from the file to splats


def read_gltf(path: Path) -> list[Piece]:
    """Read the triangles of the scene that a file shows, moved by its nodes: a piece for each primitive of each node.

    Primitives of points and lines are left alone, and so are skins and morph targets: meshes stand as they were modelled.

    **Raises:** `ValueError` for what is no such file, is cut short, or needs an extension that is not known here.
    """
    with _named(path):
        data = GltfData(path)
        needed = set(data.content.get("extensionsRequired", ()))
        unknown = sorted(name for name in needed - _KNOWN if not name.startswith("KHR_materials_"))
        if unknown:
            raise ValueError(f"it needs the extension {unknown[0]}, which is not read here; export without it")
        primitives: dict[int, list[Piece]] = {}
        pieces = []
        for node, matrix in _nodes(data):
            mesh = node["mesh"]
            if mesh not in primitives:
                found = data.entry("meshes", mesh)["primitives"]
                primitives[mesh] = [piece for each in found if (piece := _primitive(data, each)) is not None]
            pieces.extend((piece, matrix) for piece in primitives[mesh])
        corners = sum(len(piece.faces) * 3 + len(piece.vertices) for piece, _ in pieces)
        check_room(f"{path}: a scene of {corners} corners", _BYTES_PER_CORNER * corners, "export a part of it")
        return [_moved(piece, matrix) for piece, matrix in pieces]


@contextmanager
def _named(path: Path) -> Generator[None, None, None]:
    """Let what is wrong with a file name it."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        said = f"{type(error).__name__} {' '.join(str(error).split())}"
        raise ValueError(f"{path}: cannot be read as glTF: an entry is missing or wrong ({said}); write it again") from None
    except (FileNotFoundError, ValueError) as error:
        if str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: cannot be read as glTF: {' '.join(str(error).split())}; write it again") from None


def _nodes(data: GltfData) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Give the nodes that hold a mesh, and how they stand in the world."""
    content = data.content
    if not content.get("nodes"):
        return [({"mesh": index}, np.eye(4)) for index in range(len(content.get("meshes", [])))]
    if content.get("scenes"):
        roots = data.entry("scenes", content.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in content["nodes"] for child in node.get("children", [])}
        roots = [index for index in range(len(content["nodes"])) if index not in children]
    found, seen = [], set()
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        index, above = waiting.pop()
        node = data.entry("nodes", index)
        if index in seen:
            raise ValueError(f"its node {index} has two parents")
        seen.add(index)
        matrix = above @ _matrix(node)
        if "mesh" in node:
            found.append((node, matrix))
        waiting.extend((child, matrix) for child in reversed(node.get("children", [])))
    return found


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Give the transform of a node: its matrix, or translation after rotation (a quaternion x y z w) after scale."""
    if "matrix" in node:
        matrix = np.asarray(node["matrix"], np.float64).reshape(4, 4).T
    else:
        x, y, z, w = (float(each) for each in node.get("rotation", (0, 0, 0, 1)))
        length = math.sqrt(x * x + y * y + z * z + w * w)
        if not 0 < length < math.inf:
            raise ValueError(f"its nodes have a rotation {node['rotation']!r}")
        x, y, z, w = x / length, y / length, z / length, w / length
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] *= np.asarray(node.get("scale", (1, 1, 1)), np.float64).reshape(1, 3)
        matrix[:3, 3] = np.asarray(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    if not (np.abs(matrix) < 1e12).all():
        raise ValueError("its nodes have transforms that are not finite")
    return matrix


def _primitive(data: GltfData, primitive: dict[str, Any]) -> Piece | None:
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        return None
    attributes = primitive["attributes"]
    vertices = _table(data, attributes["POSITION"], 3)
    check_places(data.path, vertices)
    if "indices" in primitive:
        order = data.values(primitive["indices"])
        if order.dtype.kind != "u" or order.shape[1] != 1:
            raise ValueError("its indices are no whole numbers")
        order = order[:, 0].astype(np.int64)
    else:
        order = np.arange(len(vertices))
    faces = _faces(order, mode)
    normals = moderate(_table(data, attributes["NORMAL"], 3)) if "NORMAL" in attributes else None
    colors = _table(data, attributes["COLOR_0"], (3, 4))[:, :3] if "COLOR_0" in attributes else None
    for name, table in (("NORMAL", normals), ("COLOR_0", colors)):
        if table is not None and len(table) != len(vertices):
            raise ValueError(f"it has {len(table)} {name} for {len(vertices)} vertices")
    if len(faces) and faces.max() >= len(vertices):
        raise ValueError(f"a face names vertex {faces.max()} of {len(vertices)}")
    uvs, dress = _dress(data, primitive, attributes)
    if uvs is not None and len(uvs) != len(vertices):
        raise ValueError(f"it has {len(uvs)} texture coordinates for {len(vertices)} vertices")
    return Piece(vertices, faces, normals, None if uvs is None else uvs[faces], colors, **dress)


def _table(data: GltfData, index: Any, width: int | tuple[int, ...]) -> np.ndarray:
    values = data.values(index)
    if values.shape[1] not in (width if isinstance(width, tuple) else (width,)):
        raise ValueError(f"its vertices have rows of {values.shape[1]} numbers instead of {width}")
    with np.errstate(invalid="ignore"):  # of NaN that signals
        return values.astype(np.float64)


def _faces(order: np.ndarray, mode: int) -> np.ndarray:
    if mode == _TRIANGLES:
        if len(order) % 3:
            raise ValueError(f"{len(order)} corners make no whole number of triangles")
        return order.reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _FAN:
        return np.stack([order[1:-1], order[2:], np.broadcast_to(order[0], len(order) - 2)], axis=1)
    strip = np.stack([order[:-2], order[1:-1], order[2:]], axis=1)
    strip[1::2] = strip[1::2][:, [0, 2, 1]]
    return strip


def _dress(data: GltfData, primitive: dict[str, Any], attributes: dict[str, Any]) -> tuple[np.ndarray | None, dict[str, Any]]:
    """Give the texture coordinates of a primitive, v up, and the base color of its material."""
    which, dress, lay = "TEXCOORD_0", {}, {}
    if "material" in primitive:
        surface = data.entry("materials", primitive["material"]).get("pbrMetallicRoughness", {})
        dress["color"] = _color(surface.get("baseColorFactor", (1, 1, 1, 1)))
        if "baseColorTexture" in surface:
            laid = surface["baseColorTexture"]
            lay = laid.get("extensions", {}).get("KHR_texture_transform", {})
            which = f"TEXCOORD_{lay.get('texCoord', laid.get('texCoord', 0))}"
            dress["texture"] = partial(_texture, data, laid["index"])
    if which not in attributes:
        return None, dress
    uvs = _table(data, attributes[which], 2)
    if lay:
        turn = float(lay.get("rotation", 0))
        turned = np.asarray([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        uvs = (uvs * np.asarray(lay.get("scale", (1, 1)), np.float64).reshape(1, 2)) @ turned.T
        uvs = uvs + np.asarray(lay.get("offset", (0, 0)), np.float64).reshape(1, 2)
    return uvs * [1, -1] + [0, 1], dress


def _color(factor: Any) -> tuple[float, ...]:
    color = tuple(float(share) for share in factor)
    if len(color) != 4 or not all(0 <= share <= 1 for share in color):
        raise ValueError(f"its materials have a base color {factor!r}")
    return color[:3]


def _texture(data: GltfData, index: Any) -> np.ndarray:
    with _named(data.path):
        texture = data.entry("textures", index)
        source = texture.get("extensions", {}).get("EXT_texture_webp", {}).get("source", texture.get("source"))
        if source is None:
            raise ValueError("its texture is packed in a way that is not read here, export it as PNG or JPEG")
        image = data.entry("images", source)
        return read_color(data.path, bytes(data.view(image["bufferView"])) if "bufferView" in image else data.named(image["uri"]))


def _moved(piece: Piece, matrix: np.ndarray) -> Piece:
    """Give a piece in the world. A mirror turns its triangles around, so that they face outward again."""
    linear = matrix[:3, :3]
    vertices = piece.vertices @ linear.T + matrix[:3, 3]
    # The cofactors are the inverse's transpose times the determinant, and exist where there is no inverse.
    cofactors = np.stack([np.cross(linear[1], linear[2]), np.cross(linear[2], linear[0]), np.cross(linear[0], linear[1])])
    mirrored = np.linalg.det(linear) < 0
    normals = None if piece.normals is None else piece.normals @ (-cofactors if mirrored else cofactors).T
    if mirrored:
        turned = None if piece.uvs is None else piece.uvs[:, ::-1]
        piece = piece._replace(faces=piece.faces[:, ::-1], uvs=turned)
    return piece._replace(vertices=vertices, normals=normals)
