"""Maps of 8 and 16 bits, and textures that end at their borders."""

import struct
import zlib

import numpy as np
import pygltflib
import pytest
from PIL import Image
from test_meshes import CORNERS, TRIANGLES, V_UP, write_glb

from splatjax.geometry._textures import lookup
from splatjax.io import read_mesh
from splatjax.io._color import srgb_to_linear
from splatjax.io._pictures import read_color, read_factor, read_vectors
from splatjax.io._pieces import Piece
from splatjax.io._tiles import tiled


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_of_16_bits(values, path, filtered):
    """Write whole numbers as PNG, plain or each row as the difference to the one above."""
    height, width, channels = values.shape
    rows = values.astype(">u2").view(np.uint8).reshape(height, -1)
    if filtered:
        rows = np.diff(rows, axis=0, prepend=np.zeros_like(rows[:1]))
    data = b"".join(bytes([2 * filtered]) + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", width, height, 16, {2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("channels", [3, 4])
def test_16_bits_are_all_read(tmp_path, channels, filtered):
    values = np.random.default_rng(channels).integers(0, 65536, (5, 7, channels))
    png_of_16_bits(values, tmp_path / "a.png", filtered)
    shares = values[..., :3] / 65535
    np.testing.assert_allclose(read_vectors(tmp_path / "a.png"), 2 * shares - 1, atol=1e-12)
    np.testing.assert_allclose(read_color(tmp_path / "a.png"), srgb_to_linear(shares), atol=1e-12)
    np.testing.assert_allclose(
        read_factor(tmp_path / "a.png"), shares @ [0.299, 0.587, 0.114], atol=1e-12
    )


def test_gray_with_alpha_of_16_bits_is_read_by_its_upper_half(tmp_path):
    """Pillow gives no more of it."""
    values = np.random.default_rng(2).integers(0, 65536, (5, 7, 2))
    png_of_16_bits(values, tmp_path / "a.png", filtered=False)
    np.testing.assert_allclose(
        read_factor(tmp_path / "a.png"), values[..., 0] / 65535, atol=1 / 255
    )


def test_gray_of_16_bits_and_color_of_8(tmp_path):
    values = np.random.default_rng(0).integers(0, 65536, (4, 3), dtype=np.uint16)
    Image.fromarray(values).save(tmp_path / "gray.png")
    np.testing.assert_allclose(read_factor(tmp_path / "gray.png"), values / 65535, atol=1e-12)
    color = np.random.default_rng(0).integers(0, 256, (4, 3, 3), dtype=np.uint8)
    Image.fromarray(color).save(tmp_path / "color.png")
    np.testing.assert_allclose(read_vectors(tmp_path / "color.png"), color / 127.5 - 1, atol=1e-12)


def beyond(index, size, wrap):
    """The pixel that stands for one beyond the border, by the sampler's definition in OpenGL ES
    2.0, table 3.11.
    """
    match wrap:
        case "wrap":
            return index % size
        case "edge":
            return np.clip(index, 0, size - 1)
    return np.where(
        index % (2 * size) < size, index % (2 * size), 2 * size - 1 - index % (2 * size)
    )


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize(
    "wraps", [("edge", "wrap"), ("symmetric", "edge"), ("wrap", "symmetric"), ("edge", "edge")]
)
def test_textures_go_on_beyond_their_borders(tmp_path, wraps, upside_down):
    random = np.random.default_rng(0)
    picture, uvs = random.uniform(size=(5, 7, 3)), random.uniform(-1.3, 2.3, (40, 3, 2))
    piece = Piece(
        np.zeros((3, 3)), np.zeros((40, 3), np.int64), uvs=uvs, texture=lambda: picture, wraps=wraps
    )
    made = tiled(tmp_path, piece, upside_down=upside_down)
    flip = (
        (lambda at: np.stack([at[:, 0], 1 - at[:, 1]], axis=1)) if upside_down else (lambda at: at)
    )
    assert made.uvs is not None
    assert made.texture is not None
    x, y = flip(uvs.reshape(-1, 2)).T * [[7], [5]] + [[-0.5], [-0.5]]
    y = 5 - 1 - y  # rows begin at the top
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    expected = sum(
        picture[beyond(top + row, 5, wraps[1]), beyond(left + column, 7, wraps[0])]
        * (np.abs(1 - column - (x - left)) * np.abs(1 - row - (y - top)))[:, None]
        for row in (0, 1)
        for column in (0, 1)
    )
    np.testing.assert_allclose(
        lookup(made.texture(), flip(made.uvs.reshape(-1, 2))), expected, atol=1e-12
    )


def test_coordinates_far_beyond_a_border_are_refused(tmp_path):
    piece = Piece(
        np.zeros((3, 3)),
        np.zeros((1, 3), np.int64),
        uvs=np.full((1, 3, 2), 9.0),
        texture=lambda: np.zeros((1, 1, 3)),
    )
    with pytest.raises(
        ValueError, match="8 tiles beyond a texture that ends at its border; bring them to"
    ):
        tiled(tmp_path / "a.glb", piece._replace(wraps=("edge", "wrap")), upside_down=False)


@pytest.mark.parametrize(("sampler", "corner"), [(None, 0.5), (33071, 1.0), (33648, 1.0)])
def test_samplers_of_gltf_are_heeded(tmp_path, sampler, corner):
    """A picture half black, half white, looked up where it ends: repeated it is half as bright
    there.
    """
    texture = Image.fromarray(np.repeat([[0, 255]], 2, axis=0).astype(np.uint8)).convert("RGB")
    write_glb(tmp_path / "a.glb", V_UP, texture=texture)
    file = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    if sampler is not None:
        file.samplers = [pygltflib.Sampler(wrapS=sampler, wrapT=sampler)]
        file.textures[0].sampler = 0
    file.save_binary(str(tmp_path / "a.glb"))
    mesh, textures = read_mesh(tmp_path / "a.glb", mm_per_unit=1.0)
    assert len(mesh.faces) * 3 == len(TRIANGLES)
    right = mesh.uvs[np.isclose(mesh.vertices[mesh.faces][..., 0], CORNERS[:, 0].max())]
    np.testing.assert_allclose(lookup(textures.albedo, right), corner, atol=1e-12)


def test_an_unknown_sampler_is_refused(tmp_path):
    write_glb(tmp_path / "a.glb", V_UP, texture=Image.new("RGB", (2, 2)))
    file = pygltflib.GLTF2().load(str(tmp_path / "a.glb"))
    file.samplers, file.textures[0].sampler = [pygltflib.Sampler(wrapS=5)], 0
    file.save_binary(str(tmp_path / "a.glb"))
    with pytest.raises(ValueError, match="wrapped by 5 and"):
        read_mesh(tmp_path / "a.glb", mm_per_unit=1.0)


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "packbits", "tiff_adobe_deflate"])
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "I;16"])
def test_a_tiff_that_ends_before_it_says_is_refused(tmp_path, mode, compression):
    depth, channels = (np.uint16, 1) if mode == "I;16" else (np.uint8, len(mode))
    values = (
        np.random.default_rng(0).integers(1, np.iinfo(depth).max, (6, 4, channels)).astype(depth)
    )
    Image.fromarray(values.squeeze()).save(tmp_path / "whole.tiff", compression=compression)
    found = read_factor(tmp_path / "whole.tiff")
    assert np.all(found > 0)
    assert found.shape == (6, 4)
    height = struct.pack("<HHII", 257, 4 if compression == "raw" else 3, 1, 6)
    data = (tmp_path / "whole.tiff").read_bytes()
    assert data.count(height) == 1
    (tmp_path / "more.tiff").write_bytes(
        data.replace(height, height[:-4] + struct.pack("<I", 6000))
    )
    with pytest.raises(
        ValueError, match=r"more\.tiff: cannot be read as a picture \(.*\); give a whole"
    ):
        read_factor(tmp_path / "more.tiff")
