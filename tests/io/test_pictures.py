"""Frames in OpenEXR, pictures in PNG, and those that move."""

import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from splatjax.io import read_exr, read_manifest, write_animation, write_exr, write_png
from splatjax.scene import Frame

TOOLS = [["exrheader"], ["oiiotool", "--info", "-v"]]


def some_frame(channels=3, gaussians=4, lights=2, height=6, width=5) -> Frame:
    """A frame of noise whose diffuse part is the weighted sum of its layers."""
    random = np.random.default_rng(3)

    def noise(*shape):
        return jnp.asarray(random.uniform(0, 1, shape).astype(np.float32))

    size, colors = (height, width), (height, width, channels)
    layers, weights = noise(gaussians, *colors), noise(gaussians, channels)
    diffuse, specular = (layers * weights[:, None, None]).sum(axis=0), noise(*colors)
    return Frame(
        beauty=diffuse + specular,
        coverage=noise(*size),
        depth=noise(*size).at[0, 0].set(jnp.inf),
        position=noise(*size, 3),
        normal=noise(*size, 3),
        albedo=noise(*colors),
        shadow=noise(lights, *size),
        irradiance=noise(*colors),
        layers=layers,
        weights=weights,
        diffuse=diffuse,
        specular=specular,
        handed_over=noise(gaussians),
        overflow=jnp.zeros((), jnp.float32),
        single_scattering=noise(*colors) if channels == 1 else None,
    )


@pytest.mark.parametrize(("channels", "lights", "gaussians"), [(3, 2, 11), (1, 0, 1), (12, 1, 3)])
def test_frame_comes_back_bit_by_bit(tmp_path, channels, lights, gaussians):
    frame = some_frame(channels, gaussians, lights)
    write_exr(tmp_path / "frame.exr", jax.tree.map(lambda leaf: leaf.astype(float), frame))
    back = read_exr(tmp_path / "frame.exr")
    for one, other in zip(jax.tree.leaves(frame), jax.tree.leaves(back), strict=True):
        assert other.dtype == jnp.float32
        np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
    assert [file.name for file in tmp_path.iterdir()] == ["frame.exr"]


def test_diffuse_is_rebuilt_from_layers_and_header_alone(tmp_path):
    manifest = {"--width": 5, "splats": None}
    path = tmp_path / "frame.exr"
    write_exr(path, some_frame(), variances=[0.1, 0.2, 0.4, 7.5], manifest=manifest)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = dict(file.header())
        planes = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    for channel, letter in enumerate("RGB"):
        rebuilt = sum(
            header[f"splatjax.weights.{k}"][channel] * planes[f"diffusion.{k}.{letter}"]
            for k in (1, 2, 3, 4)
        )
        np.testing.assert_allclose(rebuilt, planes[f"diffuse.{letter}"], rtol=1e-6)
    np.testing.assert_allclose(header["splatjax.variances"], [0.1, 0.2, 0.4, 7.5], rtol=1e-7)
    np.testing.assert_allclose(np.ravel(header["chromaticities"])[:2], [0.64, 0.33], rtol=1e-6)
    assert all(plane.dtype == np.float32 for plane in planes.values())
    assert read_manifest(path) == manifest


@pytest.mark.parametrize("command", [each for each in TOOLS if shutil.which(each[0])])
def test_common_tools_list_the_layers(tmp_path, command):
    """Debian: openexr, openimageio-tools."""
    write_exr(tmp_path / "frame.exr", some_frame())
    words = [*command, str(tmp_path / "frame.exr")]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    for name in ("R", "A", "Z", "position.X", "albedo.R", "shadow.2", "diffusion.4.G"):
        assert name in printed


def test_exr_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_exr(tmp_path / "none.exr")
    write_exr(tmp_path / "frame.exr", some_frame())
    whole = (tmp_path / "frame.exr").read_bytes()
    for size in range(0, len(whole), len(whole) // 40):
        (tmp_path / "cut.exr").write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"cut.exr: cannot be read as a picture"):
            read_exr(tmp_path / "cut.exr")
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, {"R": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(tmp_path / "other.exr"))
    with pytest.raises(ValueError, match=r"other.exr: lacks .*, so it is no frame"):
        read_exr(tmp_path / "other.exr")
    with pytest.raises(ValueError, match=r"other.exr: does not record what it was made of"):
        read_manifest(tmp_path / "other.exr")


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


@pytest.fixture
def frames(tmp_path):
    """Three frames of noise."""
    paths = [tmp_path / f"{i}.png" for i in range(3)]
    for i, path in enumerate(paths):
        write_png(path, np.random.default_rng(i).uniform(0, 1, (6, 5, 3)))
    return paths


def test_animation_keeps_the_colors_and_the_time(tmp_path, frames):
    write_animation(tmp_path / "film.webp", frames, frames_per_second=24.0)
    write_animation(tmp_path / "still.webp", frames[:1])
    with Image.open(tmp_path / "film.webp") as film, Image.open(tmp_path / "still.webp") as still:
        assert (still.n_frames, film.n_frames, film.size, film.info["loop"]) == (1, 3, (5, 6), 0)
        durations = []
        for i, frame in enumerate(frames):
            film.seek(i)
            film.load()
            durations.append(film.info["duration"])
            with Image.open(frame) as image:
                np.testing.assert_array_equal(np.asarray(film.convert("RGB")), np.asarray(image))
    assert durations == [42, 41, 42]  # the third frame ends at 125 ms


def test_animations_that_cannot_be_are_refused(tmp_path, frames):
    path = tmp_path / "film.webp"
    with pytest.raises(ValueError, match="0 frames"):
        write_animation(path, [])
    with pytest.raises(ValueError, match=r"from 0\.1 to 60"):
        write_animation(path, frames, frames_per_second=0.0)
    write_png(frames[2], np.zeros((6, 6, 3)))
    with pytest.raises(ValueError, match=r"2\.png: is \(6, 6\) pixels"):
        write_animation(path, frames)
    assert not path.exists()
