"""The doors at which files come in, and small files that each lets in: what tools/fuzz.py
spoils.
"""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Door:
    """A reader, the suffix of its files, and small files that it reads, made in a folder."""

    suffix: str
    read: Callable[[Path], object]
    seeds: Callable[[Path], list[Path]]


def _splats(path: Path) -> object:
    from splatjax.io import read_splats

    return read_splats(path)


def _mesh(path: Path) -> object:
    from splatjax.io import read_textured_mesh

    return read_textured_mesh(path, mm_per_unit=1.0)


def _exr(path: Path) -> object:
    from splatjax.io import read_exr, read_picture

    read_picture(path)
    return read_exr(path)


def _picture(path: Path) -> object:
    from splatjax.io._images import read_color

    return read_color(path)


def _material(path: Path) -> object:
    from splatjax.io import load_material, load_profile

    load_profile(path)
    return load_material(path)


def _observations(path: Path) -> object:
    from splatjax.io import read_observations

    return read_observations(path)


def _profile(path: Path) -> object:
    from splatjax.io import read_profile

    return read_profile(path)


def _record(path: Path) -> object:
    from splatjax.io import read_record

    return read_record(path)


def _ball(folder: Path, suffix: str, **how) -> Path:
    import trimesh

    mesh = trimesh.creation.icosahedron()
    mesh.visual.vertex_colors = [10, 20, 30, 255]
    path = folder / f"ball_{len(list(folder.iterdir()))}{suffix}"
    mesh.export(path, **how)
    return path


def _text(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


_HEAD = "ply\nformat {} 1.0\ncomment x\nelement vertex 6\n{}{}end_header\n"
_SCALARS = "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "radius", "area")
)
_COLORS = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
_LISTS = "element face 2\nproperty list uchar int vertex_indices\nproperty uchar flags\n"


def _ply_seeds(folder: Path) -> list[Path]:
    rows = [(i % 3, i // 3, i % 2, 0, 0, 1, 1, 1) for i in range(6)]
    words = (
        "".join(" ".join(map(str, row)) + " 1 2 3\n" for row in rows) + "3 0 1 2 7\n4 0 1 2 3 7\n"
    )
    made = [_text(folder, "text.ply", _HEAD.format("ascii", _SCALARS + _COLORS, _LISTS) + words)]
    for order, name in (("<", "little"), (">", "big")):
        head = _HEAD.format(f"binary_{name}_endian", _SCALARS + _COLORS, _LISTS).encode()
        body = b"".join(struct.pack(f"{order}8f3B", *row, 1, 2, 3) for row in rows)
        faces = struct.pack(f"{order}B3iBB4iB", 3, 0, 1, 2, 7, 4, 0, 1, 2, 3, 7)
        made.append(folder / f"{name}.ply")
        made[-1].write_bytes(head + body + faces)
    return [*made, _ball(folder, ".ply"), _ball(folder, ".ply", encoding="ascii")]


def _obj_seeds(folder: Path) -> list[Path]:
    square = (
        "mtllib a.mtl\nv 0 0 0\nv 2 0 0\nv 2 2 0\nv 0 2 0\nv 1 3 0 0.5 0.5 0.5\nvt 0 "
        "0\nvt 1 0\nvt 1 1\nvn 0 0 1\n"
    )
    _text(folder, "a.mtl", "newmtl a\nKd 1 0 0\nmap_Kd a.png\n")
    made = _text(
        folder, "a.obj", square + "usemtl a\nf 1/1/1 2/2/1 3/3/1\nf -5//1 -3//1 4//1\nf 1 2 3 5 4\n"
    )
    return [made, _ball(folder, ".obj")]


def _gltf_seeds(folder: Path) -> list[Path]:
    import trimesh
    from PIL import Image

    mesh = trimesh.creation.box()
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.new("RGB", (2, 2), (1, 2, 3))
    )
    mesh.visual = trimesh.visual.TextureVisuals(uv=mesh.vertices[:, :2], material=material)
    scene = trimesh.Scene([mesh])
    scene.add_geometry(
        trimesh.creation.icosahedron(),
        transform=trimesh.transformations.rotation_matrix(0.3, [0, 1, 0]),
    )
    scene.export(folder / "scene.glb")
    sparse = json.dumps(_SPARSE)
    text = sparse.encode() + b" " * (-len(sparse) % 4)
    data = (
        struct.pack("<9f", *range(9))
        + struct.pack("<3H", 0, 1, 2)
        + b"\0\0"
        + struct.pack("<3B", 0, 128, 255)
        + b"\0"
    )
    chunks = (
        struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(data), b"BIN\0")
        + data
    )
    (folder / "sparse.glb").write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return [folder / "scene.glb", folder / "sparse.glb", _ball(folder, ".glb")]


_SPARSE = {
    "asset": {"version": "2.0"},
    "nodes": [
        {"children": [1], "scale": [1, 2, 3]},
        {"mesh": 0, "rotation": [0, 0, 0, 1], "translation": [1, 2, 3]},
    ],
    "scenes": [{"nodes": [0]}],
    "meshes": [
        {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1, "mode": 5}]}
    ],
    "accessors": [
        {
            "componentType": 5126,
            "count": 3,
            "type": "VEC3",
            "sparse": {
                "count": 3,
                "indices": {"bufferView": 1, "componentType": 5123},
                "values": {"bufferView": 0},
            },
        },
        {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        {"bufferView": 2, "componentType": 5121, "count": 1, "type": "VEC3", "normalized": True},
    ],
    "bufferViews": [
        {"buffer": 0, "byteLength": 36},
        {"buffer": 0, "byteOffset": 36, "byteLength": 6},
        {"buffer": 0, "byteOffset": 44, "byteLength": 3},
    ],
    "buffers": [{"byteLength": 48}],
}


