"""A hundred files, as five libraries write them and as the formats' own texts show them: places,
normals and colors compared.
"""

import base64
import json

import meshio
import numpy as np
import plyfile
import pygltflib
import pytest
import trimesh
from scipy.spatial import KDTree

from splatjax.io import read_mesh
from splatjax.io._color import srgb_to_linear

MM = 2.0
SINGLE = 1e-5
"""Files hold some six digits."""


def bodies():
    """Closed and open, round and with edges, far from the origin and small."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=3.0)
    box = trimesh.creation.box((1, 2, 3))
    tube = trimesh.creation.annulus(1.0, 2.0, 1.5, sections=8)
    sheet = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0.2], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    )
    moved = {"ball": (ball, 1.0), "box": (box, 0.0), "tube": (tube, -20.0), "sheet": (sheet, 0.0)}
    return {
        name: (np.array(mesh.vertices) + offset, np.array(mesh.faces))
        for name, (mesh, offset) in moved.items()
    }


BODIES = bodies()


def dressed(body):
    """Normals that are not the body's own, and colors of 8 bits."""
    vertices, faces = BODIES[body]
    random = np.random.default_rng(len(vertices))
    normals = random.normal(size=vertices.shape)
    colors = random.integers(0, 256, vertices.shape, dtype=np.uint8)
    return vertices, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True), colors


def corners(vertices, faces):
    """Corners of triangles, whatever the order of triangles and where each begins."""
    found = np.asarray(vertices, np.float64)[faces]
    rounded = np.round(found, 3) + 0.0
    starts = (
        np.lexsort(np.moveaxis(rounded, 2, 0)[::-1].reshape(3, -1))
        .argsort()
        .reshape(len(found), 3)
        .argmin(axis=1)
    )
    turned = np.take_along_axis(found, ((starts[:, None] + np.arange(3)) % 3)[..., None], axis=1)
    return turned[np.lexsort(np.round(turned.reshape(len(turned), -1), 3).T[::-1])]


def compare(path, vertices, faces, normals=None, colors=None, atol=SINGLE):
    """Read a file and compare it, corner by corner; normals and linear colors vertex by vertex."""
    mesh, _ = read_mesh(path, mm_per_unit=MM)
    expected = MM * np.asarray(vertices, np.float64)
    np.testing.assert_allclose(
        corners(mesh.vertices, mesh.faces),
        corners(expected, faces),
        atol=atol * np.abs(expected).max(),
    )
    _, at = KDTree(mesh.vertices).query(expected[np.unique(faces)])
    if normals is not None:
        np.testing.assert_allclose(
            mesh.normals[at],
            np.asarray(normals)[np.unique(faces)],
            atol=1e-2 if atol > SINGLE else 1e-4,
        )
    if colors is None:
        assert mesh.colors is None
    else:
        np.testing.assert_allclose(mesh.colors[at], np.asarray(colors)[np.unique(faces)], atol=1e-4)
    return mesh


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize(
    "suffix", ["ply", "ascii.ply", "obj", "glb", "gltf", "stl", "ascii.stl", "off"]
)
def test_trimesh(tmp_path, suffix, body):
    vertices, faces, normals, colors = dressed(body)
    worn = suffix.endswith(("ply", "obj", "glb", "gltf"))
    mesh = trimesh.Trimesh(
        vertices,
        faces,
        vertex_normals=normals,
        vertex_colors=colors if worn else None,
        process=False,
    )
    path = tmp_path / f"a.{suffix}"
    how = {
        "ply": {"vertex_normal": True},
        "ascii.ply": {"vertex_normal": True, "encoding": "ascii"},
        "obj": {"include_normals": True},
        "glb": {"include_normals": True},
        "gltf": {"include_normals": True},
        "ascii.stl": {"file_type": "stl_ascii"},
    }.get(suffix, {})
    if suffix == "gltf":
        for name, data in mesh.export(file_type="gltf", **how).items():
            (tmp_path / name).write_bytes(data)
        path = tmp_path / "model.gltf"
    else:
        mesh.export(path, **how)
    linear = colors / 255 if suffix in ("glb", "gltf") else srgb_to_linear(colors / 255)
    compare(path, vertices, faces, normals if worn else None, linear if worn else None)


