"""Weights that vary over the body, and layers that are summed at the splats: the picture of a
material of separate layers, reciprocity, energy, gradients, refusals.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import (
    PLAIN,
    assert_close,
    assert_refused,
    camera_over,
    joined,
    lights_from_two_sides,
    sheet,
    sphere,
    two_gaussians,
    view,
    with_albedo,
)
from jax.test_util import check_grads

import splatjax as sj
from splatjax.diffusion import DenseDiffuser, ExitanceDiffuser, PlainMean, ShapeDiffuser

SAME = 1e-6  # a picture of the same sums, in float32
ALIKE = 1e-3  # pixels blend splats around them
HALF, SIDE = 8, 16  # mm and pixels: a splat in the middle of each pixel
FLAT, BOUNCE = replace(PLAIN, kernel=PlainMean()), replace(PLAIN, bounces=1)
WHITE = sj.Material(sj.SumOfGaussians([0.5, 3.0], [[0.6] * 2, [0.4] * 2]), 1.0, 0.0)
FACTORS = np.random.default_rng(2).uniform(0.1, 1.0, (2, 2))


def with_factors(body: sj.Splats, factors) -> sj.Splats:
    return replace(body, weights=jnp.broadcast_to(factors, (body.count, *np.shape(factors)[-2:])))


def test_even_factors_make_the_picture_of_a_material():
    """And of light that has bounced."""
    body, factors = sphere(200), np.random.default_rng(5).uniform(0.1, 1.0, (2, 3))
    gaussians = two_gaussians()
    scaled = sj.SumOfGaussians(gaussians.variances, gaussians.weights * factors)
    light = sj.DirectionalLight([-1.0, -0.4, -0.3], [2.0, 3.0, 1.0], cast_shadows=False)
    varied, plain = (
        np.asarray(sj.render(sj.Scene(splats, light, sj.Material(of)), view(), BOUNCE).beauty)
        for splats, of in ((with_factors(body, factors), gaussians), (body, scaled))
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
    is_first = (np.asarray(body.centers)[:, 0] < 0)[:, None, None]
    splats = replace(body, weights=np.where(is_first, FACTORS, FACTORS[::-1]))
    places = [(7, 5), (7, 9)]  # row and column: 2.5 and 1.5 mm from the seam
    at = [
        np.argmin(np.sum((np.asarray(body.centers) - np.asarray([c - 7.5, 7.5 - r, 0])) ** 2, 1))
        for r, c in places
    ]
    there, back = (exitance(WHITE, splats, i) for i in at)
    np.testing.assert_allclose(there[places[1]], back[places[0]], rtol=ALIKE)
    # Narrow light here and wide light there.
    parted = np.where(is_first, [[1.0] * 2, [0] * 2], [[0.0] * 2, [1] * 2])
    for i in at:
        assert np.all(exitance(WHITE, replace(body, weights=parted), i).sum((0, 1)) < 1)


SUMMED = replace(PLAIN, diffuser=ExitanceDiffuser(DenseDiffuser()))
ERROR = 1e-2  # of the largest value: the gain is blended instead of the mass that it depends on


def scene(body: sj.Splats) -> sj.Scene:
    albedo = 0.6 + 0.3 * np.sin(np.asarray(body.centers[:, :1]) + np.arange(3))
    lights = [replace(light, irradiance=[1.0, 1.5, 2.0]) for light in lights_from_two_sides()]
    return sj.Scene(with_albedo(body, albedo), lights, sj.Material(two_gaussians()))


def test_without_gain_the_picture_is_that_of_separate_layers():
    """On splats of equal areas blending and summing are linear, also of light that has bounced."""
    of = scene(sphere(300))
    expected, frame = (
        sj.render(of, view(), replace(settings, kernel=PlainMean(), bounces=1))
        for settings in (PLAIN, SUMMED)
    )
    found = frame.diffuse, frame.specular, frame.layers[0]
    atol = 1e-5 * float(jnp.max(expected.beauty))
    assert_close(found, (expected.diffuse, expected.specular, frame.diffuse), atol=atol, rtol=0)


def test_with_gain_the_picture_is_that_of_separate_layers_within_a_thin_sheet():
    """The mass is nearly twice that of one face; it is even, except for the edges of the sheet."""
    faces = (sheet(8.0, 0.5, (0.0, 0.0, way), (0.0, 0.0, 0.1 * way), 0.2) for way in (1.0, -1.0))
    light = sj.DirectionalLight([-0.6, 0.1, -1.0], [2.0, 1.0, 1.0], cast_shadows=False)
    of = replace(scene(joined(*faces)), lights=light)
    expected, frame, without = (
        np.asarray(sj.render(of, camera_over(4.0, 16), settings).diffuse)
        for settings in (PLAIN, SUMMED, FLAT)
    )
    error, gain = (np.abs(other - expected).max() for other in (frame, without))
    assert error < ERROR * expected.max() < 0.1 * gain


def factored(factors, material=WHITE, settings=PLAIN):
    """Render with factors of the weights of every splat."""
    of = sj.Scene(with_factors(sphere(90, 4.0), factors), lights_from_two_sides(), material)
    return sj.render(of, view(), settings)


def of_a_sum(function, *light):
    of = scene(sphere(100))
    return function(of, *light, view(), SUMMED, sj.make_plan(of, view(), SUMMED))


MEDIUM = sj.Medium([0.02, 0.05], [0.9, 1.2], 1.3)
SINGLE = replace(WHITE, single_scattering=sj.SingleScattering(MEDIUM))
SOLVED = replace(WHITE, medium=MEDIUM), replace(PLAIN, diffuser=ShapeDiffuser())
SEEN, ONES = (view(), SOLVED[1]), np.ones((2, 2))
REFUSED = [
    (lambda: factored(np.ones((3, 2))), "splats.weights.*3 Gaussians.*2"),
    (lambda: factored(np.ones((2, 3))), "splats.weights has 3 channels"),
    (lambda: factored(ONES, SINGLE), "single scattering.*splats.weights"),
    (lambda: factored(ONES, *SOLVED), "splats.weights.*ShapeDiffuser"),
    (lambda: factored(-ONES), r"Splats.weights must be.*-1"),
    (lambda: of_a_sum(sj.diffusion_basis), "DenseDiffuser"),
    (lambda: of_a_sum(sj.picture_jacobian), "DenseDiffuser"),
    (
        lambda: sj.diffusion_basis(
            replace(
                scene(sphere(100)),
                material=sj.Material(two_gaussians(), medium=sj.Medium([0.02] * 3, 1.0, 1.3)),
            ),
            *SEEN,
        ),
        "ShapeDiffuser.*ClusterDiffuser",
    ),
    (
        lambda: of_a_sum(sj.diffuse_irradiance, jnp.ones((100, 3))),
        "ExitancePlan has no separate layers",
    ),
    (lambda: ExitanceDiffuser(ShapeDiffuser()), "layers is a ShapeDiffuser"),
    (lambda: ExitanceDiffuser(ExitanceDiffuser()), "layers is a ExitanceDiffuser"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_what_cannot_be_combined_or_separated_is_refused(call, message):
    assert_refused(call, message)


def test_summed_layers_have_their_derivatives(float64):
    of = scene(sphere(100))
    plan = sj.make_plan(of, view(size=8), SUMMED)

    def beauty(centers, albedo, weights, variances):
        splats = replace(of.splats, centers=centers, albedo=albedo)
        material = sj.Material(sj.SumOfGaussians(variances, weights))
        return sj.render(sj.Scene(splats, of.lights, material), view(size=8), SUMMED, plan).beauty

    gaussians = of.material.gaussians
    given = of.splats.centers, of.splats.albedo, gaussians.weights, gaussians.variances
    check_grads(jax.jit(beauty), given, 1, ["rev"], atol=1e-5, rtol=1e-5, eps=1e-6)
