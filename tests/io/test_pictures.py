"""Frames in OpenEXR, pictures in PNG."""

import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from splatjax.io import read_exr, write_exr, write_png
from splatjax.io._color import linear_to_srgb
from splatjax.scene import Frame

TOOLS = [
    (["exrheader"], "diffusion.4.G, 32-bit floating-point"),
    (["oiiotool", "--info", "-v"], "diffusion.4.G"),
]


def some_frame(channels=3, gaussians=4, lights=2, height=6, width=5) -> Frame:
    """A frame of noise whose diffuse part is the weighted sum of its layers."""
    random = np.random.default_rng(3)

    def noise(*shape):
        return random.uniform(0, 1, shape).astype(np.float32)

    layers, weights = noise(gaussians, height, width, channels), noise(gaussians, channels)
    diffuse, specular = (
        (layers * weights[:, None, None]).sum(axis=0),
        noise(height, width, channels),
    )
    depth = noise(height, width)
    depth[0, 0] = np.inf
    parts = {
        "beauty": diffuse + specular,
        "coverage": noise(height, width),
        "depth": depth,
        "position": noise(height, width, 3),
        "normal": noise(height, width, 3),
        "albedo": noise(height, width, channels),
        "shadow": noise(lights, height, width),
        "irradiance": noise(height, width, channels),
        "layers": layers,
        "weights": weights,
        "diffuse": diffuse,
        "specular": specular,
        "handed_over": noise(gaussians),
        "overflow": np.zeros((), np.float32),
    }
    return Frame(**{name: jnp.asarray(values) for name, values in parts.items()})


@pytest.mark.parametrize(("channels", "lights", "gaussians"), [(3, 2, 11), (1, 0, 1), (12, 1, 3)])
def test_frame_comes_back_bit_by_bit(tmp_path, channels, lights, gaussians):
    frame = some_frame(channels, gaussians, lights)
    write_exr(tmp_path / "frame.exr", frame)
    back = read_exr(tmp_path / "frame.exr")
    for one, other in zip(jax.tree.leaves(frame), jax.tree.leaves(back), strict=True):
        assert other.dtype == jnp.float32
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
    assert [file.name for file in tmp_path.iterdir()] == ["frame.exr"]


def test_diffuse_is_rebuilt_from_layers_and_header_alone(tmp_path):
    write_exr(tmp_path / "frame.exr", some_frame(), variances=[0.1, 0.2, 0.4, 7.5])
    with OpenEXR.File(str(tmp_path / "frame.exr"), separate_channels=True) as file:
        header, planes = (
            dict(file.header()),
            {name: np.array(channel.pixels) for name, channel in file.channels().items()},
        )
    for channel, letter in enumerate("RGB"):
        rebuilt = sum(
            header[f"splatjax.weights.{k}"][channel] * planes[f"diffusion.{k}.{letter}"]
            for k in (1, 2, 3, 4)
        )
        np.testing.assert_allclose(rebuilt, planes[f"diffuse.{letter}"], rtol=1e-6)
    np.testing.assert_allclose(header["splatjax.variances"], [0.1, 0.2, 0.4, 7.5], rtol=1e-7)
    np.testing.assert_allclose(np.ravel(header["chromaticities"])[:2], [0.64, 0.33], rtol=1e-6)
    assert all(plane.dtype == np.float32 for plane in planes.values())


def test_frames_of_double_precision_are_written_in_single(tmp_path):
    frame = jax.tree.map(
        lambda leaf: jnp.asarray(np.asarray(leaf, np.float64), dtype=float), some_frame()
    )
    write_exr(tmp_path / "frame.exr", frame)
    np.testing.assert_array_equal(
        np.asarray(read_exr(tmp_path / "frame.exr").beauty), np.asarray(frame.beauty, np.float32)
    )


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (command, said) for command, said in TOOLS if shutil.which(command[0])
    ],  # Debian: openexr, openimageio-tools
)
def test_common_tools_list_the_layers(tmp_path, command, said):
    write_exr(tmp_path / "frame.exr", some_frame())
    told = subprocess.run(
        [*command, str(tmp_path / "frame.exr")], capture_output=True, text=True, check=True
    ).stdout
    assert said in told
    for name in (
        "R",
        "A",
        "Z",
        "position.X",
        "normal.Z",
        "albedo.R",
        "shadow.2",
        "irradiance.B",
        "specular.G",
    ):
        assert name in told


def test_exr_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_exr(tmp_path / "none.exr")
    write_exr(tmp_path / "frame.exr", some_frame())
    whole = (tmp_path / "frame.exr").read_bytes()
    (tmp_path / "cut.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut.exr: cannot be read as OpenEXR"):
        read_exr(tmp_path / "cut.exr")
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(tmp_path / "other.exr"))
    with pytest.raises(ValueError, match=r"other.exr: lacks .*, so it is no frame"):
        read_exr(tmp_path / "other.exr")


def test_png_encodes_for_the_display(tmp_path):
    """sRGB: linear 0.2159 is 128 of 255, 0.0021 is a 36th (the straight part), and exposure counts
    in stops.
    """
    picture = np.asarray([[[0.0, 0.2158605, 1.0], [0.00215, 2.0, -1.0]]])
    write_png(tmp_path / "a.png", picture)
    with Image.open(tmp_path / "a.png") as image:
        assert image.mode == "RGB"
        np.testing.assert_array_equal(np.asarray(image), [[[0, 128, 255], [7, 255, 0]]])
    write_png(tmp_path / "b.png", picture / 4, exposure=2.0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_png_of_frames_gray_and_alpha(tmp_path):
    frame = some_frame()
    write_png(tmp_path / "a.png", frame)
    write_png(tmp_path / "b.png", np.asarray(frame.beauty))
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    write_png(tmp_path / "gray.png", np.ones((2, 3, 1)))
    with Image.open(tmp_path / "gray.png") as image:
        assert (image.mode, image.size) == ("L", (3, 2))
    write_png(tmp_path / "alpha.png", np.asarray([[[0.5, 0.5, 0.0, 0.5], [0.0, 0.0, 0.0, 0.0]]]))
    with Image.open(tmp_path / "alpha.png") as image:
        np.testing.assert_array_equal(np.asarray(image), [[[255, 255, 0, 128], [0, 0, 0, 0]]])


def test_png_refuses_what_has_no_colors(tmp_path):
    with pytest.raises(ValueError, match=r"a.png: a picture of 7 channels"):
        write_png(tmp_path / "a.png", np.zeros((2, 2, 7)))
    with pytest.raises(ValueError, match="exposure is nan"):
        write_png(tmp_path / "a.png", np.zeros((2, 2, 3)), exposure=float("nan"))
    assert not list(tmp_path.iterdir())


def test_encoding_for_the_screen_is_that_of_colour_science():
    import colour

    linear = np.concatenate(
        [np.linspace(-0.5, 1.5, 1001), np.geomspace(1e-6, 1, 100), [0.0031308, np.nan, np.inf]]
    )
    clipped = np.clip(np.nan_to_num(linear, nan=0.0), 0, 1)
    np.testing.assert_allclose(
        linear_to_srgb(linear), colour.cctf_encoding(clipped, function="sRGB"), atol=1e-15
    )