def _solid_seeds(folder: Path) -> list[Path]:
    return [_ball(folder, ".stl"), _ball(folder, ".stl", file_type="stl_ascii")]


def _off_seeds(folder: Path) -> list[Path]:
    return [_ball(folder, ".off")]


def _exr_seeds(folder: Path) -> list[Path]:
    import jax.numpy as jnp
    import numpy as np
    import OpenEXR

    from splatjax.io import write_exr
    from splatjax.scene import Frame

    planes = {
        name: np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4) for name in ("R", "G", "B")
    }
    made = []
    for name in ("NO", "ZIP", "PIZ", "RLE"):
        header = {
            "compression": getattr(OpenEXR, f"{name}_COMPRESSION"),
            "type": OpenEXR.scanlineimage,
        }
        with OpenEXR.File(header, dict(planes)) as file:
            file.write(str(folder / f"{name}.exr"))
        made.append(folder / f"{name}.exr")
    color, gray = jnp.ones((3, 4, 3)), jnp.ones((3, 4))
    weights = jnp.ones((1, 3)), color, color, gray[0, :1], gray[0, 0]
    frame = Frame(color, gray, gray, color, color, color, gray[None], color, color[None], *weights)
    write_exr(folder / "frame.exr", frame)
    return [*made, folder / "frame.exr"]


def _picture_seeds(folder: Path) -> list[Path]:
    import numpy as np
    from PIL import Image

    gray = np.arange(64, dtype=np.uint8).reshape(8, 8)
    Image.fromarray(gray).convert("RGB").save(folder / "a.jpg")
    Image.fromarray(gray).save(folder / "a.png")
    Image.fromarray(gray.astype(np.uint16) * 1000).save(folder / "b.png")
    Image.fromarray(gray).convert("P").save(folder / "c.png")
    Image.fromarray(gray).convert("RGBA").save(folder / "a.tiff")
    return [folder / name for name in ("a.jpg", "a.png", "b.png", "c.png", "a.tiff")]


def _material_seeds(folder: Path) -> list[Path]:
    from splatjax.io import material_path

    single = (
        '[single_scattering]\nunit = "1/mm"\nsigma_a = [0.1]\nsigma_s_prime = '
        "[1.0]\neta = 1.3\nstrength = [1.0]\n"
    )
    fit = '[fit]\nunit = "mm^2"\nvariances = [0.1, 2.0]\nweights = [[0.2], [0.3]]\n'
    shipped = [
        _text(folder, f"{name}.toml", material_path(name).read_text(encoding="utf-8"))
        for name in ("marble", "skin_layers", "skin")
    ]
    return [*shipped, _text(folder, "single.toml", single + fit)]


def _observation_seeds(folder: Path) -> list[Path]:
    _exr_seeds(folder)
    light = '[[pictures.lights]]\nkind = "{}"\n{}\n'
    lights = light.format(
        "directional", "direction = [1, -0.3, -0.5]\nirradiance = [3.14, 3.14, 3.14]"
    )
    lights += light.format(
        "point", "position = [0, 0, 9]\nintensity = [1, 1, 1]\ncast_shadows = false"
    )
    lights += light.format(
        "beam", "origin = [0, 0, 9]\ndirection = [0, 0, -1]\npower = [1, 1, 1]\nvariance = 1.0"
    )
    camera = "camera = { position = [0, 0, 500], target = [0, 0, 0], up = [0, 1, 0], fov = 25 }\n"
    return [
        _text(
            folder,
            "a.toml",
            '[[pictures]]\nfile = "ZIP.exr"\nnoise = 0.01\nintensity = "unknown"\n'
            f"{camera}{lights}",
        )
    ]


def _profile_seeds(folder: Path) -> list[Path]:
    return [
        _text(
            folder,
            "a.csv",
            "# measured\nr, red, green\n0.1, 1, 2\n0.2, 0.5, 1e-1\n0.4, 0.1, 0.01\n",
        )
    ]


def _record_seeds(folder: Path) -> list[Path]:
    return [
        _text(
            folder,
            "a.json",
            '{"--width": 16, "splats": "a.ply, 3 bytes", "turn": null, "x": [1.5, true]}\n',
        )
    ]


DOORS = {
    "ply": Door(".ply", _splats, _ply_seeds),
    "ply_mesh": Door(".ply", _mesh, _ply_seeds),
    "obj": Door(".obj", _mesh, _obj_seeds),
    "glb": Door(".glb", _mesh, _gltf_seeds),
    "stl": Door(".stl", _mesh, _solid_seeds),
    "off": Door(".off", _mesh, _off_seeds),
    "exr": Door(".exr", _exr, _exr_seeds),
    "picture": Door(".png", _picture, _picture_seeds),
    "material": Door(".toml", _material, _material_seeds),
    "observations": Door(".toml", _observations, _observation_seeds),
    "profile": Door(".csv", _profile, _profile_seeds),
    "record": Door(".json", _record, _record_seeds),
}
