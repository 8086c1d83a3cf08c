"""Files that are cut short, that trimesh would misread, or that hold what cannot be: refused in one
sentence that names the file, the value and the remedy. Files are written whole or not at all.
"""

import resource
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from pictures import write_picture
from PIL import Image
from writers import (
    SUFFIXES,
    TRIANGLES,
    columns_of,
    export,
    gltf,
    ramp,
    some_frame,
    some_splats,
    square,
    write_ply,
    xyz,
)

import splatjax as sj
from splatjax.io import (
    SplatFile,
    atomic_path,
    load_material,
    read_exr,
    read_manifest,
    read_picture,
    read_profile,
    read_record,
    read_splats,
    read_textured_mesh,
    sample_mesh,
    save_material,
    write_animation,
    write_exr,
    write_png,
    write_record,
    write_splats,
)
from splatjax.io._images import read_color


def read(path):
    return read_textured_mesh(path, mm_per_unit=1.0)


def refused(path, value, read=read, kind=ValueError):
    with pytest.raises(kind) as caught:
        read(path)
    message = str(caught.value)
    assert (str(path.parent) in message, value in message, "\n" in message) == (True, True, False)


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
    faces = np.arange(30_000).reshape(-1, 3)
    mesh = trimesh.Trimesh(np.ones((30_000, 3)), faces, process=False)
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


def changed(names, value):
    ones = dict.fromkeys(("specular", "red", "green", "blue"), np.ones(50, "f4"))
    columns = columns_of(some_splats()) | ones
    is_there = np.arange(50) == 7
    return columns | {name: np.where(is_there, value, columns[name]).astype("f4") for name in names}


SCENE = ("x", "y", "z", "f_dc_0", "scale_0", "rot_0", "opacity")


@pytest.mark.parametrize(
    ("columns", "value"),
    [
        (changed(["x"], np.nan), "x y z of vertex 7"),
        (changed(["nz"], np.inf), "nx ny nz of vertex 7"),
        (changed(["nx", "ny", "nz"], 0), "nx ny nz of vertex 7 is 0 0 0"),
        (changed(["radius"], 0), "radius of vertex 7 is 0"),
        (changed(["area"], -2), "area of vertex 7 is -2"),
        (changed(["red"], 3), "red green blue of vertex 7 is 3 1 1"),
        (changed(["specular"], -1), "specular of vertex 7 is -1"),
        (columns_of(some_splats()) | {"red": np.ones(50)}, "red green blue"),
        (dict.fromkeys(SCENE, np.zeros(5)), "Gaussian-splatting scene"),
    ],
)
def test_values_that_no_splat_may_have(tmp_path, columns, value):
    path = write_ply(tmp_path / "a.ply", columns)
    refused(path, value, read_splats)
    refused(path, value if "area" in columns else "complete", lambda path: list(SplatFile(path)()))


def sampled(**options):
    return lambda path: sample_mesh(path, 10, **{"mm_per_unit": 1.0, **options})


def film(frames, speed=24.0):
    return lambda path: write_animation(
        path, [path.with_name(name) for name in frames], frames_per_second=speed
    )


