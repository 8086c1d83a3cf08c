"""Frames in OpenEXR, pictures in PNG, and those that move."""

import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from PIL import Image

from splatjax.io import read_exr, read_manifest, write_animation, write_exr, write_png
from splatjax.scene import Frame


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
        unresolved_fraction=noise(gaussians),
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


def test_other_readers_rebuild_diffuse_from_layers_and_header_alone(tmp_path):
    frame, variances, manifest = some_frame(), [0.1, 0.2, 0.4, 7.5], {"--width": 5, "splats": None}
    path = tmp_path / "frame.exr"
    write_exr(path, frame, variances=variances, manifest=manifest)
    with OpenEXR.File(str(path)) as file:
        header = dict(file.header())
        planes = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    weights = [header[f"splatjax.weights.{k}"] for k in (1, 2, 3, 4)]
    rebuilt = sum(weights[k - 1] * planes[f"diffusion.{k}"] for k in (1, 2, 3, 4))
    np.testing.assert_allclose(rebuilt, planes["diffuse"], rtol=1e-6)
    np.testing.assert_allclose(header["splatjax.variances"], variances, rtol=1e-7)
    np.testing.assert_allclose(np.ravel(header["chromaticities"])[:2], [0.64, 0.33], rtol=1e-6)
    assert all(plane.dtype == np.float32 for plane in planes.values())
    assert read_manifest(path) == manifest
    names = oiio.ImageInput.open(str(path)).spec().channelnames
    assert {"R", "A", "Z", "position.X", "albedo.R", "shadow.2", "diffusion.4.G"} <= {*names}


ENCODED = {
    "color": ([[[0, 0.2158605, 1], [0.00215, 2, -1]]], [[[0, 128, 255], [7, 255, 0]]]),
    "gray": (np.ones((2, 3, 1)), np.full((2, 3), 255)),
    "alpha": ([[[0.5, 0.5, 0, 0.5], [0, 0, 0, 0]]], [[[255, 255, 0, 128], [0, 0, 0, 0]]]),
}


@pytest.mark.parametrize("name", ENCODED)
def test_png_encodes_for_the_display(tmp_path, name):
    """sRGB: linear 0.2159 is 128 of 255, 0.0021 is a 36th (the straight part), and exposure counts
    in stops.
    """
    picture, expected = (np.asarray(each) for each in ENCODED[name])
    write_png(tmp_path / "a.png", picture)
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(np.asarray(image), expected)
    scale = [0.25] * 3 + [1] if name == "alpha" else 0.25
    write_png(tmp_path / "b.png", picture * scale, exposure=2.0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_animation_keeps_the_colors_and_the_time(tmp_path):
    """Three frames of noise; the third ends at 125 ms."""
    pictures = np.random.default_rng(0).integers(0, 256, (3, 6, 5, 3), np.uint8)
    frames = [tmp_path / f"{i}.png" for i in range(3)]
    for path, picture in zip(frames, pictures, strict=True):
        Image.fromarray(picture).save(path)
    write_animation(tmp_path / "film.webp", frames, frames_per_second=24.0)
    durations = []
    with Image.open(tmp_path / "film.webp") as film:
        assert (film.n_frames, film.size, film.info["loop"]) == (3, (5, 6), 0)
        for i, picture in enumerate(pictures):
            film.seek(i)
            np.testing.assert_array_equal(np.asarray(film.convert("RGB")), picture)
            durations.append(film.info["duration"])
    assert durations == [42, 41, 42]
