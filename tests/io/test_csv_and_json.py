"""Measured profiles as CSV, and exports as JSON."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.io import load_material, read_profile, save_exports

GOOD = "r,red,green\n# measured in cm\n0.0, 4.0, 3.0\n\n0.1, 2.0, 1.0\n0.3, 0.5, 0.25\n"


def test_a_table_is_read_in_its_own_unit(tmp_path, dtype):
    path = tmp_path / "milk.csv"
    path.write_text(GOOD)
    profile = read_profile(path, mm_per_unit=10.0)
    assert profile.radii.dtype == jnp.result_type(float)
    np.testing.assert_allclose(profile.radii, [0, 1, 3], rtol=1e-6)
    np.testing.assert_allclose(
        profile.values, np.asarray([[4, 3], [2, 1], [0.5, 0.25]]) / 100, rtol=1e-6
    )


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", r"has 0 lines of numbers"),
        ("r,R\n0,1\n", r"has 1 lines of numbers"),
        (GOOD.replace("2.0", "two"), r"line 5: 'two' is no number"),
        (GOOD.replace("2.0", "nan"), r"line 5: 'nan' is no number"),
        (GOOD.replace("2.0, 1.0", "2.0"), r"line 5: has 2 numbers; expected 3 as above"),
        ("0\n1\n", r"line 1: has 1 numbers; expected a radius and at least one value"),
        (GOOD.replace("0.3,", "0.1,"), r"radii ascend, each once"),
        (GOOD.replace("0.0,", "-1,"), r"radii must be .*at least 0"),
    ],
)
def test_a_bad_table_is_refused_with_its_line(tmp_path, text, complaint):
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"bad.csv: .*{complaint}"):
        read_profile(path)


def test_a_missing_table_and_a_bad_unit_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no such file"):
        read_profile(tmp_path / "none.csv")
    path = tmp_path / "one.csv"
    path.write_text("0.1, 1\n0.2, 0.5\n")
    for unit in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(
            ValueError, match=rf"one\.csv: mm_per_unit is {unit}; it must be the positive length"
        ):
            read_profile(path, mm_per_unit=unit)
    with pytest.raises(IsADirectoryError, match="is a folder; name a file"):
        read_profile(tmp_path)


def test_exports_are_written_whole(tmp_path):
    path = tmp_path / "skin.json"
    save_exports(load_material("skin"), path)
    np.testing.assert_allclose(
        json.loads(path.read_text())["gaussians"]["variances"],
        [0.0064, 0.0484, 0.187, 0.567, 1.99, 7.41],
    )
    with pytest.raises(FileNotFoundError):
        save_exports(load_material("skin"), tmp_path / "nowhere" / "skin.json")


@pytest.mark.parametrize(
    ("unit", "given", "right"), [("cm", 1.0, 10.0), ("mm", 10.0, 1.0), ("um", 1.0, 0.001)]
)
def test_a_profile_in_another_unit_than_given_is_refused(tmp_path, unit, given, right):
    path = tmp_path / "a.csv"
    path.write_text(f"radius ({unit}), R (1/{unit}^2)\n0.1, 1\n0.2, 0.5\n", encoding="utf-8")
    with pytest.raises(
        ValueError, match=rf"a\.csv: line 1 speaks of {unit}, .* give mm_per_unit = {right:g} "
    ):
        read_profile(path, mm_per_unit=given)
    assert read_profile(path, mm_per_unit=right).radii[0] == pytest.approx(0.1 * right)