TWO_CHANNELS = sj.Splats(*(jnp.ones((4, *shape)) for shape in ((3,), (3,), (), (), (2,))))
CALLS = [
    ("none.obj", sampled(), "no such file"),
    ("none.exr", read_exr, "no such file"),
    ("none.png", read_color, "no such file"),
    ("none.ply", SplatFile, "no such file"),
    ("none.csv", read_profile, "no such file"),
    ("folder", sampled(), "folder"),
    ("square.obj", sampled(mm_per_unit=-1.0), "mm_per_unit is -1"),
    ("square.obj", sampled(up="x"), "up is 'x'"),
    ("square.obj", sampled(crease_angle=181.0), "crease_angle is 181"),
    ("square.obj", sampled(crop_min_y=3.0), "crop_min_y is 3"),
    ("square.obj", lambda path: sample_mesh(path, 10**12, mm_per_unit=1.0), "GB"),
    ("square.obj", read_splats, "is a mesh"),
    ("bare.obj", lambda path: sampled(albedo=path.with_name("a.png"))(path), "coordinates"),
    ("flat.obj", sampled(), "area"),
    ("splats.ply", lambda path: SplatFile(path, part=0), "part is 0"),
    ("splats.ply", lambda path: SplatFile(path, up="x"), "up is 'x'"),
    ("text.ply", SplatFile, "binary"),
    ("faces.ply", SplatFile, "complete the file first"),
    ("few.ply", read_splats, "3 points"),
    ("new.ply", lambda path: write_splats(path, TWO_CHANNELS), "albedo has 2 channels"),
    ("other.exr", read_exr, "write_exr"),
    ("other.exr", read_manifest, "no record"),
    ("other.exr", read_color, "R, G and B nor Y"),
    ("bright.exr", read_color, "[0, 1]"),
    ("a.png", read_picture, "encoded for a display"),
    ("new.png", lambda path: write_png(path, np.zeros((2, 2, 7))), "7 channels"),
    ("new.png", lambda path: write_png(path, POINTS[None], exposure=np.nan), "exposure is nan"),
    ("new.gif", film(["a.png"]), "must end in .webp"),
    ("new.exr", lambda path: write_png(path, POINTS[None]), "must end in .png"),
    ("new.png", lambda path: sj.write_exr(path, some_frame()), "must end in .exr"),
    ("new.webp", film([]), "0 frames"),
    ("new.webp", film(["a.png"], 0.0), "0.1 to 60"),
    ("new.webp", film(["a.png", "b.png"]), "(2, 3)"),
    ("a.csv", lambda path: read_profile(path, mm_per_unit=0.0), "mm_per_unit is 0"),
    ("a.csv", lambda path: read_profile(path, mm_per_unit=np.nan), "mm_per_unit is nan"),
    ("a.csv", lambda path: read_profile(path, mm_per_unit=1.0), "mm_per_unit = 10"),
    ("json", read_record, "is no"),
    ("list.json", read_record, "is no"),
]