@pytest.mark.parametrize("body", ["ball", "sheet"])
@pytest.mark.parametrize("kind", ["ply", "ascii.ply", "obj", "stl", "ascii.stl", "off"])
def test_meshio(tmp_path, kind, body):
    vertices, faces, normals, colors = dressed(body)
    path, ply = tmp_path / f"a.{kind}", kind.endswith("ply")
    data = {}
    if ply:
        data = dict(
            zip(("nx", "ny", "nz", "red", "green", "blue"), [*normals.T, *colors.T], strict=True)
        )
    how = {"binary": not kind.startswith("ascii")} if kind.endswith(("ply", "stl")) else {}
    meshio.write(path, meshio.Mesh(vertices, [("triangle", faces)], point_data=data), **how)
    compare(
        path,
        vertices,
        faces,
        normals if ply else None,
        srgb_to_linear(colors / 255) if ply else None,
    )


@pytest.mark.parametrize("kind", ["ply", "ascii.ply", "obj"])
def test_meshio_writes_quads(tmp_path, kind):
    places = np.asarray(
        [[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], np.float64
    )
    quads = np.asarray(
        [[3, 2, 1, 0], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
    )
    how = {} if kind == "obj" else {"binary": kind == "ply"}
    meshio.write(tmp_path / f"a.{kind}", meshio.Mesh(places, [("quad", quads)]), **how)
    mesh = compare(tmp_path / f"a.{kind}", places, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3))
    np.testing.assert_allclose(mesh.volume(), MM**3)


COLORS = {"u1": 255, "u2": 65535, "f4": 1, "none": 0}


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
@pytest.mark.parametrize("color", COLORS)
@pytest.mark.parametrize("number", ["f4", "f8"])
def test_plyfile(tmp_path, text, order, color, number):
    """The properties' order is another in each."""
    vertices, faces, normals, colors = dressed("ball")
    shares = colors / 255
    columns = dict(zip(("x", "y", "z", "nx", "ny", "nz"), [*vertices.T, *normals.T], strict=True))
    kinds = dict.fromkeys(columns, number)
    if color != "none":
        stored = np.rint(shares * COLORS[color]) if color[0] == "u" else shares
        columns |= dict(zip(("red", "green", "blue"), stored.T, strict=True))
        kinds |= dict.fromkeys(("red", "green", "blue"), color)
    names = list(np.random.default_rng(len(color) + len(number) + text).permutation(list(columns)))
    table = np.empty(len(vertices), [(str(name), kinds[name]) for name in names])
    for name in names:
        table[name] = columns[name]
    lists = np.empty(len(faces), [("vertex_indices", "i4" if color == "u1" else "u2", (3,))])
    lists["vertex_indices"] = faces
    elements = [
        plyfile.PlyElement.describe(table, "vertex"),
        plyfile.PlyElement.describe(lists, "face"),
    ]
    plyfile.PlyData(elements, text=text, byte_order=order).write(str(tmp_path / "a.ply"))
    expected = {"none": None, "f4": shares}.get(color, srgb_to_linear(shares))
    compare(tmp_path / "a.ply", vertices, faces, normals, expected)


def gltf_accessors(arrays):
    """Give a pygltflib file that holds arrays, in its own binary chunk, and nothing else yet."""
    codes = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
    file, data = pygltflib.GLTF2(), b""
    for array, normalized in arrays:
        kind = array.dtype.str[1:]
        width = 1 if array.ndim == 1 else array.shape[1]
        stride = -(-width * array.itemsize // 4) * 4 if array.ndim > 1 else array.itemsize
        rows = np.zeros((len(array), stride), np.uint8)
        rows[:, : width * array.itemsize] = (
            np.ascontiguousarray(array).view(np.uint8).reshape(len(array), -1)
        )
        view = pygltflib.BufferView(buffer=0, byteOffset=len(data), byteLength=rows.size)
        if array.ndim > 1:
            view.byteStride = stride
        file.bufferViews.append(view)
        accessor = pygltflib.Accessor(
            bufferView=len(file.accessors), componentType=codes[kind], count=len(array)
        )
        accessor.type = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}[width]
        accessor.normalized = normalized
        file.accessors.append(accessor)
        data += rows.tobytes() + b"\0" * (-rows.size % 4)
    file.buffers = [pygltflib.Buffer(byteLength=len(data))]
    file.set_binary_blob(data)
    return file


@pytest.mark.parametrize("embedded", [False, True])
@pytest.mark.parametrize("normal", ["f4", "i1", "i2"])
@pytest.mark.parametrize(("color", "width"), [("f4", 3), ("u1", 4), ("u2", 3), ("f4", 4)])
def test_pygltflib(tmp_path, embedded, normal, color, width):
    """Indexed triangles and strips; a node that turns by a quarter around z and moves."""
    vertices, faces, normals, colors = dressed("sheet" if normal == "f4" else "ball")
    stored_normals = normals if normal == "f4" else np.rint(normals * np.iinfo(normal).max)
    shares = np.concatenate([colors / 255, np.full((len(colors), 1), 0.5)], axis=1)[:, :width]
    stored = shares if color == "f4" else np.rint(shares * np.iinfo(color).max)
    order = (
        np.asarray([1, 2, 0, 3]) if normal == "f4" else faces.ravel()
    )  # a strip: 1 2 0, and 2 3 0 turned around
    file = gltf_accessors(
        [
            (order.astype({"f4": "u1", "u1": "u2", "u2": "u4"}[color]), False),
            (vertices.astype("<f4"), False),
            (stored_normals.astype(f"<{normal}"), normal != "f4"),
            (stored.astype(f"<{color}"), color != "f4"),
        ]
    )
    primitive = pygltflib.Primitive(
        attributes=pygltflib.Attributes(POSITION=1, NORMAL=2, COLOR_0=3), indices=0
    )
    primitive.mode = pygltflib.TRIANGLE_STRIP if normal == "f4" else pygltflib.TRIANGLES
    file.meshes = [pygltflib.Mesh(primitives=[primitive])]
    half = 0.5**0.5
    file.nodes = [pygltflib.Node(mesh=0, rotation=[0, 0, half, half], translation=[5, 0, 0])]
    file.scenes, file.scene = [pygltflib.Scene(nodes=[0])], 0
    path = tmp_path / ("a.gltf" if embedded else "a.glb")
    if embedded:
        file.convert_buffers(pygltflib.BufferFormat.DATAURI)
        file.save_json(str(path))
    else:
        file.save_binary(str(path))
    turn = np.asarray([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    shown = [[1, 2, 0], [0, 2, 3]] if normal == "f4" else faces
    mesh = compare(path, vertices @ turn.T + [5, 0, 0], shown, None, shares[:, :3])
    _, at = KDTree(mesh.vertices).query(MM * (vertices @ turn.T + [5, 0, 0]))
    np.testing.assert_allclose(
        mesh.normals[at], normals @ turn.T, atol={"f4": 1e-5, "i2": 1e-4, "i1": 2e-2}[normal]
    )


@pytest.mark.parametrize("body", ["ball", "tube"])
@pytest.mark.parametrize("kind", ["ply", "ascii.ply", "obj", "stl", "off", "glb"])
def test_open3d(tmp_path, kind, body):
    """Where it is installed: it is no dependency of the project's."""
    open3d = pytest.importorskip("open3d")
    vertices, faces, normals, colors = dressed(body)
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(faces)
    )
    mesh.vertex_normals = open3d.utility.Vector3dVector(normals)
    mesh.vertex_colors = open3d.utility.Vector3dVector(colors / 255)
    if kind == "stl":
        mesh.compute_triangle_normals()
    path = tmp_path / f"a.{kind}"
    assert open3d.io.write_triangle_mesh(str(path), mesh, write_ascii=kind.startswith("ascii"))
    linear = colors / 255 if kind == "glb" else srgb_to_linear(colors / 255)
    compare(
        path, vertices, faces, None if kind == "stl" else normals, None if kind == "stl" else linear
    )


@pytest.mark.parametrize(
    ("kind", "row", "normal", "color"),
    [
        ("NOFF", "0 0 2", [0, 0, 1], None),
        ("COFF", "255 0 51 255", None, [1, 0, 0.0331048]),
        ("COFF", "1.0 0.0 0.2", None, [1, 0, 0.2]),
        ("CNOFF", "0 1 0 0.5 0.5 0.5 1", [0, 1, 0], [0.5, 0.5, 0.5]),
    ],
)
def test_kinds_of_off(tmp_path, kind, row, normal, color):
    places = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    lines = [kind, "3 1 0", *(f"{x} {y} {z} {row}" for x, y, z in places), "3 0 1 2", ""]
    (tmp_path / "a.off").write_text("\n".join(lines))
    normals, colors = (None if each is None else np.tile(each, (3, 1)) for each in (normal, color))
    compare(tmp_path / "a.off", places, [[0, 1, 2]], normals, colors)
    (tmp_path / "a.off").write_text("\n".join(lines).replace(row, "0 0"))
    with pytest.raises(ValueError, match=f"its vertices have not all the . numbers of {kind}"):
        read_mesh(tmp_path / "a.off", mm_per_unit=MM)
    if color is not None:
        (tmp_path / "a.off").write_text(
            "\n".join(lines).replace(
                row, row.replace("255", "900").replace("1.0", "1.5").replace("0.5", "1.5")
            )
        )
        with pytest.raises(ValueError, match="has colors of vertices that reach"):
            read_mesh(tmp_path / "a.off", mm_per_unit=MM)


CUBE = [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0], [1, 0, 0], [1, 0, 1], [1, 1, 1], [1, 1, 0]]
CUBE_QUADS = [[0, 1, 2, 3], [7, 6, 5, 4], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]]
PLY_CUBE = """ply
format ascii 1.0
comment made by Greg Turk
comment this file is a cube
element vertex 8
property float x
property float y
property float z
element face 6
property list uchar int vertex_index
end_header
""" + "\n".join(
    [
        *(" ".join(map(str, row)) for row in CUBE),
        *("4 " + " ".join(map(str, quad)) for quad in CUBE_QUADS),
        "",
    ]
)
OBJ_SQUARE = """# Wavefront, Advanced Visualizer, appendix B1: a square, named from the end
v 0.000000 2.000000 0.000000
v 0.000000 0.000000 0.000000
v 2.000000 0.000000 0.000000
v 2.000000 2.000000 0.000000
f -4 -3 -2 -1
"""
STL_FACET = """solid name
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid name
"""
OFF_CUBE = """OFF
# cube.off, after the one of Geomview's manual
8 6 12
 1.0  0.0 1.0
 0.0  1.0 1.0
-1.0  0.0 1.0
 0.0 -1.0 1.0
 1.0  0.0 0.0
 0.0  1.0 0.0
-1.0  0.0 0.0
 0.0 -1.0 0.0
4  0 1 2 3  255 0 0 #red
4  7 4 0 3  0 255 0 #green
4  4 5 1 0  0 0 255 #blue
4  5 6 2 1  0 255 0
4  3 2 6 7  0 0 255
4  6 5 4 7  255 0 0
"""
OFF_PLACES = [
    [1, 0, 1],
    [0, 1, 1],
    [-1, 0, 1],
    [0, -1, 1],
    [1, 0, 0],
    [0, 1, 0],
    [-1, 0, 0],
    [0, -1, 0],
]
OFF_QUADS = [[0, 1, 2, 3], [7, 4, 0, 3], [4, 5, 1, 0], [5, 6, 2, 1], [3, 2, 6, 7], [6, 5, 4, 7]]
TRIANGLE = "AAABAAIAAAAAAAAAAAAAAAAAAAAAAIA/AAAAAAAAAAAAAAAAAACAPwAAAAA="
GLTF_TRIANGLE = {  # "A minimal glTF file" of Khronos's tutorial
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 1}, "indices": 0}]}],
    "buffers": [{"uri": f"data:application/octet-stream;base64,{TRIANGLE}", "byteLength": 44}],
    "bufferViews": [
        {"buffer": 0, "byteOffset": 0, "byteLength": 6, "target": 34963},
        {"buffer": 0, "byteOffset": 8, "byteLength": 36, "target": 34962},
    ],
    "accessors": [
        {
            "bufferView": 0,
            "byteOffset": 0,
            "componentType": 5123,
            "count": 3,
            "type": "SCALAR",
            "max": [2],
            "min": [0],
        },
        {"bufferView": 1, "byteOffset": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
    ],
    "asset": {"version": "2.0"},
}
SPARSE_PLACES = [[x, y, 0] for y in (0, 1) for x in range(7)]
SPARSE_FACES = [each for i in range(6) for each in ([i, i + 8, i + 7], [i, i + 1, i + 8])]
SPARSE_MOVED = {8: [1, 2, 0], 10: [3, 3, 0], 12: [5, 4, 0]}


