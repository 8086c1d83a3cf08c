"""Files that are cut short, that trimesh would misread, or that hold what cannot be: refused in one
sentence that names the file, the value and the remedy.
"""

import numpy as np
import pytest
import trimesh
from PIL import Image
from writers import SUFFIXES, TRIANGLES, export, gltf, ramp, square, write_ply, xyz

from splatjax.io import read_splats, read_textured_mesh, sample_mesh


def read(path):
    return read_textured_mesh(path, mm_per_unit=1.0)


def refused(path, value, read=read, kind=ValueError):
    with pytest.raises(kind) as caught:
        read(path)
    message = str(caught.value)
    assert (message.startswith(str(path)), value in message, "\n" in message) == (True, True, False)


def write_any(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


ROWS = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("a.obj", ROWS + "f 1 2 5\n", "IndexError"),
        ("a.obj", ROWS + "f -4 -3 -2 -1\n", "f -4 -3 -2 -1"),
        ("a.obj", ROWS + "f 1 2 0\n", "f 1 2 0"),
        ("a.obj", ROWS + "f 1 2 three\n", "f 1 2 three"),
        ("a.obj", ROWS + "f 1 2\n", "f 1 2"),
        ("a.obj", ROWS + " f 1 2 3\n", " f 1 2 3"),
        ("a.obj", ROWS + "v 1_0 0 0\nf 1 2 3\n", "v 1_0 0 0"),
        ("a.obj", ROWS + "v 1 1\nf 1 2 3\n", "a.obj"),
        ("a.obj", ROWS + "v 1 nan 0\nf 1 2 5\n", "not finite"),
        ("a.obj", ROWS + "v 1e300 0 0\nf 1 2 5\n", "1e+12"),
        ("a.obj", ROWS + "vt 0 0\nvn 0 0 1\nf 1/1 2/1 3/1\nf 1//1 2//1 3//1\n", "v//vn"),
        ("a.obj", ROWS.replace("\n", " 2 3 4\n") + "f 1 2 3\n", "colors"),
        ("a.obj", ROWS + "surf 0 1 0 1 1 2 3\nf 1 2 3\n", "surf 0 1 0 1 1 2 3"),
        ("a.obj", ROWS, "triangle"),
        ("a.stl", b"\0" * 80 + (10**9).to_bytes(4, "little") + b"\0" * 50, "triangle"),
        ("a.off", "OFF\n1000000000000 3 0\n0 0 0\n", "1000000000000"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "a.off"),
        ("a.off", "COFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "OFF"),
        ("a.glb", b"PK\3\4", "a.glb"),
        ("a.glb", b"glTF\2\0\0\0\xff\xff\xff\x7f\xff\xff\xff\x7fJSON", "a.glb"),
        ("a.png", "", "glb, gltf, obj, off, ply, stl"),
    ],
)
def test_meshes_that_cannot_be_read(tmp_path, name, text, value):
    refused(write_any(tmp_path / name, text), value)


@pytest.mark.parametrize(
    ("changes", "value"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"asset_version": "1.0"}, "1.0"),
        ({"accessors_1_componentType": 5123}, "quantized"),
        ({"meshes_0_primitives_0_mode": 6}, '`"mode": 6`'),
        ({"meshes_0_primitives_0_mode": 0}, "triangle"),
        ({"accessors_1_count": 10**15}, "1000000000000000"),
        ({"accessors_1_sparse": {"count": 1}}, "sparse"),
        ({"bufferViews_0_byteLength": 10**9}, "a.gltf"),
        ({"buffers_0_uri": "../a.bin"}, "../a.bin"),
        ({"nodes_0_scale": [1e300, 1, 1]}, "1e+12"),
        ({"meshes": 5}, "a.gltf"),
        ({"images_0_mimeType": "image/ktx2"}, "image/ktx2"),
        ({"samplers": [{"wrapS": 33071}]}, "border"),
        ({"materials_0_pbrMetallicRoughness_baseColorTexture_texCoord": 1}, "texCoord"),
    ],
)
def test_gltf_that_cannot_be_read(tmp_path, changes, value):
    mesh = square(material=trimesh.visual.material.PBRMaterial(baseColorTexture=ramp()))
    mesh.visual.uv = 2 * mesh.visual.uv
    read(gltf(tmp_path / "a.gltf", mesh))
    refused(gltf(tmp_path / "a.gltf", mesh, **changes), value)


def test_a_scene_repeated_beyond_memory(tmp_path):
    """A megabyte that stands for 10^9 triangles."""
    places = np.random.default_rng(0).normal(size=(30_000, 3))
    mesh = trimesh.Trimesh(places, np.arange(30_000).reshape(-1, 3), process=False)
    nodes = {"nodes": [{"mesh": 0}] * 40_000, "scenes_0_nodes": list(range(40_000))}
    refused(gltf(tmp_path / "a.gltf", mesh, **nodes), "2400000000 corners")


def ply(header, body=b"", kind="ascii"):
    header = header.replace("XYZ", "property float x\nproperty float y\nproperty float z")
    return f"ply\nformat {kind} 1.0\n{header}\nend_header\n".encode() + body


POINTS = np.random.default_rng(0).normal(size=(20, 3)).astype("<f4")
BINARY = "binary_little_endian"


