"""Meshes from GLB and OBJ files with their maps, compared with files that other libraries or hands
have written.
"""

import os
import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import pygltflib
import pytest
from PIL import Image

from splatjax.io import sample_mesh

CORNERS = np.asarray([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
V_UP = np.asarray([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)  # v = 1 at the top of the square
TRIANGLES = np.asarray([0, 1, 2, 0, 2, 3], np.uint16)
QUANTUM = 1 / 255


def ramp(path=None):
    """A picture that is red at the top, row 0, and green at the bottom."""
    rows = np.linspace(1, 0, 64)[:, None] * np.ones(8)
    image = Image.fromarray(
        np.rint(255 * np.stack([rows, 1 - rows, 0 * rows], axis=-1)).astype(np.uint8)
    )
    if path is not None:
        image.save(path)
    return image


def write_obj(path):
    """OBJ: v grows upward."""
    lines = (
        [f"v {x} {y} {z}" for x, y, z in CORNERS] + [f"vt {u} {v}" for u, v in V_UP] + ["vn 0 0 1"]
    )
    path.write_text("\n".join([*lines, "f 1/1/1 2/2/1 3/3/1", "f 1/1/1 3/3/1 4/4/1"]) + "\n")


def write_glb(path, uvs, *, texture=None):
    """glTF: v grows downward."""
    buffers = [TRIANGLES.tobytes(), CORNERS.tobytes(), uvs.astype(np.float32).tobytes()]
    if texture is not None:
        encoded = BytesIO()
        texture.save(encoded, format="PNG")
        buffers.append(encoded.getvalue())
    starts = np.cumsum([0, *map(len, buffers)])
    gltf = pygltflib.GLTF2(
        scene=0,
        scenes=[pygltflib.Scene(nodes=[0])],
        nodes=[pygltflib.Node(mesh=0)],
        meshes=[
            pygltflib.Mesh(
                primitives=[
                    pygltflib.Primitive(
                        attributes=pygltflib.Attributes(POSITION=1, TEXCOORD_0=2),
                        indices=0,
                        material=None if texture is None else 0,
                    )
                ]
            )
        ],
        accessors=[
            pygltflib.Accessor(
                bufferView=0, componentType=pygltflib.UNSIGNED_SHORT, count=6, type=pygltflib.SCALAR
            ),
            pygltflib.Accessor(
                bufferView=1,
                componentType=pygltflib.FLOAT,
                count=4,
                type=pygltflib.VEC3,
                min=[0, 0, 0],
                max=[2, 2, 0],
            ),
            pygltflib.Accessor(
                bufferView=2, componentType=pygltflib.FLOAT, count=4, type=pygltflib.VEC2
            ),
        ],
        bufferViews=[
            pygltflib.BufferView(buffer=0, byteOffset=int(start), byteLength=len(data))
            for start, data in zip(starts, buffers, strict=False)
        ],
        buffers=[pygltflib.Buffer(byteLength=int(starts[-1]))],
    )
    if texture is not None:
        gltf.images = [pygltflib.Image(bufferView=3, mimeType="image/png")]
        gltf.textures = [pygltflib.Texture(source=0)]
        gltf.materials = [
            pygltflib.Material(
                pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
                    baseColorTexture=pygltflib.TextureInfo(index=0)
                )
            )
        ]
    gltf.set_binary_blob(b"".join(buffers))
    gltf.save_binary(str(path))


def reds(splats):
    """The red of the ramp, in sRGB again, beside the height in the square, both in [0, 1]."""
    albedo = np.asarray(splats.albedo, np.float64)
    encoded = np.where(
        albedo <= 0.0031308, 12.92 * albedo, 1.055 * np.maximum(albedo, 1e-9) ** (1 / 2.4) - 0.055
    )
    height = np.asarray(splats.centers)[:, 1] / np.asarray(splats.centers)[:, 1].max()
    inner = np.abs(height - 0.5) < 0.48
    return encoded[inner, 0], height[inner]


@pytest.fixture
def folder(tmp_path):
    ramp(tmp_path / "ramp.png")
    write_obj(tmp_path / "square.obj")
    write_glb(tmp_path / "square.glb", V_UP * [1, -1] + [0, 1])
    write_glb(tmp_path / "careless.glb", V_UP)
    write_glb(tmp_path / "dressed.glb", V_UP * [1, -1] + [0, 1], texture=ramp())
    return tmp_path


@pytest.mark.parametrize(
    ("name", "v_up", "rises"),
    [
        ("square.obj", None, True),
        ("square.obj", True, True),
        ("square.obj", False, False),
        ("square.glb", None, True),
        ("square.glb", False, True),
        ("careless.glb", None, False),
        ("careless.glb", True, True),
    ],
)
def test_map_stands_upright(folder, name, v_up, rises):
    """Red, at the top of the picture, is at the top of the square; glTF has v down, OBJ up, and a
    file may be careless.
    """
    splats = sample_mesh(folder / name, 300, mm_per_unit=5.0, albedo=folder / "ramp.png", v_up=v_up)
    red, height = reds(splats)
    np.testing.assert_allclose(red, height if rises else 1 - height, atol=0.03)
    np.testing.assert_allclose(float(splats.areas.sum()), 100, rtol=1e-5)


def test_texture_within_the_file_is_worn(folder):
    red, height = reds(sample_mesh(folder / "dressed.glb", 300, mm_per_unit=5.0))
    np.testing.assert_allclose(red, height, atol=0.03)
    assert sample_mesh(folder / "square.glb", 10, mm_per_unit=5.0).albedo is None


def test_specular_and_normal_maps(folder):
    Image.fromarray(np.full((4, 4), 51, np.uint8)).save(folder / "specular.png")
    tilted = np.rint(255 * (np.asarray([0.6, 0.0, 0.8]) * 0.5 + 0.5) * np.ones((4, 4, 1))).astype(
        np.uint8
    )
    Image.fromarray(tilted).save(folder / "normal.png")
    splats = sample_mesh(
        folder / "square.obj",
        50,
        mm_per_unit=1.0,
        specular=folder / "specular.png",
        normal=folder / "normal.png",
    )
    assert splats.albedo is None
    np.testing.assert_allclose(np.asarray(splats.specular), 0.2, rtol=1e-6)
    np.testing.assert_allclose(
        np.asarray(splats.normals), np.tile([0.6, 0, 0.8], (50, 1)), atol=2 * QUANTUM
    )


def test_crop_cuts_the_mesh_at_a_height_in_file_units(folder):
    splats = sample_mesh(folder / "square.obj", 200, mm_per_unit=5.0, crop_min_y=0.5)
    assert float(splats.centers[:, 1].min()) >= 2.5 - 1e-5
    np.testing.assert_allclose(float(splats.areas.sum()), 75, rtol=1e-5)
    with pytest.raises(
        ValueError, match=r"square.obj: crop_min_y = 3 leaves nothing; the mesh ends at y = 2 in"
    ):
        sample_mesh(folder / "square.obj", 200, mm_per_unit=5.0, crop_min_y=3.0)


def test_meshes_that_cannot_be_used_are_refused(folder):
    def refused(kind, said, name, **options):
        with pytest.raises(kind, match=said) as caught:
            sample_mesh(folder / name, 10, **{"mm_per_unit": 1.0, **options})
        assert "\n" not in str(caught.value)

    refused(FileNotFoundError, r"none.glb: there is no such file", "none.glb")
    refused(
        FileNotFoundError,
        r"none.png: there is no such file",
        "square.obj",
        albedo=folder / "none.png",
    )
    refused(
        ValueError, r"ramp.png: .png is no mesh format known here; give one of .glb", "ramp.png"
    )
    refused(
        ValueError,
        r"square.obj: cannot be read as a picture",
        "square.obj",
        albedo=folder / "square.obj",
    )
    refused(ValueError, "mm_per_unit is -1", "square.obj", mm_per_unit=-1.0)
    (folder / "cut.glb").write_bytes((folder / "square.glb").read_bytes()[:200])
    refused(
        ValueError, r"cut.glb: cannot be read as glTF: its header promises 844 bytes", "cut.glb"
    )
    (folder / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    refused(ValueError, r"points.obj: ", "points.obj")
    (folder / "bare.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    refused(
        ValueError, r"bare.obj: has no texture coordinates", "bare.obj", albedo=folder / "ramp.png"
    )
    (folder / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    refused(ValueError, r"flat.obj: the mesh has no area", "flat.obj")
    (folder / "nan.obj").write_text("v 0 0 0\nv nan 0 0\nv 2 1 0\nf 1 2 3\n")
    refused(ValueError, r"nan.obj: has vertices that are not finite", "nan.obj")


def test_glb_is_what_it_says(folder):
    magic, version, length = struct.unpack("<4sII", (folder / "square.glb").read_bytes()[:12])
    assert (magic, version) == (b"glTF", 2)
    assert length == (folder / "square.glb").stat().st_size


@pytest.mark.shared
def test_scanned_head_wears_its_lips_on_its_mouth():
    """The scan's GLB keeps v up. Lips are redder than the chin; with the wrong flip they would land
    on it.
    """
    folder = Path(os.environ["SPLATJAX_SHARED"]) / "data" / "lee_perry_smith"
    options = {"mm_per_unit": 53.0, "albedo": folder / "Map-COL.jpg", "crop_min_y": -0.9}
    right, wrong = (
        sample_mesh(folder / "LeePerrySmith.glb", 30_000, v_up=v_up, **options)
        for v_up in (True, False)
    )

    def redness(splats, low, high):
        x, y, z = np.asarray(splats.centers).T
        there = (np.abs(x) < 12) & (y > low) & (y < high) & (z > 90)
        assert there.sum() > 30
        red, green, blue = np.asarray(splats.albedo)[there].mean(axis=0)
        return 2 * red / (green + blue)

    mouth, chin = LIPS_AND_CHIN
    assert redness(right, *mouth) > 1.15 * redness(right, *chin)
    assert redness(wrong, *mouth) < 1.15 * redness(wrong, *chin)


LIPS_AND_CHIN = ((17.0, 29.0), (-12.0, 5.0))  # heights on the scan, mm