@pytest.fixture
def folder(tmp_path):
    """Files that are whole, and yet not what is needed."""
    (tmp_path / "folder").mkdir()
    export(square(), tmp_path, "obj").rename(tmp_path / "square.obj")
    write_splats(tmp_path / "splats.ply", some_splats())
    columns, triangle = columns_of(some_splats()), [np.zeros(3, "i4")]
    write_ply(tmp_path / "text.ply", columns, text=True)
    write_ply(tmp_path / "faces.ply", {"x": columns["x"]}, {"vertex_index": triangle})
    write_ply(tmp_path / "few.ply", xyz(np.eye(3)))
    for name, size in (("a.png", (3, 2)), ("b.png", (2, 3))):
        Image.new("RGB", size).save(tmp_path / name)
    write_picture(tmp_path / "other.exr", np.ones((2, 2, 2)), "float")
    write_picture(tmp_path / "bright.exr", np.full((2, 2, 3), 3.0), "float")
    texts = {"a.csv": "radius (cm), R (1/cm^2)\n0.1, 1\n0.2, 0.5\n", "json": "{", "list.json": "[]"}
    texts |= {"bare.obj": ROWS + "f 1 2 3\n", "flat.obj": "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    return tmp_path


@pytest.mark.parametrize(("name", "call", "value"), CALLS)
def test_what_cannot_be_done_with_a_file(folder, name, call, value):
    before = set(folder.iterdir())
    refused(folder / name, value, call, (ValueError, OSError))
    assert set(folder.iterdir()) == before


def test_points_far_from_the_origin_where_precision_does_not_reach(tmp_path, x64):
    """A body of 200 mm in the coordinates of a country, in double precision; and in parts."""
    points = POINTS.astype(float) * 100 + np.asarray([4e8, 5e8, 0])
    fields = {name: np.ones(20) for name in ("nx", "ny", "nz", "radius", "area")}
    path = write_ply(tmp_path / "a.ply", xyz(points) | fields)
    for read_all in (read_splats, lambda path: list(SplatFile(path, part=7)())):
        if x64:
            read_all(path)
        else:
            refused(path, "60 mm", read_all)


@pytest.mark.parametrize("suffix", [*SUFFIXES, "png", "jpg", "tif", "exr", "webp"])
def test_no_file_that_is_cut_short_is_read_in_silence(tmp_path, suffix):
    """Cut at any byte; only of OBJ nobody knows how many lines there should be."""
    if suffix in SUFFIXES:
        path, readers = export(trimesh.creation.box(), tmp_path, suffix), [read]
    else:
        picture = np.random.default_rng(0).uniform(size=(40, 30, 3))
        kind = "float" if suffix == "exr" else "uint8"
        path = write_picture(tmp_path / f"a.{suffix}", picture, kind)
        readers = [read_color]
    if suffix == "ply":
        write_splats(path, some_splats())
        readers = [read_splats, SplatFile]
    data, cut = path.read_bytes(), path.with_name(f"cut{path.suffix}")
    for size in range(0, len(data), max(1, len(data) // 80)):
        cut.write_bytes(data[:size])
        is_whole = size >= len(data.rstrip()) or (
            suffix == "obj" and data[size - 1 : size] == b"\n"
        )
        for reader in readers if not is_whole else ():
            refused(cut, cut.name, reader)


def test_textures_are_taken_from_the_files_own_folder_alone(tmp_path):
    """A texture elsewhere is sought by its name in this folder; without it, there is a warning."""
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "secret.png")
    inner = tmp_path / "inner"
    inner.mkdir()
    rows = "".join(f"vt {u} {v}\n" for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = "".join("f {0}/{0} {1}/{1} {2}/{2}\n".format(*face + 1) for face in TRIANGLES)
    path = write_any(inner / "a.obj", f"mtllib coat.mtl\n{ROWS}{rows}usemtl cloth\n{faces}")
    coat, outside = "newmtl cloth\nmap_Kd {}\n", r"a\.obj: names .*secret.png', which is missing"
    for name, text, message in (
        ("coat.mtl", coat.format("../secret.png"), outside),
        ("coat.mtl", coat.format("C:\\maps\\secret.png"), outside),
        ("coat.mtl", coat.format(tmp_path / "secret.png"), outside),
        ("secret.png", "no picture", "is not a picture"),
    ):
        (inner / name).write_text(text)
        with pytest.warns(UserWarning, match=message):
            assert read(path)[1].albedo is None
    Image.new("RGB", (2, 2), (0, 255, 0)).save(inner / "secret.png")
    np.testing.assert_allclose(read(path)[1].albedo[0, 0], [0, 1, 0])
    (inner / "coat.mtl").unlink()
    with pytest.warns(UserWarning, match=r"'coat.mtl', which is missing"):
        assert read(path)[1].albedo is None


WRITERS = {
    "a.exr": lambda path: write_exr(path, some_frame(height=40, width=40)),
    "a.png": lambda path: write_png(path, np.random.default_rng(0).uniform(size=(60, 60, 3))),
    "a.ply": lambda path: write_splats(
        path, sj.geometry.complete_splats(np.random.default_rng(0).normal(size=(400, 3)))
    ),
    "a.toml": lambda path: save_material(
        load_material("skin"), path, source={"citation": 9000 * "x"}
    ),
    "a.json": lambda path: write_record(path, {"x": 9000 * "x"}),
}


@pytest.fixture
def small_files(monkeypatch):
    """No file may grow beyond 4 kB: what a full disk does, without one. Python would keep half of a
    module's bytecode and never read it again.
    """
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_what_stood_there_and_no_litter(tmp_path, name, small_files):
    target = tmp_path / name
    target.write_text("before")
    for path in (target, Path("/sys", name)):  # nobody may write to the second
        with pytest.raises(OSError, match="cannot be written: ") as caught:
            WRITERS[name](path)
        assert caught.value.filename == str(path)
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]


def _write_half(path):
    with atomic_path(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (path.parent, "")
        temporary.write_text("ha")
        if path.name == "file":
            raise RuntimeError(path)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("nowhere/a", FileNotFoundError),
        ("file/a", FileNotFoundError),
        ("folder", IsADirectoryError),
        ("file", RuntimeError),
    ],
)
def test_a_file_takes_its_name_only_when_the_block_ends_well(tmp_path, name, kind):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("before")
    with pytest.raises(kind, match=name):
        _write_half(tmp_path / name)
    assert (tmp_path / "file").read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 2