@pytest.mark.parametrize(
    ("data", "value"),
    [
        (ply("element vertex 20000000000000\nXYZ", POINTS.tobytes(), BINARY), "a.ply"),
        (ply("element vertex 2000000000\nXYZ", b"0 0 0\n"), "2000000000"),
        (ply("element vertex 20\nXYZ", POINTS.tobytes() + b"more", BINARY), "a.ply"),
        (ply("element vertex -1\nXYZ", b"", BINARY), "a.ply"),
        (ply("element vertex 20\nXYZ\nproperty float nx", b"0 0 0 1\n" * 20), "nx ny nz"),
        (ply("element vertex 20\nXYZ\nproperty float nx", b"0 0 0\n" * 20), "nx"),
        (ply("element vertex 1\nproperty list uchar float x", b"1 0\n"), "a.ply"),
        (ply("element vertex 20\nXYZ", b"1 1 1\n" * 20), "a.ply"),
        (ply("element vertex 2\nXYZ", b"1e30 1 1\n0 0 0\n"), "1e+30"),
        (ply("element vertex 1\nXYZ", b"1 x 1\n"), "a.ply"),
        (ply("element corner 1\nXYZ", b"1 1 1\n"), "x y z"),
        (ply("element vertex 0\nXYZ"), "x y z"),
        (b"hello\n", "a.ply"),
        (b"", "a.ply"),
    ],
)
def test_points_that_cannot_be_read(tmp_path, data, value):
    refused(write_any(tmp_path / "a.ply", data), value, read_splats)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_file_that_is_cut_short_is_read_in_silence(tmp_path, suffix):
    """Cut at any byte; only of OBJ nobody knows how many lines there should be."""
    path = export(trimesh.creation.box(), tmp_path, suffix)
    data, cut = path.read_bytes(), path.with_name(f"cut{path.suffix}")
    for size in range(0, len(data), max(1, len(data) // 150)):
        cut.write_bytes(data[:size])
        is_whole = size >= len(data.rstrip())
        if not is_whole and not (suffix == "obj" and data[size - 1 : size] == b"\n"):
            refused(cut, cut.name)


def test_what_is_asked_of_a_mesh_must_be_there(tmp_path):
    path, picture = export(square(), tmp_path, "obj"), tmp_path / "ramp.png"
    ramp().save(picture)
    bare = write_any(tmp_path / "bare.obj", ROWS + "f 1 2 3\n")
    flat = write_any(tmp_path / "flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")

    def sampled(**options):
        return lambda path: sample_mesh(path, 10, **{"mm_per_unit": 1.0, **options})

    refused(tmp_path / "none.obj", "none.obj", sampled(), FileNotFoundError)
    refused(tmp_path, "folder", sampled(), IsADirectoryError)
    refused(path, "mm_per_unit is -1", sampled(mm_per_unit=-1.0))
    refused(path, "up is 'x'", sampled(up="x"))
    refused(path, "crease_angle is 181", sampled(crease_angle=181.0))
    refused(path, "crop_min_y = 3", sampled(crop_min_y=3.0))
    refused(path, "GB", lambda path: sample_mesh(path, 10**12, mm_per_unit=1.0))
    refused(bare, "texture coordinates", sampled(albedo=picture))
    refused(flat, "area", sampled())


def test_points_far_from_the_origin_where_precision_does_not_reach(tmp_path, x64):
    """A body of 200 mm in the coordinates of a country, in double precision."""
    points = POINTS.astype(float) * 100 + np.asarray([4e8, 5e8, 0])
    path = write_ply(tmp_path / "a.ply", xyz(points))
    if x64:
        assert read_splats(path).count == 20
    else:
        refused(path, "60 mm apart", read_splats)


def test_textures_are_taken_from_the_files_own_folder_alone(tmp_path):
    """A texture elsewhere is sought by its name in this folder; without it, a warning tells."""
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "secret.png")
    inner = tmp_path / "inner"
    inner.mkdir()
    rows = "".join(f"vt {u} {v}\n" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = "".join("f {0}/{0} {1}/{1} {2}/{2}\n".format(*face + 1) for face in TRIANGLES)
    path = write_any(inner / "a.obj", f"mtllib coat.mtl\n{ROWS}{rows}usemtl cloth\n{faces}")
    maps = [f"newmtl cloth\nmap_Kd {name}\n" for name in ("../secret.png", "C:\\maps\\secret.png")]
    maps.append(f"newmtl cloth\nmap_Kd {tmp_path / 'secret.png'}\n")
    for text in maps:
        (inner / "coat.mtl").write_text(text)
        with pytest.warns(UserWarning, match=r"a\.obj: names .*secret.png', which is not beside"):
            assert read(path)[1].albedo is None
    (inner / "secret.png").write_bytes(b"no picture")
    with pytest.warns(UserWarning, match="or no picture"):
        assert read(path)[1].albedo is None
    Image.new("RGB", (2, 2), (0, 255, 0)).save(inner / "secret.png")
    np.testing.assert_allclose(read(path)[1].albedo[0, 0], [0, 1, 0])
    (inner / "coat.mtl").unlink()
    with pytest.warns(UserWarning, match=r"'coat.mtl', which is not beside it"):
        assert read(path)[1].albedo is None
