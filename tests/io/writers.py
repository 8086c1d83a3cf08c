"""Small files of meshes and points, written out as their formats prescribe."""

import base64
import json
from io import BytesIO

import numpy as np
from PIL import Image

SQUARE = np.asarray([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
TRIANGLES = np.asarray([[0, 1, 2], [0, 2, 3]])
UVS = SQUARE[:, :2] / 2  # v = 1 at the top of the square
_PLY_TYPES = {"u1": "uchar", "u2": "ushort", "i4": "int", "f4": "float", "f8": "double"}
_GLTF_TYPES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}


def write_ply(path, columns, lists=None, *, text=False, order="<", comments=()):
    """Write columns of vertices of any type, in their order, and lists of faces by their names."""
    kind = "ascii" if text else {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    table = np.rec.fromarrays([np.asarray(column) for column in columns.values()])
    header = ["ply", f"format {kind} 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {len(table)}")
    for name, column in columns.items():
        header.append(f"property {_PLY_TYPES[np.asarray(column).dtype.str[1:]]} {name}")
    if lists:
        header.append(f"element face {len(next(iter(lists.values())))}")
        for name, values in lists.items():
            header.append(f"property list uchar {_PLY_TYPES[values[0].dtype.str[1:]]} {name}")
    rows = [row.tolist() for row in table]
    polygons = list(zip(*lists.values(), strict=True)) if lists else []
    if text:
        rows = [" ".join(map(repr, row)) for row in rows]
        rows += [" ".join(f"{len(v)} {' '.join(map(str, v))}" for v in row) for row in polygons]
        body = ("\n".join(rows) + "\n").encode()
    else:
        body = table.astype(table.dtype.newbyteorder(order)).tobytes()
        for row in polygons:
            for values in row:
                body += (
                    bytes([len(values)]) + values.astype(values.dtype.newbyteorder(order)).tobytes()
                )
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)
    return path


def xyz(points):
    """Return columns of points."""
    return dict(zip("xyz", np.asarray(points).T, strict=True))


def gltf(arrays=(), normalized=(), **more):
    """Return the content of a glTF file of a square, or of other arrays by their attributes."""
    arrays = dict(arrays) or {"POSITION": SQUARE, "indices": TRIANGLES.astype("u2")}
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "accessors": [],
        "bufferViews": [],
    }
    data = b""
    for name, array in arrays.items():
        array = np.ascontiguousarray(array)
        content["accessors"].append(
            {
                "bufferView": len(content["bufferViews"]),
                "componentType": _GLTF_TYPES[array.dtype.str[1:]],
                "count": array.size if name == "indices" else len(array),
                "type": "SCALAR" if name == "indices" else f"VEC{array.shape[1]}",
                "normalized": name in normalized,
            }
        )
        content["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes}
        )
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
    numbers = {name: i for i, name in enumerate(arrays)}
    primitive = {"attributes": {name: i for name, i in numbers.items() if name != "indices"}}
    if "indices" in numbers:
        primitive["indices"] = numbers["indices"]
    content["meshes"] = [{"primitives": [primitive | more.pop("primitive", {})]}]
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    content["buffers"] = [{"byteLength": len(data), "uri": uri}]
    return content | more


def textured_gltf(picture, uvs=UVS * [1, -1] + [0, 1], **more):
    """Return the content of a glTF file of a square with a texture, which has v down."""
    encoded = BytesIO()
    picture.save(encoded, "PNG")
    uri = "data:image/png;base64," + base64.b64encode(encoded.getvalue()).decode()
    arrays = {"POSITION": SQUARE, "TEXCOORD_0": uvs.astype("f4"), "indices": TRIANGLES.astype("u2")}
    surface = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    return (
        gltf(arrays, primitive={"material": 0})
        | {
            "materials": [surface],
            "textures": [{"source": 0}],
            "images": [{"uri": uri, "mimeType": "image/png"}],
        }
        | more
    )


def write_gltf(path, content):
    """Write glTF as JSON, or as GLB with the data of its buffer in a chunk of its own."""
    if path.suffix == ".gltf":
        path.write_text(json.dumps(content))
        return path
    buffer = content["buffers"][0]
    data = base64.b64decode(buffer["uri"].partition("base64,")[2])
    text = json.dumps(content | {"buffers": [{"byteLength": len(data)}]}).encode()
    chunks = b""
    for kind, chunk in ((b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", data)):
        chunks += len(chunk).to_bytes(4, "little") + kind + chunk
    path.write_bytes(b"glTF\2\0\0\0" + (12 + len(chunks)).to_bytes(4, "little") + chunks)
    return path


def write_obj(path, uvs=UVS, extra=""):
    """Write the square as OBJ, where v grows upward."""
    lines = [f"v {x} {y} {z}" for x, y, z in SQUARE] + [f"vt {u} {v}" for u, v in uvs]
    faces = ["f 1/1/1 2/2/1 3/3/1", "f 1/1/1 3/3/1 4/4/1"]
    path.write_text("\n".join([extra, *lines, "vn 0 0 1", *faces, ""]))
    return path


def ramp():
    """Return a picture that is red at the top, row 0, and green at the bottom."""
    rows = np.linspace(1, 0, 64)[:, None] * np.ones(8)
    return Image.fromarray(
        np.rint(255 * np.stack([rows, 1 - rows, 0 * rows], axis=-1)).astype(np.uint8)
    )
