"""Layers that are summed at the splats: the picture of separate layers, its gradient, refusals."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import (
    PLAIN,
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

pytestmark = pytest.mark.once

SUMMED = dataclasses.replace(PLAIN, diffuser=ExitanceDiffuser(DenseDiffuser()))
ERROR = 1e-2  # of the largest value: the gain is blended instead of the mass that it depends on


def scene(body: sj.Splats) -> sj.Scene:
    material = sj.Material(two_gaussians())
    channels = material.channels
    albedo = 0.6 + 0.3 * np.sin(np.asarray(body.centers[:, :1]) + np.arange(channels))
    lights = [
        dataclasses.replace(light, irradiance=jnp.linspace(1.0, 2.0, channels))
        for light in lights_from_two_sides()
    ]
    return sj.Scene(with_albedo(body, albedo), lights, material)


def test_without_gain_the_picture_is_that_of_separate_layers():
    """On splats of equal areas blending and summing are linear, also of light that has bounced."""
    of = scene(sphere(300))
    separate, summed = (
        dataclasses.replace(settings, kernel=PlainMean(), bounces=1) for settings in (PLAIN, SUMMED)
    )
    expected, frame = (sj.render(of, view(), settings) for settings in (separate, summed))
    atol = 1e-5 * float(jnp.max(expected.beauty))
    np.testing.assert_allclose(frame.diffuse, expected.diffuse, atol=atol, rtol=0)
    np.testing.assert_allclose(frame.specular, expected.specular, atol=atol, rtol=0)
    np.testing.assert_allclose(frame.layers[0], frame.diffuse, atol=atol, rtol=0)


def test_with_gain_the_picture_is_that_of_separate_layers_within_a_thin_sheet():
    """The mass is nearly twice that of one face; it is even, except for the edges of the sheet."""
    faces = (sheet(8.0, 0.5, (0.0, 0.0, way), (0.0, 0.0, 0.1 * way), 0.2) for way in (1.0, -1.0))
    light = sj.DirectionalLight([-0.6, 0.1, -1.0], [2.0, 1.0, 1.0], cast_shadows=False)
    of = dataclasses.replace(scene(joined(*faces)), lights=light)
    plain = dataclasses.replace(PLAIN, kernel=PlainMean())
    expected, frame, without = (
        np.asarray(sj.render(of, camera_over(4.0, 16), settings).diffuse)
        for settings in (PLAIN, SUMMED, plain)
    )
    error, gain = (np.abs(other - expected).max() for other in (frame, without))
    assert error < ERROR * expected.max() < 0.1 * gain


def test_it_has_its_derivatives(float64):
    of = scene(sphere(100))
    plan = sj.make_plan(of, view(size=8), SUMMED)

    def beauty(centers, albedo, weights, variances):
        splats = dataclasses.replace(of.splats, centers=centers, albedo=albedo)
        material = sj.Material(sj.SumOfGaussians(variances, weights))
        return sj.render(sj.Scene(splats, of.lights, material), view(size=8), SUMMED, plan).beauty

    gaussians = of.material.gaussians
    given = of.splats.centers, of.splats.albedo, gaussians.weights, gaussians.variances
    check_grads(jax.jit(beauty), given, 1, ["rev"], atol=1e-5, rtol=1e-5, eps=1e-6)


def test_layers_of_their_own_are_refused():
    of = scene(sphere(100))
    plan = sj.make_plan(of, view(), SUMMED)
    for render in (sj.diffusion_basis, sj.picture_jacobian):
        with pytest.raises(ValueError, match="DenseDiffuser"):
            render(of, view(), SUMMED, plan)
    with pytest.raises(ValueError, match="ExitanceDiffuser has no separate layers"):
        sj.diffuse_irradiance(of, jnp.ones((100, 3)), view(), SUMMED, plan)
    for diffuser in (ShapeDiffuser(), ExitanceDiffuser()):
        with pytest.raises(ValueError, match=rf"layers is a {type(diffuser).__name__}"):
            ExitanceDiffuser(diffuser)