def gltf_sparse():
    """ "Simple sparse accessor" of the same tutorial: three of fourteen places are moved."""
    parts = [
        np.asarray(SPARSE_FACES, "<u2").tobytes(),
        np.asarray(SPARSE_PLACES, "<f4").tobytes(),
        np.asarray(list(SPARSE_MOVED), "<u2").tobytes() + b"\0\0",
        np.asarray(list(SPARSE_MOVED.values()), "<f4").tobytes(),
    ]
    starts = np.cumsum([0, *map(len, parts)])
    views = [
        {"buffer": 0, "byteOffset": int(start), "byteLength": len(part)}
        for start, part in zip(starts, parts, strict=False)
    ]
    places = {"bufferView": 1, "componentType": 5126, "count": 14, "type": "VEC3"}
    moved = {"bufferView": 2, "componentType": 5123}
    places["sparse"] = {"count": 3, "indices": moved, "values": {"bufferView": 3}}
    data = base64.b64encode(b"".join(parts)).decode()
    return GLTF_TRIANGLE | {
        "buffers": [
            {"uri": f"data:application/gltf-buffer;base64,{data}", "byteLength": int(starts[-1])}
        ],
        "bufferViews": views,
        "accessors": [
            {"bufferView": 0, "componentType": 5123, "count": 36, "type": "SCALAR"},
            places,
        ],
    }


def quads(faces):
    return np.asarray(faces)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


EXAMPLES = {
    "cube.ply": (PLY_CUBE, CUBE, quads(CUBE_QUADS)),
    "square.obj": (OBJ_SQUARE, [[0, 2, 0], [0, 0, 0], [2, 0, 0], [2, 2, 0]], quads([[0, 1, 2, 3]])),
    "facet.stl": (STL_FACET, [[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.asarray([[0, 1, 2]])),
    "cube.off": (OFF_CUBE, OFF_PLACES, quads(OFF_QUADS)),
    "triangle.gltf": (
        json.dumps(GLTF_TRIANGLE),
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        np.asarray([[0, 1, 2]]),
    ),
    "sparse.gltf": (
        json.dumps(gltf_sparse()),
        [SPARSE_MOVED.get(i, place) for i, place in enumerate(SPARSE_PLACES)],
        np.asarray(SPARSE_FACES),
    ),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_the_formats_own_texts(tmp_path, name):
    text, places, faces = EXAMPLES[name]
    (tmp_path / name).write_text(text)
    compare(tmp_path / name, places, faces)
