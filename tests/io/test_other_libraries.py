"""Files that other libraries write, read here; and files written here, read by them."""

import jax.numpy as jnp
import meshio
import numpy as np
import plyfile
import pygltflib
import pytest
import trimesh
from PIL import Image

from splatjax.io import read_mesh, read_splats, write_splats
from splatjax.io._color import srgb_to_linear
from splatjax.scene import Splats

SINGLE = 1e-6
MM = 2.0


def ball():
    """A ball of 320 triangles with normals that are not its own, texture coordinates and colors."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=3.0)
    random = np.random.default_rng(0)
    count = len(mesh.vertices)
    uvs = random.uniform(0, 1, (count, 2))
    colors = random.integers(0, 256, (count, 4), dtype=np.uint8)
    return np.array(mesh.vertices) + 1.0, np.array(mesh.faces), uvs, colors


def triangles(vertices, faces):
    """Corners of triangles, whatever the order of vertices and triangles and where each triangle
    begins.
    """
    corners = np.round(np.asarray(vertices, np.float64)[faces], 4) + 0.0
    starts = (
        np.lexsort(np.moveaxis(corners, 2, 0)[::-1].reshape(3, -1))
        .argsort()
        .reshape(len(corners), 3)
        .argmin(axis=1)
    )
    turned = corners[np.arange(len(corners))[:, None], (starts[:, None] + np.arange(3)) % 3]
    return turned[np.lexsort(turned.reshape(len(turned), -1).T[::-1])]


def same(mesh, vertices, faces, scale=MM):
    np.testing.assert_allclose(
        triangles(mesh.vertices, mesh.faces),
        triangles(np.asarray(vertices) * scale, faces),
        atol=2e-4,
    )


@pytest.mark.parametrize("suffix", ["ply", "ascii.ply", "obj", "glb", "stl", "ascii.stl", "off"])
def test_trimesh_writes_what_is_read(tmp_path, suffix):
    vertices, faces, _, colors = ball()
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)
    path = tmp_path / f"ball.{suffix}"
    how = {"ascii.ply": {"encoding": "ascii"}, "ascii.stl": {"file_type": "stl_ascii"}}.get(
        suffix, {}
    )
    mesh.export(path, **how)
    found, _ = read_mesh(path, mm_per_unit=MM)
    same(found, vertices, faces)
    assert found.volume() > 0
    if suffix.endswith(("ply", "obj")):
        assert found.colors is not None
        order = np.lexsort(np.round(found.vertices, 4).T[::-1])
        expected = srgb_to_linear(colors[:, :3] / 255)[
            np.lexsort(np.round(MM * vertices, 4).T[::-1])
        ]
        np.testing.assert_allclose(found.colors[order], expected, atol=1e-3)


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "off"])
def test_meshio_writes_what_is_read(tmp_path, suffix):
    vertices, faces, _, _ = ball()
    path = tmp_path / f"ball.{suffix}"
    meshio.write(path, meshio.Mesh(vertices, [("triangle", faces)]))
    same(read_mesh(path, mm_per_unit=MM)[0], vertices, faces)


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_plyfile_writes_polygons_normals_and_colors(tmp_path, text, order):
    """Triangles, quads and a pentagon in one list, with a list of something else between them."""
    places = np.asarray(
        [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 3, 0], [1, 1, 5]], np.float64
    )
    names = ("x", "y", "z", "nx", "ny", "nz")
    table = np.empty(
        6, [(name, "f8") for name in names] + [(name, "u2") for name in ("red", "green", "blue")]
    )
    for i, name in enumerate(names):
        table[name] = places[:, i] if i < 3 else np.eye(3)[2, i - 3]
    table["red"], table["green"], table["blue"] = 65535, 32768, 0
    polygons = [
        np.asarray([0, 1, 2, 4, 3], "i4"),
        np.asarray([0, 5, 1], "i4"),
        np.asarray([1, 5, 2, 2], "i4"),
    ]
    faces = np.empty(3, [("flags", "u1"), ("vertex_indices", object), ("weights", object)])
    faces["flags"], faces["vertex_indices"] = 1, polygons
    faces["weights"] = [np.zeros(n, "f4") for n in (0, 2, 1)]
    elements = [
        plyfile.PlyElement.describe(faces, "face", val_types={"weights": "f4"}),
        plyfile.PlyElement.describe(table, "vertex"),
    ]
    plyfile.PlyData(elements, text=text, byte_order=order, comments=["between"]).write(
        str(tmp_path / "a.ply")
    )
    found, _ = read_mesh(tmp_path / "a.ply", mm_per_unit=1.0)
    expected = [[0, 1, 2], [0, 2, 4], [0, 4, 3], [0, 5, 1], [1, 5, 2], [1, 2, 2]]
    np.testing.assert_array_equal(found.faces, expected)
    np.testing.assert_allclose(found.vertices, places)
    np.testing.assert_allclose(found.normals, np.tile([0, 0, 1], (6, 1)))
    np.testing.assert_allclose(found.colors, np.tile([1, 0.2140529, 0], (6, 1)), atol=1e-5)
    with pytest.warns(
        UserWarning,
        match=r"a\.ply: has faces, and only their corners are taken, as points; cover it .* sample",
    ):
        assert read_splats(tmp_path / "a.ply").count == 6


def test_splats_written_here_are_read_by_three_libraries(tmp_path):
    vertices, _, _, _ = ball()
    count = len(vertices)
    normals = np.tile(np.float32([0, 0.6, 0.8]), (count, 1))
    columns = (vertices, normals, np.ones(count), np.full(count, 0.5), np.full((count, 3), 0.25))
    splats = Splats(*(jnp.asarray(column, jnp.float32) for column in columns))
    write_splats(tmp_path / "a.ply", splats)
    np.testing.assert_array_equal(meshio.read(tmp_path / "a.ply").points, np.float32(vertices))
    np.testing.assert_array_equal(
        np.asarray(trimesh.load(tmp_path / "a.ply").vertices, np.float32), np.float32(vertices)
    )
    table = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"]
    np.testing.assert_array_equal(
        np.stack([table[name] for name in ("nx", "ny", "nz")], axis=1), normals
    )
    np.testing.assert_array_equal(table["green"], np.float32(0.25))


def test_scenes_of_trimesh_keep_their_places_and_their_textures(tmp_path):
    """Two balls with textures of their own, one turned, moved and mirrored, and one plain ball."""
    vertices, faces, uvs, _ = ball()
    pictures = [Image.new("RGB", (4, 4), color) for color in ((255, 0, 0), (0, 128, 0))]
    materials = [
        trimesh.visual.material.PBRMaterial(baseColorTexture=picture) for picture in pictures
    ]
    materials.append(trimesh.visual.material.PBRMaterial(baseColorFactor=[0, 0, 255, 255]))
    turn = trimesh.transformations.euler_matrix(0.3, -0.5, 1.0)
    turn[:3, 3] = [10, 20, 30]
    mirror = turn @ np.diag([-2.0, 1.0, 1.0, 1.0])
    scene = trimesh.Scene()
    places = [np.eye(4), mirror, turn]
    for i, (material, place) in enumerate(zip(materials, places, strict=True)):
        visual = trimesh.visual.TextureVisuals(uv=uvs if i < 2 else None, material=material)
        scene.add_geometry(
            trimesh.Trimesh(vertices, faces, visual=visual, process=False),
            geom_name=str(i),
            transform=place,
        )
    scene.export(tmp_path / "scene.glb")
    found, textures = read_mesh(tmp_path / "scene.glb", mm_per_unit=MM)
    moved = [vertices @ place[:3, :3].T + place[:3, 3] for place in places]
    turned = [faces, faces[:, ::-1], faces]
    same(
        found,
        np.concatenate(moved),
        np.concatenate([each + i * len(vertices) for i, each in enumerate(turned)]),
    )
    np.testing.assert_allclose(
        found.volume(), 4 * 8 * trimesh.Trimesh(vertices, faces).volume, rtol=1e-5
    )
    assert found.parts is not None
    colors = {}
    for part, picture in enumerate(textures.albedo):
        colors[
            round(float(found.vertices[found.faces[found.parts == part]].mean(axis=(0, 1))[1]), 1)
        ] = picture[0, 0]
    assert len(colors) == 3
    np.testing.assert_allclose(
        sorted(map(tuple, colors.values())), [(0, 0, 1), (0, 0.2158605, 0), (1, 0, 0)], atol=1e-6
    )


def gltf(tmp_path, kinds, *, sparse=False, strided=False):
    """A square written by pygltflib with texture coordinates, colors and indices of the given
    types.
    """
    corners = np.asarray([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
    uvs = np.asarray([[0, 1], [1, 1], [1, 0], [0, 0]], np.float64)
    codes = {"u1": 5121, "u2": 5123, "u4": 5125, "f4": 5126}
    uv_kind, color_kind, index_kind = kinds

    def stored(values, kind):
        return (values * (np.iinfo(kind).max if kind[0] == "u" else 1)).astype(f"<{kind}")

    raised = corners.copy()
    if sparse:
        corners[2] = 0
    stride = 16 if strided else 12
    rows = np.zeros((4, stride), np.uint8)
    rows[:, :12] = corners.view(np.uint8)
    shared = np.asarray([0, 1, 2, 0, 2, 3], f"<{index_kind}")
    parts = [
        shared.tobytes(),
        rows.tobytes(),
        stored(uvs, uv_kind).tobytes(),
        stored(np.eye(4)[:, :3] / 2, color_kind).tobytes(),
    ]
    parts += [np.uint16([2]).tobytes(), raised[2].tobytes()]
    padded = [part + b"\0" * (-len(part) % 4) for part in parts]
    starts = np.cumsum([0, *map(len, padded)])
    floats = {"componentType": 5126, "count": 4, "type": pygltflib.VEC3}
    place = pygltflib.Accessor(bufferView=1, **floats)
    if sparse:
        place.sparse = pygltflib.Sparse(
            count=1,
            indices=pygltflib.AccessorSparseIndices(bufferView=4, componentType=5123),
            values=pygltflib.AccessorSparseValues(bufferView=5),
        )
    file = pygltflib.GLTF2(
        scene=0,
        scenes=[pygltflib.Scene(nodes=[0])],
        nodes=[
            pygltflib.Node(children=[1], scale=[2, 2, 2]),
            pygltflib.Node(mesh=0, translation=[1, 0, 0]),
        ],
        meshes=[
            pygltflib.Mesh(
                primitives=[
                    pygltflib.Primitive(
                        attributes=pygltflib.Attributes(POSITION=1, TEXCOORD_0=2, COLOR_0=3),
                        indices=0,
                    )
                ]
            )
        ],
        accessors=[
            pygltflib.Accessor(
                bufferView=0, componentType=codes[index_kind], count=6, type=pygltflib.SCALAR
            ),
            place,
            pygltflib.Accessor(
                bufferView=2,
                componentType=codes[uv_kind],
                count=4,
                type=pygltflib.VEC2,
                normalized=uv_kind != "f4",
            ),
            pygltflib.Accessor(
                bufferView=3,
                componentType=codes[color_kind],
                count=4,
                type=pygltflib.VEC3,
                normalized=color_kind != "f4",
            ),
        ],
        bufferViews=[
            pygltflib.BufferView(buffer=0, byteOffset=int(start), byteLength=len(part))
            for start, part in zip(starts, parts, strict=False)
        ],
        buffers=[pygltflib.Buffer(byteLength=int(starts[-1]))],
    )
    if strided:
        file.bufferViews[1].byteStride = stride
    file.set_binary_blob(b"".join(padded))
    file.save_binary(str(tmp_path / "a.glb"))
    return tmp_path / "a.glb"


@pytest.mark.parametrize("kinds", [("f4", "f4", "u1"), ("u1", "u2", "u2"), ("u2", "u1", "u4")])
@pytest.mark.parametrize("how", [{}, {"sparse": True}, {"strided": True}])
def test_accessors_of_every_type(tmp_path, kinds, how):
    found, _ = read_mesh(gltf(tmp_path, kinds, **how), mm_per_unit=1.0)
    np.testing.assert_allclose(found.vertices, [[2, 0, 0], [6, 0, 0], [6, 4, 0], [2, 4, 0]])
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_allclose(found.uvs[0], [[0, 0], [1, 0], [1, 1]], atol=1e-6)
    np.testing.assert_allclose(found.colors, np.eye(4)[:, :3] / 2, atol=0.5 / 255)
