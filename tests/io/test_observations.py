"""Which pictures were taken, and how: what a file says is what is read, and what it may not say."""

import equinox as eqx
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
    names = [each.name for each in picture_paths(path)]
    assert names == ["pictures.toml", "one.exr", "mask.exr", "one.exr"]
    picture = np.arange(12.0).reshape(3, 4, 1) + np.arange(3)
    mask = picture[..., 0] > 5
    size = np.sqrt(np.mean(picture[mask] ** 2))
    cameras = [
        sj.Camera.look_at([0, 1, 50], [0, 0, 0], fov=fov, width=4, height=3) for fov in (30, 25)
    ]
    lights = (
        sj.DirectionalLight([0, 0, -1], [1, 2, 3]),
        sj.PointLight([0, 0, 20], [5, 5, 5], cast_shadows=False),
    )
    unknown = sj.inverse.UnknownIntensity()
    beam = sj.GaussianBeam([0, 0, 20], [0, 0, -1], [1, 1, 1], 0.5)
    expected = [
        sj.inverse.Observation(picture, cameras[0], lights, mask, 0.02 * size, unknown),
        sj.inverse.Observation(picture, cameras[1], beam),
    ]
    assert eqx.tree_equal(sj.io.read_observations(path), expected, rtol=1e-6)


BAD = [
    ('file = "one.exr"\nmask', "mask", r"\[pictures 1\] file .* None"),
    ("noise = 0.02", "noise = 0", r"\[pictures 1\].* noise .* 0$"),
    ("noise = 0.02", "nois = 0.02", r"\[pictures 1\] .*'nois'; did you mean 'noise'"),
    ('"unknown"', '"maybe"', r"\[pictures 1\] intensity .*'maybe'"),
    ("[0, 1, 50]", "[0, 1]", r"\[pictures 1 camera\].* eye.*\[0.0, 1.0\]"),
    ("[0, 1, 50]", "[0, 50, 0]", r"\[pictures 1 camera\].* up is"),
    ("[0, 1, 50]", "[0, 0, 0]", r"\[pictures 1 camera\]: eye and target are both"),
    ("[0, 0, -1]", "[0, 0, 0]", r"\[pictures 1 lights 1\].*direction .* 0 at"),
    ("[1, 2, 3]", "[1, 2]", r"\[pictures 1 lights 1\] irradiance .*\[1.0, 2.0\]"),
    ('"directional"', '"sun"', r"\[pictures 1 lights 1\] kind .*'sun'"),
    ("cast_shadows = false", "cast_shadows = 0", r"\[pictures 1 lights 2\] cast_shadows .* 0$"),
    ("intensity = 5", "power = 5", r"\[pictures 1 lights 2\] .*'power'"),
    (GOOD, "[medium]\n", "unknown entry 'medium'"),
    (GOOD, "[[pictures", "is no TOML file"),
    ("one.exr", "gone.exr", r"gone\.exr"),
    ("fov = 30", "fov = [30, 1]", r"\[pictures 1 camera\] fov .*\[30.0, 1.0\]"),
    ("[1, 2, 3]", "-1", r"\[pictures 1 lights 1\].* irradiance .* -1$"),
    ("fov = 30", "fov = 200", r"\[pictures 1 camera\].* fov .* 200"),
]


@pytest.mark.parametrize(("old", "new", "value"), BAD)
def test_what_is_wrong_is_named(path, old, new, value):
    path.write_text(GOOD.replace(old, new))
    with pytest.raises((ValueError, FileNotFoundError), match=value):
        sj.io.read_observations(path)
