"""Scenes that nobody means: warned of, or refused before they are rendered."""

import warnings

import equinox as eqx
import jax
import numpy as np
import pytest
from bodies import sheet, sphere

import splatjax as sj
from splatjax.render import _checks
from splatjax.render._checks import check_displayable, check_scene


def scene(splats: sj.Splats | None = None, lights=None) -> sj.Scene:
    gaussians = sj.SumOfGaussians([0.1, 2], [[0.3, 0.3, 0.2], [0.5, 0.4, 0.2]])
    lights = sj.DirectionalLight([0, 0, -1], 3.14) if lights is None else lights
    return sj.Scene(sphere(2000) if splats is None else splats, lights, sj.Material(gaussians))


def camera(distance: float = 50.0) -> sj.Camera:
    return sj.Camera.look_at([0, 0, distance], [0, 0, distance - 1], width=8, height=8)


FLIPPED = eqx.tree_at(lambda splats: splats.normals, sphere(2000), replace_fn=lambda n: -n)


@pytest.mark.parametrize(
    ("wrong", "distance", "said"),
    [
        (scene(lights=[]), 50, "no light"),
        (scene(lights=sj.PointLight([0, 0, 50], 0)), 50, "no light"),
        (scene(FLIPPED), 50, "normals of the splats point into the body"),
        (scene(), 3, "camera is inside the body"),
        (scene(sphere(2000, 0.0002)), 50, "check the units"),
        (scene(sphere(2000, 20_000.0)), 50_000, "check the units"),
    ],
)
def test_a_scene_that_nobody_means_is_warned_of_once(wrong, distance, said):
    _checks._warn_once.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3):
            check_scene(wrong, camera(distance))
    assert [said in str(warning.message) for warning in caught] == [True]


@pytest.mark.parametrize(
    "right",
    [
        scene(),
        scene(sheet(10.0, 0.5)),
        scene(sj.Splats(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))),
        eqx.tree_at(lambda s: s.material, scene(sphere(2000, 2000.0)), scene().material.opaque()),
    ],
)
def test_other_scenes_pass(right):
    check_scene(right, camera(50_000.0))
    jax.jit(lambda light: check_scene(scene(lights=light), camera()))(
        sj.DirectionalLight([0, 0, -1], 0)
    )


def test_a_picture_that_does_not_fit_is_refused_before_it_is_rendered(monkeypatch):
    large = sj.Camera.look_at([0, 0, 50], [0, 0, 0], width=10**6, height=10**6)
    with pytest.raises(ValueError, match=r"1000000 x 1000000 pixels .* 5e\+05 GB"):
        sj.render(scene(), large)
    monkeypatch.setattr(_checks, "_device_memory", lambda splats: 1e6)
    with pytest.raises(ValueError, match=r"2000 splats would take .* 0.001 GB are free"):
        check_scene(scene(), camera())


def test_channels_that_no_png_shows_are_refused():
    check_displayable(3)
    with pytest.raises(ValueError, match="31 channels"):
        check_displayable(31)
