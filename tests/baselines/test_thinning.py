"""The law of Figure 5 against sums over splats that were left out, on bodies that it was not fitted
on.
"""

import itertools
import os
from pathlib import Path

import bodies
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
from splatjax.baselines import ThinnedDiffuser, layer_contrast, splats_that_suffice, thinning_error
from splatjax.diffusion import DenseDiffuser, PlainMean

FACTOR = 1.5  # what the law is held to
POINTS, LIGHTS = 384, ((-0.5, -0.4, -0.75), (0.8, -0.6, -0.2))
AMPLIFIED, KEEP = (2.0, 3.0, 5.0), (2, 4, 8, 16)


def factors(body: sj.Splats, sources):
    """Return measured errors over those of the law, for lights, widths and ratios."""
    rng, ratios = np.random.default_rng(2), []
    columns = (body.centers, body.normals, body.areas)
    centers, normals, areas = (np.asarray(column, np.float32) for column in columns)
    spacing = float(np.sqrt(areas.mean()))
    points = centers[rng.choice(body.count, POINTS, replace=False)]

    def layer(source, variance, kept):
        """Sum as the renderer does: sources lie below their splats."""
        below = centers[kept] - 0.75 * np.float32(np.sqrt(variance)) * normals[kept]
        squared = np.sum((points[:, None] - below[None]) ** 2, axis=2)
        least = squared.min(axis=1, keepdims=True)
        weight = areas[None, kept] * np.exp(-0.5 * (squared - least) / variance)
        return weight @ source[kept] / weight.sum(axis=1, keepdims=True)

    for source, width, number in itertools.product(sources, AMPLIFIED, KEEP):
        variance, x = (width * spacing) ** 2, np.sqrt(number) / width
        if x > 2:
            continue
        exact, squares = layer(source, variance, slice(None)), []
        for start in range(3):
            kept = np.arange(start * number // 3, body.count, number)
            squares.append(np.mean((layer(source, variance, kept) - exact) ** 2))
        error = np.sqrt(np.mean(squares) / np.mean(exact**2))
        light, square = (jnp.asarray(value, body.centers.dtype) for value in (source, variance))
        one, share = jnp.asarray(1.0), jnp.asarray(1 / number)
        law = thinning_error(width * one, one, share, layer_contrast(body, light, square))
        ratios.append(error / float(law))
    return np.asarray(ratios)


@pytest.mark.long
@pytest.mark.once
@pytest.mark.shared
def test_the_law_holds_on_a_head_it_was_not_fitted_on():
    """Light that enters under each of the lights, with shadows and the color of the skin."""
    folder = Path(os.environ["SPLATJAX_SHARED"]) / "data" / "lee_perry_smith"
    options = {"mm_per_unit": 53.0, "v_up": True, "crop_min_y": -0.9}
    mesh, albedo = folder / "LeePerrySmith.glb", folder / "Map-COL.jpg"
    head, skin = sj.sample_mesh(mesh, 30_000, albedo=albedo, **options), sj.load_material("skin")
    lamps = [
        sj.DirectionalLight(jnp.asarray(direction), jnp.full(3, np.pi)) for direction in LIGHTS
    ]
    scenes = [sj.Scene(head, (lamp,), skin.white()) for lamp in lamps]
    camera = sj.Camera.look_at(jnp.asarray([0.0, 0.0, 900.0]), jnp.zeros(3), width=16, height=16)
    plan = sj.make_plan(scenes, camera, sj.RenderSettings(diffuser=DenseDiffuser()))
    sources = [np.asarray(sj.compute_irradiance(scene, plan).source.T) for scene in scenes]
    ratios = factors(head, sources)
    assert np.max(np.abs(np.log(ratios))) < np.log(FACTOR), ratios


@pytest.mark.once
def test_a_radius_twice_as_large_allows_a_quarter_and_what_suffices_is_the_inverse():
    one, contrast = jnp.asarray(1.0), jnp.asarray(0.6)
    for error in (0.006, 0.02, 0.05):
        ratios = [
            splats_that_suffice(jnp.asarray(width), one, jnp.asarray(error), contrast)
            for width in (16.0, 8.0)
        ]
        np.testing.assert_allclose(ratios[1] / ratios[0], 4, rtol=1e-5)
        law = thinning_error(jnp.asarray(8.0), one, ratios[1], contrast)
        np.testing.assert_allclose(law, error * np.sqrt(1 - ratios[1]), rtol=1e-5)
    assert float(splats_that_suffice(jnp.asarray(8.0), one, jnp.asarray(1e-6), contrast)) == 1


@pytest.mark.once
def test_even_light_has_no_contrast_and_a_checkered_one_has_all():
    sheet = bodies.sheet(10.0, 1.0)
    variance = jnp.asarray(9.0)
    np.testing.assert_allclose(
        layer_contrast(sheet, jnp.ones((sheet.count, 1)), variance), 0, atol=1e-3
    )
    checkers = jnp.sum(jnp.round(sheet.centers), axis=1, keepdims=True) % 2
    np.testing.assert_allclose(layer_contrast(sheet, checkers, variance), 1, rtol=0.02)


@pytest.mark.once
@pytest.mark.long
def test_layers_of_fewer_splats_keep_constants_and_those_of_all_are_the_plain_ones():
    body = bodies.bumpy(1200)
    material = sj.Material(sj.SumOfGaussians([4.0, 9.0], [[0.5], [0.5]]))
    scene = sj.Scene(body, (), material)
    camera = sj.Camera.look_at([0, 0, 60], [0, 0, 0], fov=25, width=16, height=16)
    diffusers = DenseDiffuser(), ThinnedDiffuser(1), ThinnedDiffuser(7)
    settings = [sj.RenderSettings(diffuser=each, kernel=PlainMean()) for each in diffusers]
    light = 0.5 + 0.5 * body.normals[:, :1]

    def layers(light, settings):
        return np.asarray(sj.diffuse_irradiance(scene, light, camera, settings))

    exact, same, thinned = (layers(light, each) for each in settings)
    np.testing.assert_allclose(same, exact, atol=1e-6)
    there = exact > 0
    assert 0.001 < np.sqrt(np.mean((thinned - exact)[there] ** 2)) < 0.1
    np.testing.assert_allclose(layers(jnp.ones_like(light), settings[2])[there], 1.0, rtol=1e-5)
