"""Files that keep to their format in unusual ways, and files that do not: read right, or refused in
one sentence.
"""

import base64
import json
import struct

import numpy as np
import pytest
from PIL import Image

from splatjax.io import read_mesh, read_splats, sample_mesh

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"


def mesh_of(path, text):
    path.write_text(text)
    return read_mesh(path, mm_per_unit=1.0)[0]


def refused(path, said, read=lambda path: read_mesh(path, mm_per_unit=1.0), kind=ValueError):
    with pytest.raises(kind, match=said) as caught:
        read(path)
    message = str(caught.value)
    assert str(path.parent) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("text", "faces"),
    [
        (SQUARE + "f -4 -3 -2 -1\n", [[0, 1, 2], [0, 2, 3]]),
        ("v 0 0 0\nv 2 0 0\nv 2 2 0\nf -3 -2 -1\nv 0 2 0\nf -4 -2 -1\n", [[0, 1, 2], [0, 2, 3]]),
        (SQUARE + "f 1// 2// 3//\nf 1 3 4 # with a word after\n", [[0, 1, 2], [0, 2, 3]]),
        (
            SQUARE.replace("\n", "\r\n") + "g a\r\ns off\r\nf 1 \\\r\n2 3\r\nl 1 2\r\nf\t1 3 4\r\n",
            [[0, 1, 2], [0, 2, 3]],
        ),
        (SQUARE.replace("0\n", "0 1.0\n") + "f 1 2 3 4", [[0, 1, 2], [0, 2, 3]]),
    ],
)
def test_obj_faces_are_counted_from_either_end(tmp_path, text, faces):
    mesh = mesh_of(tmp_path / "a.obj", text)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_allclose(mesh.vertices, [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, 1], (4, 1)))


def polygon_obj(folder, places):
    rows = "".join("v {} {} {}\n".format(*place) for place in places)
    (folder / "a.obj").write_text(f"{rows}f {' '.join(str(i + 1) for i in range(len(places)))}\n")
    return folder / "a.obj"


def polygon_off(folder, places):
    rows = "".join("{} {} {}\n".format(*place) for place in places)
    (folder / "a.off").write_text(
        f"OFF\n{len(places)} 1 0\n{rows}{len(places)} {' '.join(map(str, range(len(places))))}\n"
    )
    return folder / "a.off"


def polygon_ply(folder, places):
    header = [
        ASCII,
        f"element vertex {len(places)}",
        *(f"property double {axis}" for axis in "xyz"),
        "element face 1",
    ]
    rows = (
        "".join("{} {} {}\n".format(*place) for place in places)
        + f"{len(places)} {' '.join(map(str, range(len(places))))}\n"
    )
    return ply(folder / "a.ply", [*header, "property list uchar int vertex_indices"], rows.encode())


WRITERS = {"obj": polygon_obj, "off": polygon_off, "ply": polygon_ply}
POLYGONS = {
    "arrow": [(0, 0), (4, 4), (0, 2), (-4, 4)],
    "comb": [
        (0, 0),
        (6, 0),
        (6, 4),
        (5, 4),
        (5, 1),
        (4, 1),
        (4, 4),
        (2, 4),
        (2, 1),
        (1, 1),
        (1, 4),
        (0, 4),
    ],
    "convex": [(0, 0), (2, 0), (3, 1), (2, 2), (0, 2)],
}


