"""Weights that vary over the body: the picture of a material, reciprocity, energy, refusals."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from bodies import PLAIN, camera_over, lights_from_two_sides, sheet, sphere, two_gaussians, view

import splatjax as sj
from splatjax.diffusion import PlainMean, ShapeDiffuser

pytestmark = pytest.mark.once

SAME = 1e-6  # a picture of the same sums, in float32
ALIKE = 1e-3  # pixels blend splats around them
HALF, SIDE = 8, 16  # mm and pixels: a splat in the middle of each pixel
FLAT = dataclasses.replace(PLAIN, kernel=PlainMean())
WHITE = sj.Material(sj.SumOfGaussians([0.5, 3.0], [[0.6] * 2, [0.4] * 2]), 1.0, 0.0)
FACTORS = np.random.default_rng(2).uniform(0.1, 1.0, (2, 2))


def with_factors(body: sj.Splats, factors) -> sj.Splats:
    return dataclasses.replace(
        body, weights=jnp.broadcast_to(factors, (body.count, *np.shape(factors)[-2:]))
    )


def test_even_factors_make_the_picture_of_a_material():
    """And of light that has bounced."""
    body, factors = sphere(200), np.random.default_rng(5).uniform(0.1, 1.0, (2, 3))
    gaussians = two_gaussians()
    material = sj.Material(gaussians)
    scaled = sj.Material(sj.SumOfGaussians(gaussians.variances, gaussians.weights * factors))
    lights = [sj.DirectionalLight([-1.0, -0.4, -0.3], [2.0, 3.0, 1.0], cast_shadows=False)]
    settings = dataclasses.replace(PLAIN, bounces=1)
    varied, plain = (
        np.asarray(sj.render(sj.Scene(splats, lights, of), view(), settings).beauty)
        for splats, of in ((with_factors(body, factors), material), (body, scaled))
    )
    np.testing.assert_allclose(varied, plain, atol=SAME * plain.max(), rtol=0)


def exitance(material: sj.Material, splats: sj.Splats, source: int) -> np.ndarray:
    """Light one splat; return the radiant exitance at every splat that is seen, row by row."""
    irradiance = jnp.zeros((splats.count, 2)).at[source].set(1.0)
    scene = sj.Scene(splats, (), material)
    layers = sj.diffuse_irradiance(scene, irradiance, camera_over(HALF, SIDE), FLAT)
    return np.einsum("kc,khwc->hwc", material.gaussians.weights, layers)


def test_light_goes_both_ways_alike_between_stripes_and_none_is_added():
    """Where a kernel weighs light at its exit alone, both fail."""
    body = sheet(14.5, 1.0)
    is_first = (body.centers[:, 0] < 0)[:, None, None]
    splats = dataclasses.replace(
        body, weights=jnp.where(is_first, jnp.asarray(FACTORS), jnp.asarray(FACTORS[::-1]))
    )
    places = [(7, 5), (7, 9)]  # row and column: 2.5 and 1.5 mm from the seam
    at = [
        np.argmin(np.sum((np.asarray(body.centers) - np.asarray([c - 7.5, 7.5 - r, 0])) ** 2, 1))
        for r, c in places
    ]
    there, back = (exitance(WHITE, splats, i) for i in at)
    np.testing.assert_allclose(there[places[1]], back[places[0]], rtol=ALIKE)
    # Narrow light here and wide light there.
    parted = jnp.where(
        is_first, jnp.asarray([[1.0] * 2, [0] * 2]), jnp.asarray([[0.0] * 2, [1] * 2])
    )
    for i in at:
        assert np.all(exitance(WHITE, dataclasses.replace(body, weights=parted), i).sum((0, 1)) < 1)


def test_what_cannot_be_combined_is_refused():
    body, light = sphere(90, 4.0, jitter=0.0), lights_from_two_sides()
    medium = sj.Medium([0.02, 0.05], [0.9, 1.2], 1.3)
    material = dataclasses.replace(WHITE, medium=medium)
    solved = dataclasses.replace(PLAIN, diffuser=ShapeDiffuser())
    single = dataclasses.replace(WHITE, single_scattering=sj.SingleScattering(medium))
    for factors, given, settings, words in (
        (np.ones((3, 2)), WHITE, PLAIN, "splats.weights.*3 Gaussians.*2"),
        (np.ones((2, 3)), WHITE, PLAIN, "splats.weights has 3 channels"),
        (np.ones((2, 2)), single, PLAIN, "single scattering.*splats.weights"),
        (np.ones((2, 2)), material, solved, "splats.weights.*ShapeDiffuser"),
    ):
        with pytest.raises(ValueError, match=words):
            sj.render(sj.Scene(with_factors(body, factors), light, given), view(), settings)
    with pytest.raises(ValueError, match=r"Splats.weights must be.*-1"):
        with_factors(body, -np.ones((2, 2)))
