"""Which pictures were taken, and how: what a file says is what is read, and what it may not say."""

import numpy as np
import pytest
from writers import write_picture

import splatjax as sj
from splatjax.io import picture_paths

GOOD = """[[pictures]]
file = "one.exr"
mask = "mask.exr"
noise = 0.02
intensity = "unknown"
camera = { position = [0, 1, 50], target = [0, 0, 0], fov = 30 }
[[pictures.lights]]
kind = "directional"
direction = [0, 0, -1]
irradiance = [1, 2, 3]
[[pictures.lights]]
kind = "point"
position = [0, 0, 20]
intensity = 5
cast_shadows = false

[[pictures]]
file = "one.exr"
camera = { position = [0, 1, 50], target = [0, 0, 0] }
[[pictures.lights]]
kind = "beam"
origin = [0, 0, 20]
direction = [0, 0, -1]
power = [1, 1, 1]
variance = 0.5
"""


@pytest.fixture
def path(tmp_path):
    red = np.arange(12.0).reshape(3, 4, 1)
    write_picture(tmp_path / "one.exr", red + np.arange(3), "float")
    write_picture(tmp_path / "mask.exr", red > 5, "float")
    return tmp_path / "pictures.toml"


def test_what_is_written_is_read(path):
    path.write_text(GOOD)
    first, second = sj.io.read_observations(path)
    names = [each.name for each in picture_paths(path)]
    assert names == ["pictures.toml", "one.exr", "mask.exr", "one.exr"]
    assert first.picture.shape == (3, 4, 3)
    np.testing.assert_array_equal(first.picture[1, 2], [6, 7, 8])
    np.testing.assert_array_equal(first.mask, np.arange(12).reshape(3, 4) > 5)
    size = np.sqrt(np.mean(np.asarray(first.picture)[np.asarray(first.mask)] ** 2))
    np.testing.assert_allclose(first.deviation, 0.02 * size, rtol=1e-6)
    assert isinstance(first.intensity, sj.inverse.UnknownIntensity)
    assert (first.camera.width, first.camera.height) == (4, 3)
    np.testing.assert_allclose(first.camera.position, [0, 1, 50])
    sun, lamp = first.lights
    np.testing.assert_array_equal(sun.irradiance, [1, 2, 3])
    assert sun.cast_shadows
    assert isinstance(lamp, sj.PointLight)
    np.testing.assert_array_equal(lamp.intensity, [5, 5, 5])
    assert not lamp.cast_shadows
    assert second.mask is None
    assert second.deviation is None
    assert isinstance(second.intensity, sj.inverse.KnownIntensity)
    (beam,) = second.lights
    assert isinstance(beam, sj.GaussianBeam)
    assert float(beam.variance) == 0.5


BAD = [
    ('file = "one.exr"\nmask', "mask", r"\[pictures 1\] file .* None"),
    ("noise = 0.02", "noise = 0", r"\[pictures 1\] noise .* 0$"),
    ("noise = 0.02", "nois = 0.02", r"\[pictures 1\] .*'nois'; did you mean 'noise'"),
    ('"unknown"', '"maybe"', r"\[pictures 1\] intensity .*'maybe'"),
    ("[0, 1, 50]", "[0, 1]", r"\[pictures 1 camera\] position .*\[0, 1\]"),
    ("[0, 1, 50]", "[0, 50, 0]", r"\[pictures 1 camera\].* up is"),
    ("[0, 1, 50]", "[0, 0, 0]", r"\[pictures 1 camera\]: eye and target are both"),
    ("[0, 0, -1]", "[0, 0, 0]", r"\[pictures 1 lights 1\] direction .*\[0, 0, 0\]"),
    ("[1, 2, 3]", "[1, 2]", r"\[pictures 1 lights 1\] irradiance .*\[1, 2\]"),
    ('"directional"', '"sun"', r"\[pictures 1 lights 1\] kind .*'sun'"),
    ("cast_shadows = false", "cast_shadows = 0", r"\[pictures 1 lights 2\] cast_shadows .* 0$"),
    ("intensity = 5", "power = 5", r"\[pictures 1 lights 2\] .*'power'"),
    (GOOD, "[medium]\n", "unknown entry 'medium'"),
    (GOOD, "[[pictures", "is no TOML file"),
    ("one.exr", "gone.exr", r"gone\.exr"),
    ("fov = 30", "fov = 200", r"\[pictures 1 camera\] fov .* 200$"),
]


@pytest.mark.parametrize(("old", "new", "value"), BAD)
def test_what_is_wrong_is_named(path, old, new, value):
    path.write_text(GOOD.replace(old, new))
    with pytest.raises((ValueError, FileNotFoundError), match=value):
        sj.io.read_observations(path)