@pytest.mark.parametrize("shape", POLYGONS)
@pytest.mark.parametrize("start", [0, 1, 2])
@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_polygons_are_covered_and_no_more_or_refused(tmp_path, shape, start, write):
    """Wherever the polygon begins and however it stands in space, the fan of its triangles has its
    area and faces its way.
    """
    corners = POLYGONS[shape]
    corners = corners[start:] + corners[:start]
    x, y = np.asarray(corners, float).T
    area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
    path = write(tmp_path, [[3 - v, u, 0.5 * u] for u, v in corners])
    if shape == "comb" or (shape == "arrow" and start == 1):
        refused(path, f"face 0, of {len(corners)} corners, is not convex; cut it into triangles")
        return
    mesh = read_mesh(path, mm_per_unit=1.0)[0]
    assert len(mesh.faces) == len(corners) - 2
    np.testing.assert_allclose(mesh.face_areas().sum(), area * np.sqrt(1.25), rtol=1e-12)
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    assert (np.cross(b - a, c - a) @ np.asarray([0, -1, 2]) > 0).all()


def test_obj_normals_make_creases_and_lacking_ones_are_made(tmp_path):
    """A roof whose left half has normals of its own: they are kept, the right half gets that of its
    faces.
    """
    text = "v 0 0 0\nv 0 1 0\nv -1 0 -1\nv 1 0 -1\nvn -1 0 0\nf 1//1 2//1 3//1\nf 2 1 4\n"
    mesh = mesh_of(tmp_path / "a.obj", text)
    assert len(mesh.vertices) == 6
    np.testing.assert_allclose(mesh.normals[mesh.faces[0]], np.tile([-1, 0, 0], (3, 1)))
    np.testing.assert_allclose(
        mesh.normals[mesh.faces[1]], np.tile([np.sqrt(0.5), 0, np.sqrt(0.5)], (3, 1)), atol=1e-12
    )


def sampled(path):
    return sample_mesh(path, 5, mm_per_unit=1.0)


def dressed_obj(
    folder, material="newmtl cloth\nKd 0.8 0.8 0.8\nmap_Kd my map.png\n", name="coat.mtl"
):
    Image.new("RGB", (2, 2), (255, 0, 0)).save(folder / "my map.png")
    (folder / "coat.mtl").write_text(material)
    coordinates = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (folder / "a.obj").write_text(
        f"mtllib {name}\n{SQUARE}{coordinates}usemtl cloth\nf 1/1 2/2 3/3 4/4\n"
    )
    return folder / "a.obj"


def test_obj_wears_the_texture_of_its_material(tmp_path):
    splats = sample_mesh(dressed_obj(tmp_path), 20, mm_per_unit=1.0)
    np.testing.assert_allclose(np.asarray(splats.albedo), np.tile([1, 0, 0], (20, 1)))
    with pytest.warns(
        UserWarning,
        match=r"a.obj: names 'gone.mtl', and there is no such file beside it.*no texture is worn",
    ):
        assert (
            sample_mesh(dressed_obj(tmp_path, name="gone.mtl"), 20, mm_per_unit=1.0).albedo is None
        )


