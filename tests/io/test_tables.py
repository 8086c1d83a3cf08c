"""Measured profiles and media as CSV, exports and records as JSON. Which pictures were taken, and
how: what a file contains is what is read, and what it must not contain.
"""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import assert_refused
from pictures import write_picture

import splatjax as sj

GOOD = "r,red,green\n# measured in cm\n0.0, 4.0, 3.0\n\n0.1, 2.0, 1.0\n0.3, 0.5, 0.25\n"


def test_a_table_is_read_in_its_own_unit(tmp_path, dtype):
    (tmp_path / "milk.csv").write_text(GOOD)
    profile = sj.io.read_profile(tmp_path / "milk.csv", mm_per_unit=10.0)
    assert profile.radii.dtype == jnp.result_type(float)
    np.testing.assert_allclose(profile.radii, [0, 1, 3], rtol=1e-6)
    expected = np.asarray([[4, 3], [2, 1], [0.5, 0.25]]) / 100
    np.testing.assert_allclose(profile.values, expected, rtol=1e-6)


MEDIA = "name,sigma_a,sigma_s_prime,eta\nmilk, 0, 1.5, 1.3\n\n,0.1,2,1.4\n1,1,1,1\n"
BAD = {
    sj.io.read_profile: [
        ("", "0 lines"),
        ("r,R\n0,1\n", "1 lines"),
        (GOOD.replace("2.0", "two"), "line 5: 0.1, two, 1.0"),
        (GOOD.replace("2.0", "nan"), "line 5: 0.1, nan, 1.0"),
        (GOOD.replace("2.0, 1.0", "2.0"), "line 5: 0.1, 2.0"),
        ("0\n1\n", "line 1: 0 "),
        (GOOD.replace("0.3,", "0.1,"), "radii"),
        (GOOD.replace("0.0,", "-1,"), "radii"),
        ("r (cm), R\n0.1, 1\n0.2, 0.5\n", r"line 1: .* cm.* mm_per_unit = 10 "),
        ("r (um), R\n0.1, 1\n0.2, 0.5\n", r"line 1: .* um.* mm_per_unit = 0.001 "),
        ("r (m), R\n0.1, 1\n0.2, 0.5\n", r"line 1: .* m, .* mm_per_unit = 1000 "),
        (b"\xff\xfe", "text"),
    ],
    sj.io.read_media: [
        ("", "sigma_a"),
        ("sigma_a,eta\n1,1\n", "sigma_s_prime"),
        (MEDIA.split("\n")[0] + "\n", "0 rows"),
        ("sigma_a,sigma_s_prime,eta,unit\n1,1,1,1/cm\n", "unit"),
        (MEDIA.replace("1.5", "0"), "line 2: milk, 0, 0,"),
        (MEDIA.replace("0.1,", "-0.1,"), "line 4: , -0.1, 2"),
        (MEDIA.replace("1.5", "many"), "line 2: milk, 0, many"),
        (MEDIA.replace(",1.4", ""), "line 4: , 0.1, 2 must be name"),
    ],
}


@pytest.mark.parametrize(
    ("read", "text", "value"), [(read, *case) for read, cases in BAD.items() for case in cases]
)
def test_a_bad_table_is_refused_with_its_line(tmp_path, read, text, value):
    path = tmp_path / "bad.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert_refused(lambda: read(path), rf"bad.csv: .*{value}")


def test_media_are_read_and_their_columns_come_back(tmp_path):
    (tmp_path / "media.csv").write_text(MEDIA)
    names, media = sj.io.read_media(tmp_path / "media.csv")
    assert names == ["milk", "2", "1"]
    np.testing.assert_array_equal(media, [[0, 1.5, 1.3], [0.1, 2, 1.4], [1, 1, 1]])
    sj.io.write_columns(tmp_path / "back.csv", {"name": names, "eta": media[:, 2] / 3})
    columns = sj.io.read_columns(tmp_path / "back.csv")
    assert columns["name"] == tuple(names)
    np.testing.assert_array_equal(np.asarray(columns["eta"], float), media[:, 2] / 3)


def test_records_come_back_and_fingerprints_tell_contents_apart(tmp_path):
    record, path = {"--frames": 12, "--fill": 0.1, "splats": None}, tmp_path / "record.json"
    sj.io.write_record(path, record)
    assert sj.io.read_record(path) == record == json.loads(path.read_text())
    path.write_bytes(b"abc")
    assert sj.io.fingerprint(path).startswith("3 bytes, SHA-256 ba7816bf")
    path.write_bytes(b"xyz")
    assert not sj.io.fingerprint(path).endswith("ba7816bf")


PICTURES = """[[pictures]]
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


def test_images_of_environments_belong_to_the_files_of_a_list(path):
    images = [f'[[pictures.lights]]\nimage = "{name}"' for name in ("sky.exr", "sun")]
    path.write_text("\n".join([PICTURES, *images]))
    names = [each.name for each in sj.io.picture_paths(path)]
    assert names == ["pictures.toml", "one.exr", "mask.exr", "one.exr", "sky.exr"]


def test_what_is_written_is_read(path):
    path.write_text(PICTURES)
    names = [each.name for each in sj.io.picture_paths(path)]
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


BAD_PICTURES = [
    ('file = "one.exr"\nmask', "mask", r"\[pictures 1\] file .* None"),
    ("noise = 0.02", "noise = 0", r"\[pictures 1\].* noise .* 0$"),
    ("noise = 0.02", "nois = 0.02", r"\[pictures 1\] .*'nois'; did you mean 'noise'"),
    ('"unknown"', '"maybe"', r"\[pictures 1\] intensity .*'maybe'"),
    ("[0, 1, 50]", "[0, 1]", r"\[pictures 1 camera\] position .*\[0.0, 1.0\]"),
    ("[0, 1, 50]", "[0, 50, 0]", r"\[pictures 1 camera\].* up is"),
    ("[0, 1, 50]", "[0, 0, 0]", r"\[pictures 1 camera\]: eye and target are both"),
    ("[0, 0, -1]", "[0, 0, 0]", r"\[pictures 1 lights 1\].*direction .* 0 at"),
    ("[1, 2, 3]", "[1, 2]", r"\[pictures 1 lights 1\] irradiance .*\[1.0, 2.0\]"),
    ('"directional"', '"sun"', r"\[pictures 1 lights 1\] kind .*'sun'"),
    ("cast_shadows = false", "cast_shadows = 0", r"\[pictures 1 lights 2\] cast_shadows .* 0$"),
    ("intensity = 5", "power = 5", r"\[pictures 1 lights 2\] .*'power'"),
    (PICTURES, "[medium]\n", "unknown entry 'medium'"),
    (PICTURES, "[[pictures", "TOML file"),
    ("one.exr", "gone.exr", r"gone\.exr"),
    ("fov = 30", "fov = [30, 1]", r"\[pictures 1 camera\] fov .*\[30.0, 1.0\]"),
    ("[1, 2, 3]", "-1", r"\[pictures 1 lights 1\].* irradiance .* -1$"),
    ("fov = 30", "fov = 200", r"\[pictures 1 camera\].* fov .* 200"),
]


@pytest.mark.parametrize(("old", "new", "value"), BAD_PICTURES)
def test_what_is_wrong_is_named(path, old, new, value):
    path.write_text(PICTURES.replace(old, new))
    with pytest.raises((ValueError, FileNotFoundError), match=value):
        sj.io.read_observations(path)
