"""Files that are cut short, that trimesh would misread, or that hold what cannot be: refused in one
sentence that names the file, the value and the remedy.
"""

import numpy as np
import pytest
import trimesh
from PIL import Image
from writers import (
    SQUARE,
    TRIANGLES,
    UVS,
    gltf,
    ramp,
    textured_gltf,
    write_gltf,
    write_obj,
    write_ply,
    xyz,
)

from splatjax.io import read_splats, read_textured_mesh, sample_mesh


def read(path):
    return read_textured_mesh(path, mm_per_unit=1.0)


def refused(path, value, read=read, kind=ValueError):
    with pytest.raises(kind) as caught:
        read(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert value in message
    assert "\n" not in message


def write_any(path, text):
    (path.write_bytes if isinstance(text, bytes) else path.write_text)(text)
    return path


ROWS = "v 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\n"
POINTS = np.random.default_rng(0).normal(size=(20, 3)).astype("<f4")
XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(header, body=b"", kind="ascii"):
    return f"ply\nformat {kind} 1.0\n{header.strip()}\nend_header\n".encode() + body


BINARY = "binary_little_endian"


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("a.obj", ROWS + "f 1 2 5\n", "IndexError"),
        ("a.obj", ROWS + "f -4 -3 -2 -1\n", "f -4 -3 -2 -1"),
        ("a.obj", ROWS + "f 1 2 0\n", "f 1 2 0"),
        ("a.obj", ROWS + "f 1 2 three\n", "f 1 2 three"),
        ("a.obj", ROWS + "f 1 2\n", "f 1 2"),
        ("a.obj", ROWS + " f 1 2 3\n", " f 1 2 3"),
        ("a.obj", ROWS + "f\t1 2 3\n", "f 1 2 3"),
        ("a.obj", ROWS + "v 1_0 0 0\nf 1 2 3\n", "v 1_0 0 0"),
        ("a.obj", ROWS + "v 1 1\nf 1 2 3\n", "a.obj"),
        ("a.obj", ROWS + "v 1 nan 0\nf 1 2 5\n", "not finite"),
        ("a.obj", ROWS + "v 1e300 0 0\nf 1 2 5\n", "1e+12"),
        ("a.obj", ROWS + "vt 0 0\nvn 0 0 1\nf 1/1 2/1 3/1\nf 1//1 2//1 3//1\n", "v//vn"),
        ("a.obj", ROWS.replace("\n", " 2 3 4\n") + "f 1 2 3\n", "colors"),
        ("a.obj", ROWS + "surf 0 1 0 1 1 2 3\nf 1 2 3\n", "surf 0 1 0 1 1 2 3"),
        ("a.obj", ROWS, "triangle"),
        ("a.obj", ROWS + "f 1 2 3", "a.obj"),
        ("a.stl", b"\0" * 80 + (10**9).to_bytes(4, "little") + b"\0" * 50, "1000000000"),
        ("a.off", "OFF\n1000000000000 3 0\n0 0 0\n", "1000000000000"),
        ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "a.off"),
        ("a.off", "COFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "OFF"),
        ("a.glb", b"PK\3\4", "a.glb"),
        ("a.glb", b"glTF\2\0\0\0\xff\xff\xff\x7f\xff\xff\xff\x7fJSON", "a.glb"),
        ("a.png", "", "glb, gltf, obj, off, ply, stl"),
        (
            "a.ply",
            ply(f"element vertex 1\n{XYZ}element edge 1\nproperty int a", b"0 0 0\n1\n"),
            "a.ply",
        ),
    ],
)
def test_meshes_that_cannot_be_read(tmp_path, name, text, value):
    refused(write_any(tmp_path / name, text), value)