def test_textures_are_taken_from_the_files_own_folder_alone(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    Image.new("RGB", (2, 2)).save(tmp_path / "secret.png")
    for name in ("../secret.png", str(tmp_path / "secret.png"), "C:\\secret.png", "..\\secret.png"):
        path = dressed_obj(inner, f"newmtl cloth\nmap_Kd {name}\n")
        refused(
            path,
            "which lies outside its folder; put that file beside it",
            lambda path: sample_mesh(path, 5, mm_per_unit=1.0),
        )
        assert sample_mesh(path, 5, mm_per_unit=1.0, albedo=inner / "my map.png").albedo is not None
    refused(dressed_obj(inner, name="../coat.mtl"), "which lies outside its folder")
    path = dressed_obj(inner, "newmtl cloth\nmap_Kd -s 2 2 1 my map.png\n")
    refused(path, "lays its texture with options", sampled)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SQUARE + "f 1 2 5\n", "a face names v 5, but there are 4 v;"),
        (SQUARE + "f 1 2 -5\n", "a corner of a face is `-5`, which names nothing;"),
        (SQUARE + "f 1 2 0\n", "a corner of a face is `0`"),
        (SQUARE + "f 1/1 2/1 3/1\n", "a face names vt 1, but there are 0 vt"),
        (SQUARE + "vn 0 0 1\nf 1//1 2//1 3\n", "has corners of several kinds"),
        (SQUARE + "f 1 2 three\n", "a corner of a face is `three`"),
        (SQUARE + "v 1_0 0 0\nf 1 2 3\n", "`v 1_0 0 0` is no row of 3 numbers"),
        ("v 5 0 0\nv 2 0 0\nv 2 2 0\nv 1 3 0\nv 0 2 0\nf 1 2 3 4 5\n", "is not convex"),
        (SQUARE + "f 1 2\n", "the face `f 1 2` has less than three corners"),
        (SQUARE + "v 1 nan 0\nf 1 2 5\n", "not finite"),
        (
            SQUARE + "v 1 x 0\nf 1 2 3\n",
            "cannot be read as OBJ: .*; it is cut short or wrong, write it again",
        ),
        (SQUARE + "v 1 1\nf 1 2 3\n", "`v 1 1` is no row of 3 numbers"),
        (SQUARE + "v 1e300 0 0\nf 1 2 5\n", "or reach 1e"),
        ("cstype bezier\nsurf 0 1 0 1 1 2 3\n" + SQUARE, "has curved surfaces"),
        (SQUARE, "holds no triangle"),
        ("", "holds no triangle"),
    ],
)
def test_obj_that_is_wrong_is_refused(tmp_path, text, said):
    (tmp_path / "a.obj").write_text(text)
    refused(tmp_path / "a.obj", said)


def ply(path, header, body=b""):
    path.write_bytes("\n".join(["ply", *header, "end_header", ""]).encode() + body)
    return path


ASCII, BINARY = "format ascii 1.0", "format binary_little_endian 1.0"
XYZ = [f"property float {axis}" for axis in "xyz"]
POINTS = np.random.default_rng(0).normal(size=(20, 3)).astype("<f4")


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_ply_of_every_newline_with_comments_of_any_language(tmp_path, newline):
    rows = "\n".join(" ".join(map(repr, row)) for row in POINTS.tolist())
    text = "\n".join(
        [
            "ply",
            ASCII,
            "comment Größe in mm",
            "obj_info 3",
            "element vertex 20",
            *XYZ,
            "end_header",
            rows,
            "",
            "",
        ]
    )
    (tmp_path / "a.ply").write_bytes(text.replace("\n", newline).encode())
    splats = read_splats(tmp_path / "a.ply")
    np.testing.assert_allclose(
        np.sort(np.asarray(splats.centers), axis=0), np.sort(POINTS, axis=0), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("header", "body", "said"),
    [
        (
            [BINARY, "element vertex 20000000000000", *XYZ],
            POINTS.tobytes(),
            "promises 240000000000000 bytes at least, and 240 follow",
        ),
        (
            [ASCII, "element vertex 2000000000", *XYZ],
            b"0 0 0\n",
            "promises 11999999999 bytes at least, and 6 follow",
        ),
        (
            [
                BINARY,
                "element vertex 20",
                *XYZ,
                "element face 2000000000",
                "property list uchar int vertex_indices",
            ],
            POINTS.tobytes(),
            "promises 2000000240 bytes at least, and 240 follow",
        ),
        (
            [BINARY, "element vertex 20", *XYZ],
            POINTS.tobytes() + b"more",
            "4 bytes follow what its header promises",
        ),
        ([BINARY, "element vertex -1", *XYZ], b"", "its header has an element without a count"),
        (
            [ASCII, "element vertex 20", *XYZ, "property float x"],
            b"0 0 0 0\n" * 20,
            "two properties with same name",
        ),
        (
            [ASCII, "element vertex 1", *XYZ, "element vertex 1", *XYZ],
            b"0 0 0\n" * 2,
            "two elements with same name",
        ),
        (
            [ASCII, "element vertex 1", "property list uchar float x", *XYZ[1:]],
            b"1 0 0 0\n",
            "are lists; write single numbers",
        ),
        (
            [ASCII, "element vertex 20", *XYZ, "property float nx"],
            b"0 0 0 1\n" * 20,
            "have nx without ny; write all of them, or none",
        ),
        (
            [ASCII, "element vertex 20", *XYZ, "property uchar red"],
            b"0 0 0 1\n1 0 0 1\n" * 10,
            "have red without green",
        ),
        (
            [ASCII, "element vertex 1", "property uchar x", *XYZ[1:]],
            b"256 0 0\n",
            "256 out of bounds for uint8",
        ),
        ([ASCII, "element vertex 20", *XYZ], b"1 1 1\n" * 20, "points lie within 0 mm"),
        ([ASCII, "element vertex 2", *XYZ], b"1e30 1 1\n0 0 0\n", "its points reach 1e"),
        ([ASCII, "element vertex 20"], b"", "its element 'vertex' has no property"),
        (
            ["format ascii 2.0", "element vertex 1", *XYZ],
            b"0 0 0\n",
            "line 2: expected version '1.0'",
        ),
        (
            ["element vertex 1", *XYZ],
            b"0 0 0\n",
            "line 2: expected one of {format, comment, obj_info}",
        ),
    ],
)
def test_ply_that_is_wrong_is_refused_before_memory_is_taken(tmp_path, header, body, said):
    refused(ply(tmp_path / "a.ply", header, body), said, read_splats)


