"""Readers, small files that they read, and how such files are spoiled."""

import signal
import traceback
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import trimesh
from PIL import Image
from writers import some_frame

import splatjax as sj

WORDS = (
    *(b"0", b"-1", b"1", b"255", b"65536", b"2147483647", b"4294967296", b"9223372036854775808"),
    *(b"1e308", b"1e999", b"-1e-320", b"nan", b"-inf", b'""', b"null", b"true", b"[]", b"{}"),
    *(b"\xff\xfe", b"\0", b"..", b"1_0", b"\x7f\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\xc0\x7f"),
)
SQUARE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n"
POINTS = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float radius
property float area
property uchar red
element face 1
property list uchar int vertex_indices
end_header
0 0 0 1 1 200
1 0 0 1 1 200
0 1 0 1 1 200
3 0 1 2
"""
PICTURES = """
[[pictures]]
file = "a.exr"
noise = 0.01
intensity = "unknown"
camera = { position = [0, 0, 500], target = [0, 0, 0], up = [0, 1, 0], fov = 25 }
[[pictures.lights]]
kind = "directional"
direction = [1, -0.3, -0.5]
irradiance = [3.14, 3.14, 3.14]
[[pictures.lights]]
kind = "point"
position = [0, 0, 9]
intensity = [1, 1, 1]
cast_shadows = false
[[pictures.lights]]
kind = "beam"
origin = [0, 0, 9]
direction = [0, 0, -1]
power = [1, 1, 1]
variance = 1.0
"""


SINGLE = """[single_scattering]
unit = "1/mm"
sigma_a = [0.1]
sigma_s_prime = [1.0]
eta = 1.3
strength = [1.0]
[fit]
unit = "mm^2"
variances = [0.1, 2.0]
weights = [[0.2], [0.3]]
"""
CAMERAS = """{"camera_angle_x": 0.7, "w": 64, "h": 48, "cx": 30, "k1": 0, "frames": [{"file_path":
"a.png", "transform_matrix": [[1, 0, 0, 0], [0, 0, -1, 2], [0, 1, 0, 3.5], [0, 0, 0, 1]]}]}"""
TEXTS = {
    "material": (
        ".toml",
        [*(sj.io.material_path(n).read_text() for n in ("skin", "marble")), SINGLE],
    ),
    "observations": (".toml", [PICTURES]),
    "cameras": (".json", [CAMERAS]),
    "profile": (".csv", ["# measured\nr, red, green\n0.1, 1, 2\n0.2, 0.5, 1e-1\n0.4, 0.1, 0.01\n"]),
    "record": (".json", ['{"--width": 16, "splats": "a.ply", "turn": null, "x": [1.5, true]}\n']),
    "obj": (".obj", [SQUARE]),
    "ply": (".ply", [POINTS]),
    "ply_mesh": (".ply", [POINTS]),
}
READERS: dict[str, Callable[[Path], object]] = {
    "ply": sj.read_splats,
    **dict.fromkeys(
        ("ply_mesh", "obj", "glb", "stl", "off"), partial(sj.io.read_textured_mesh, mm_per_unit=1.0)
    ),
    "exr": lambda path: (sj.io.read_picture(path), sj.read_exr(path)),
    "picture": lambda path: sj.io.read_textured_mesh(
        path.with_name("square.obj"), mm_per_unit=1.0, albedo=path
    ),
    "material": lambda path: (sj.load_profile(path), sj.load_material(path)),
    "observations": sj.io.read_observations,
    "cameras": partial(sj.io.load_cameras, mm_per_unit=1.0),
    "profile": sj.io.read_profile,
    "record": sj.io.read_record,
}


def seeds(name: str, folder: Path) -> list[Path]:
    suffix, texts = TEXTS.get(name, (f".{name}", []))
    paths = [folder / f"{number}{suffix}" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text, encoding="utf-8")
    if name in ("ply", "ply_mesh", "obj", "glb", "stl", "off"):
        mesh = trimesh.creation.icosahedron()
        mesh.visual.vertex_colors = [10, 20, 30, 255]
        if name == "ply":
            mesh = trimesh.PointCloud(mesh.vertices, [10, 20, 30, 255])
        paths.append(folder / f"colored{suffix}")
        mesh.export(paths[-1])
    elif name == "picture":
        (folder / "square.obj").write_text(SQUARE)
        gray = Image.fromarray(np.arange(64, dtype=np.uint8).reshape(8, 8))
        deep = Image.fromarray(np.arange(64, dtype=np.uint16).reshape(8, 8) * 1000)
        pictures = {"a.png": gray, "b.png": deep, "c.png": gray.convert("P")}
        pictures |= {"a.jpg": gray.convert("RGB"), "a.tiff": gray.convert("RGBA")}
        for file, picture in pictures.items():
            paths.append(folder / file)
            picture.save(paths[-1])
    elif name in ("exr", "observations"):
        sj.write_exr(folder / "a.exr", some_frame())
        paths += [folder / "a.exr"] if name == "exr" else []
    return paths


def outcome(name: str, path: Path, seconds: float = 5.0) -> str:
    """Read a file by the reader of a name.

    Returns `read`, `refused`, or the traceback of what should not have happened.
    """

    def stop(*_) -> None:
        raise SystemExit("took too long")

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", UserWarning)
            READERS[name](path)
        return "read"
    except (ValueError, OSError) as error:
        named = str(path.parent) in str(error) and "\n" not in str(error)
        return "refused" if named else traceback.format_exc()
    except BaseException:
        return traceback.format_exc()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@st.composite
def spoiled(draw, files: list[bytes]) -> bytes:
    """Draw a file with some bytes replaced: by others, by words, by pieces of another file."""
    data = draw(st.sampled_from(files))
    for _ in range(draw(st.integers(1, 4))):
        at, lost = draw(st.integers(0, len(data))), draw(st.integers(0, 12))
        other, begin = draw(st.sampled_from(files)), draw(st.integers(0, 4000))
        pieces = (draw(st.binary(max_size=8)), draw(st.sampled_from(WORDS)), other[begin:][:100])
        data = data[:at] + draw(st.sampled_from(pieces)) + data[at + lost :]
    return data
