"""The loop of a fit, whose renderer a stand-in replaces: plans, failures, and what is refused."""

from collections import namedtuple
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from bodies import (
    PLAIN,
    assert_refused,
    lights_from_two_sides as lights,
    sphere,
    view,
    with_albedo,
)

import splatjax as sj
from splatjax.inverse import _fit_scene

pytestmark = pytest.mark.once

SIZE = 16
camera = partial(view, size=SIZE)


Frame = namedtuple("Frame", ["beauty", "coverage", "overflow"])


def material() -> sj.Material:
    return sj.Material(sj.SumOfGaussians([1.0], [[1.0, 1.0]]))


def stand_in(monkeypatch, reach: float, spoiled: float = np.inf) -> list[float]:
    """Let a picture be the mean albedo; it outgrows plans by `reach`, and is no number where it is
    above `spoiled`.

    Gives the albedos for which plans are made.
    """
    made = []
    splats = sphere(20)
    plan = sj.make_plan(sj.Scene(splats, lights()[0], material()), camera(), PLAIN)

    def make_plans(pictured_scenes, material, settings):
        made.append(float(jnp.mean(pictured_scenes[0].splats.albedo)))
        return [eqx.tree_at(lambda p: p.interval, plan, jnp.full(2, made[-1]))] * len(
            pictured_scenes
        )

    def render(scene, camera, settings, plan):
        mean = jnp.mean(scene.splats.albedo)
        over = jnp.where(jnp.abs(mean - plan.interval[0]) > reach, 2.0, 0.0)
        value = jnp.where((over > 0) | (mean > spoiled), jnp.nan, mean)
        full = jnp.ones((camera.height, camera.width))
        beauty = value * jnp.ones((*full.shape, 2))
        return Frame(beauty, full, jax.lax.stop_gradient(over))

    monkeypatch.setattr(_fit_scene, "make_plans", make_plans)
    monkeypatch.setattr(_fit_scene, "render", render)
    return made


def lifted(
    target: float, resolution: int, spoilt=(), **more
) -> tuple[sj.inverse.FittedScene, list[str]]:
    """Fit a stand-in that starts at 0.5; resolutions of shadow maps distinguish stand-ins that are
    otherwise alike to the compiler.

    A part of the picture is masked, and of another part nothing is known; some rows may be spoilt.
    """
    splats, messages = with_albedo(sphere(20), np.full((20, 2), 0.5)), []
    picture = np.full((SIZE, SIZE, 2), target)
    picture[list(spoilt)] = 90.0
    picture[:5], picture[5, :, 1] = 90.0, np.nan
    mask, deviation = np.arange(SIZE)[:, None] > 4 * np.ones(SIZE), np.full(picture.shape, 0.01)
    seen = sj.inverse.Observation(picture, camera(), (lights()[0],), mask=mask, deviation=deviation)
    optimizer = optax.adam(optax.cosine_decay_schedule(1.0, 40))
    parts = [sj.inverse.AlbedoMap(deviation=1e3)]
    found = sj.inverse.fit_scene(
        [seen],
        splats,
        material(),
        parts,
        optimizer,
        steps=40,
        settings=sj.RenderSettings(shadows=sj.splatting.ShadowSettings(resolution=resolution)),
        progress=lambda s, loss: messages.append(s),
        **more,
    )
    return found, messages


def test_a_scene_that_outgrows_its_plan_is_planned_anew(monkeypatch):
    made = stand_in(monkeypatch, reach=0.07)
    found, messages = lifted(0.8, 101)
    assert found.plans == len(made) > 2
    again = ["exceeds the capacity of its plan; planning again" in each for each in messages]
    assert sum(again) == found.plans - 1
    assert np.all(np.isfinite(found.losses))
    np.testing.assert_allclose(found.splats.albedo, 0.8, atol=5e-3)
    assert np.isnan(found.pictures[0][:6]).all()
    np.testing.assert_allclose(found.residuals[0][6:], 0, atol=5e-3)


def test_a_robust_loss_is_not_misled_by_rows_that_shine(monkeypatch):
    """Two rows of fourteen: where they pull with 2 b at most, each of the others gives way by less
    than a deviation.
    """
    stand_in(monkeypatch, reach=np.inf)
    found, _ = lifted(0.8, 105, spoilt=(8, 13), loss=sj.inverse.HuberLoss())
    np.testing.assert_allclose(found.splats.albedo, 0.8, atol=0.01)
    misled, _ = lifted(0.8, 105, spoilt=(8, 13))
    assert float(jnp.min(misled.splats.albedo)) > 0.85


def test_what_is_no_number_ends_the_fit_at_the_best_before_it(monkeypatch):
    stand_in(monkeypatch, reach=np.inf, spoiled=0.6)
    with pytest.raises(RuntimeError, match="Nonfinite"):
        lifted(0.8, 102)
    found, _ = lifted(0.8, 102, throw=False)
    assert 2 < len(found.losses) == found.best + 2 < 40
    assert 0.5 < float(jnp.mean(found.splats.albedo)) <= 0.6
    assert np.all(np.isfinite(found.pictures[0][6:]))
    refused = r"no pixel of observations\[0\] counts"
    assert_refused(lambda: lifted(np.nan, 104, spoilt=range(0)), refused)
    stand_in(monkeypatch, reach=np.inf, spoiled=0.1)
    assert_refused(lambda: lifted(0.8, 103), "loss or gradient of the start is not finite")


def test_pixels_that_a_body_does_not_fill_count_before_black_alone():
    backgrounds = sj.inverse.UnknownBackground(), sj.inverse.BlackBackground()
    coverage = jnp.asarray([[0.0, 0.5, 0.9989, 0.9991, 1.0]])
    counts = [background.counts(coverage)[0] for background in backgrounds]
    np.testing.assert_array_equal(counts, [[0, 0, 0, 1, 1], [1, 1, 1, 1, 1]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parts": ()}, "got 1, 0 and 1"),
        ({"observations": (), "steps": 0}, "got 0, 1 and 0"),
        (
            {"parts": (sj.inverse.AlbedoMap(), sj.inverse.AlbedoMap(1.0))},
            "parts are AlbedoMap, AlbedoMap",
        ),
        ({"splats": sphere(20)}, r"splats\.albedo is None, and AlbedoMap"),
        (
            {"splats": sphere(16), "parts": (sj.inverse.NormalOffsets(0.1, 1.0, 1.0),)},
            "number of splats must be at least 17 for NormalOffsets.*got 16",
        ),
        ({"channels": 3}, r"observations\[0\]\.picture has 3 channels, material has 2"),
        (
            {"intensity": sj.inverse.UnknownColor()},
            r"observations\[0\]\.intensity is UnknownColor\(\)",
        ),
    ],
)
def test_what_cannot_be_fitted_is_refused(change, message):
    picture = np.ones((SIZE, SIZE, change.pop("channels", 2)))
    intensity = change.pop("intensity", sj.inverse.KnownIntensity())
    arguments = {
        "observations": [
            sj.inverse.Observation(picture, camera(), lights()[0], intensity=intensity)
        ],
        "splats": with_albedo(sphere(20), np.full((20, 2), 0.5)),
        "parts": [sj.inverse.AlbedoMap()],
        "steps": 1,
    }
    assert_refused(
        lambda: sj.inverse.fit_scene(
            material=material(), optimizer=optax.adam(1.0), **(arguments | change)
        ),
        message,
    )