def test_points_far_from_the_origin_are_refused_where_precision_does_not_reach(tmp_path, x64):
    """A body of 200 mm in the coordinates of a country, in double precision."""
    rows = (POINTS * 100 + np.asarray([4e8, 5e8, 0])).astype("<f8").tobytes()
    path = ply(
        tmp_path / "a.ply",
        [BINARY, "element vertex 20", *(f"property double {axis}" for axis in "xyz")],
        rows,
    )
    if x64:
        assert read_splats(path).count == 20
    else:
        refused(
            path, "where single precision tells 60 mm apart.*move it to the origin", read_splats
        )


def content(**more):
    data = np.asarray([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    return {
        "asset": {"version": "2.0"},
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [
            {
                "byteLength": 36,
                "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode(),
            }
        ],
    } | more


def gltf(folder, changed):
    (folder / "a.gltf").write_text(json.dumps(changed))
    return folder / "a.gltf"


def test_gltf_with_data_within_and_beside(tmp_path):
    within = read_mesh(gltf(tmp_path, content()), mm_per_unit=1.0)[0]
    np.testing.assert_allclose(within.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    (tmp_path / "my data.bin").write_bytes(within.vertices.astype("<f4").tobytes())
    beside = content(buffers=[{"byteLength": 36, "uri": "my%20data.bin"}])
    np.testing.assert_array_equal(
        read_mesh(gltf(tmp_path, beside), mm_per_unit=1.0)[0].vertices, within.vertices
    )


@pytest.mark.parametrize("mode", [4, 5, 6])
def test_gltf_of_lists_strips_and_fans(tmp_path, mode):
    """Strips are read; fans, which trimesh passes over, are refused."""
    places = np.asarray([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4")
    order = np.asarray([0, 1, 2, 1, 3, 2] if mode == 4 else [0, 1, 2, 3], "u1")
    uri = "data:;base64," + base64.b64encode(places.tobytes() + order.tobytes()).decode()
    made = content(
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
        accessors=[
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": len(order), "type": "SCALAR"},
        ],
        bufferViews=[
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": len(order)},
        ],
        buffers=[{"byteLength": 54, "uri": uri}],
    )
    if mode == 6:
        refused(
            gltf(tmp_path, made), "has triangle fans, which are not read here; export triangles"
        )
        return
    faces = read_mesh(gltf(tmp_path, made), mm_per_unit=1.0)[0].faces
    assert {tuple(np.roll(face, -face.argmin())) for face in faces} == {(0, 1, 2), (1, 3, 2)}


ACCESSOR = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (
            {"extensionsRequired": ["KHR_draco_mesh_compression"]},
            "needs the extension KHR_draco_mesh_compression.*export without it",
        ),
        ({"asset": {"version": "1.0"}}, "of version 1.0, and version 2 is read"),
        (
            {"accessors": [ACCESSOR | {"count": 10**15}]},
            "cannot reshape .* into shape .1000000000000000,3",
        ),
        ({"accessors": [ACCESSOR | {"count": -3}]}, "-3 in the place of a count"),
        ({"accessors": [ACCESSOR | {"type": "MAT9"}]}, "an entry is missing or wrong"),
        (
            {"accessors": [{**ACCESSOR, "bufferView": 7}]},
            "an entry is missing or wrong .IndexError",
        ),
        (
            {"accessors": [{"componentType": 5126, "count": 3, "type": "VEC3"}]},
            "an accessor without data",
        ),
        (
            {"bufferViews": [{"buffer": 0, "byteLength": 10**9}]},
            "promise 1000000000 bytes of a buffer of 36",
        ),
        ({"buffers": [{"byteLength": 36, "uri": "../a.bin"}]}, "which lies outside its folder"),
        ({"buffers": [{"byteLength": 36}]}, "its buffer 0 is nowhere"),
        (
            {"nodes": [{"mesh": 0, "children": [0]}], "scenes": [{"nodes": [0]}]},
            "its node 0 has two parents",
        ),
        ({"nodes": [{"mesh": 0, "rotation": [0, 0, 0, 0]}]}, "a rotation"),
        ({"nodes": [{"mesh": 0, "scale": [1e300, 1, 1]}]}, "transforms that are not finite"),
        (
            {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]}]},
            "holds no triangle",
        ),
        ({"meshes": 5}, "an entry is missing or wrong"),
    ],
)
def test_gltf_that_is_wrong_is_refused(tmp_path, more, said):
    refused(gltf(tmp_path, content(**more)), said)