QUANTIZED = {
    "POSITION": SQUARE,
    "TEXCOORD_0": (65535 * UVS).astype("u2"),
    "indices": TRIANGLES.astype("u1"),
}
ACCESSOR = {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"}


@pytest.mark.parametrize(
    ("content", "value"),
    [
        (gltf(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression"),
        (gltf(asset={"version": "1.0"}), "1.0"),
        (gltf(QUANTIZED, {"TEXCOORD_0"}), "quantized"),
        (gltf(primitive={"mode": 6}), "fans"),
        (gltf(primitive={"mode": 1}), "triangle"),
        (gltf(accessors=[ACCESSOR | {"count": 10**15}] * 2), "1000000000000000"),
        (gltf(accessors=[ACCESSOR | {"count": -3}]), "-3"),
        (gltf(accessors=[ACCESSOR | {"sparse": {"count": 1}}]), "sparse"),
        (gltf(bufferViews=[{"buffer": 0, "byteLength": 10**9}] * 2), "a.gltf"),
        (gltf(buffers=[{"byteLength": 36, "uri": "../a.bin"}]), "../a.bin"),
        (gltf(nodes=[{"mesh": 0, "scale": [1e300, 1, 1]}]), "1e+12"),
        (gltf(meshes=5), "a.gltf"),
        (
            textured_gltf(ramp(), images=[{"uri": "data:;base64,AAAA", "mimeType": "image/ktx2"}]),
            "a.gltf",
        ),
        (
            textured_gltf(
                ramp(), 2 * UVS, samplers=[{"wrapS": 33071}], textures=[{"source": 0, "sampler": 0}]
            ),
            "border",
        ),
        (
            textured_gltf(
                ramp(),
                materials=[
                    {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}
                ],
            ),
            "coordinates",
        ),
    ],
)
def test_gltf_that_cannot_be_read(tmp_path, content, value):
    refused(write_gltf(tmp_path / "a.gltf", content), value)


def test_a_scene_repeated_beyond_memory(tmp_path):
    """A megabyte that stands for 10^9 triangles."""
    places = np.random.default_rng(0).normal(size=(30_000, 3)).astype("f4")
    nodes = {"nodes": [{"mesh": 0}] * 40_000, "scenes": [{"nodes": list(range(40_000))}]}
    refused(
        write_gltf(tmp_path / "a.glb", gltf({"POSITION": places}, **nodes)), "2400000000 corners"
    )


@pytest.mark.parametrize(
    ("data", "value"),
    [
        (ply(f"element vertex 20000000000000\n{XYZ}", POINTS.tobytes(), BINARY), "a.ply"),
        (ply(f"element vertex 2000000000\n{XYZ}", b"0 0 0\n"), "2000000000"),
        (ply(f"element vertex 20\n{XYZ}", POINTS.tobytes() + b"more", BINARY), "a.ply"),
        (ply(f"element vertex -1\n{XYZ}", b"", BINARY), "a.ply"),
        (ply(f"element vertex 20\n{XYZ}property float nx", b"0 0 0 1\n" * 20), "nx ny nz"),
        (ply(f"element vertex 20\n{XYZ}property float nx", b"0 0 0\n" * 20), "nx"),
        (ply("element vertex 1\nproperty list uchar float x", b"1 0\n"), "a.ply"),
        (ply(f"element vertex 20\n{XYZ}", b"1 1 1\n" * 20), "a.ply"),
        (ply(f"element vertex 2\n{XYZ}", b"1e30 1 1\n0 0 0\n"), "1e+30"),
        (ply(f"element vertex 1\n{XYZ}", b"1 x 1\n"), "a.ply"),
        (ply(f"element corner 1\n{XYZ}", b"1 1 1\n"), "x y z"),
        (ply(f"element vertex 0\n{XYZ}"), "x y z"),
        (b"hello\n", "a.ply"),
        (b"", "a.ply"),
    ],
)
def test_points_that_cannot_be_read(tmp_path, data, value):
    refused(write_any(tmp_path / "a.ply", data), value, read_splats)


def whole_files(folder):
    """Write a box in every format, with a triangle more than once where files are longer so."""
    box = trimesh.creation.box()
    for suffix in ("obj", "off", "stl", "ply", "glb"):
        box.export(folder / f"a.{suffix}")
    box.export(folder / "b.ply", encoding="ascii")
    box.export(folder / "b.stl", file_type="stl_ascii")
    write_gltf(folder / "a.gltf", gltf())
    return sorted(folder.iterdir())


def test_no_file_that_is_cut_short_is_read_in_silence(tmp_path):
    """Cut at any byte; only of OBJ nobody knows how many lines there should be."""
    for path in whole_files(tmp_path):
        data, whole = path.read_bytes(), read(path)[0]
        stripped, cut = len(data.rstrip()), path.with_name(f"cut{path.suffix}")
        for size in range(0, len(data), max(1, len(data) // 150)):
            cut.write_bytes(data[:size])
            try:
                mesh, _ = read(cut)
            except ValueError:
                continue
            at_end_of_line = path.suffix == ".obj" and data[size - 1 : size] == b"\n"
            assert at_end_of_line or (size >= stripped and len(mesh.faces) == len(whole.faces)), (
                size
            )


def test_what_is_asked_of_a_mesh_must_be_there(tmp_path):
    path, picture = write_obj(tmp_path / "square.obj"), tmp_path / "ramp.png"
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
    inner = tmp_path / "inner"
    inner.mkdir()
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "secret.png")
    path = write_obj(inner / "a.obj", extra="mtllib coat.mtl\nusemtl cloth")
    for name in ("../secret.png", str(tmp_path / "secret.png"), "C:\\maps\\secret.png", "gone.png"):
        (inner / "coat.mtl").write_text(f"newmtl cloth\nKd 0.8 0.8 0.8\nmap_Kd {name}\n")
        with pytest.warns(UserWarning, match=r"a\.obj: names .*which is not beside it"):
            assert read(path)[1].albedo is None
    Image.new("RGB", (2, 2), (0, 255, 0)).save(inner / "secret.png")
    (inner / "coat.mtl").write_text("newmtl cloth\nKd 0.8 0.8 0.8\nmap_Kd C:\\maps\\secret.png\n")
    np.testing.assert_allclose(read(path)[1].albedo[0, 0], [0, 1, 0])
    (inner / "secret.png").write_bytes(b"no picture")
    with pytest.warns(UserWarning, match="no picture that trimesh reads"):
        read(path)
    (inner / "coat.mtl").unlink()
    with pytest.warns(UserWarning, match=r"'coat.mtl', which is not beside it"):
        read(path)
    refused(
        write_gltf(inner / "a.gltf", gltf(buffers=[{"byteLength": 60, "uri": "../a.bin"}])),
        "../a.bin",
    )