def test_a_scene_repeated_beyond_memory_is_refused(tmp_path):
    """A few kilobytes that stand for 10^12 triangles."""
    places = np.random.default_rng(0).normal(size=(30_000, 3)).astype("<f4").tobytes()
    made = content(
        accessors=[ACCESSOR | {"count": 30_000}],
        bufferViews=[{"buffer": 0, "byteLength": len(places)}],
        buffers=[
            {"byteLength": len(places), "uri": "data:;base64," + base64.b64encode(places).decode()}
        ],
        nodes=[{"mesh": 0}] * 40_000,
    )
    refused(
        gltf(tmp_path, made),
        "a scene of 2400000000 corners would take about .* GB of memory, and .* are free; export a "
        "part",
    )


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        (
            "a.stl",
            b"\0" * 80 + struct.pack("<I", 10**9) + b"\0" * 50,
            "promises 1000000000 triangles, 50000000084 bytes, and has 134",
        ),
        (
            "a.stl",
            b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\n",
            "ends without `endsolid`",
        ),
        (
            "a.off",
            b"OFF\n1000000000000 3 0\n0 0 0\n",
            "promises 1000000000003 vertices and faces.* 1 lines.*: it is cut short",
        ),
        (
            "a.off",
            b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n",
            "a face index outside the range of its vertices",
        ),
        (
            "a.glb",
            b"glTF\2\0\0\0\xff\xff\xff\x7f\xff\xff\xff\x7fJSON",
            "promises .* bytes, and it has 20: it is cut short",
        ),
        ("a.glb", b"PK\3\4", "does not begin with `glTF`"),
    ],
)
def test_other_formats_that_are_cut_short_are_refused(tmp_path, name, data, said):
    (tmp_path / name).write_bytes(data)
    refused(tmp_path / name, said)
