"""The law that ties the halves together: a narrow beam on a flat sheet renders to the sum of
Gaussians; and the photograph of a laser dot gives the coefficients back.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from bodies import camera_over, hits, sheet

import splatjax as sj

EXACT = sj.RenderSettings(diffuser=sj.diffusion.ClusterDiffuser(error=0.0))
SLANTS = (0.0, 50.0)
BEAM_TOLERANCE = 0.01
WIDE_TOLERANCE = 0.045  # with clusters; 0.038 measured, where the light is a hundredth


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.parametrize(
    "variance", [1.99, *(pytest.param(v, marks=pytest.mark.long) for v in (0.0064, 31.5))]
)
def test_a_beam_on_a_sheet_is_the_gaussian_in_the_picture(variance):
    deviation = variance**0.5
    material = sj.Material(sj.SumOfGaussians([variance], [[1.0]]))
    # Four splats per standard deviation.
    scene = sj.Scene(sheet(8 * deviation, deviation / 4), (), material)
    cameras = [camera_over(4 * deviation, 48, each) for each in SLANTS]
    plan = sj.make_plan(scene, cameras, EXACT)
    middle = jnp.argmin(jnp.sum(scene.splats.centers**2, axis=1))
    beam = jnp.zeros((scene.splats.count, 1)).at[middle].set(1 / scene.splats.areas[middle])
    for camera in cameras:
        layer = sj.diffuse_irradiance(scene, beam, camera, EXACT, plan)[0, ..., 0]
        squared = np.sum(hits(camera)[..., :2] ** 2, axis=-1)
        truth = np.exp(-squared / (2 * variance)) / (2 * np.pi * variance)
        seen = truth > 1e-3 * truth.max()  # there is light of note
        assert seen.sum() > 500
        np.testing.assert_allclose(layer[seen], truth[seen], rtol=BEAM_TOLERANCE)


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.long
@pytest.mark.parametrize("name", ["skin", "marble"])
def test_a_wide_beam_with_default_settings_is_the_widened_profile(name):
    splats = sheet(30.06, 0.18)  # wide enough for marble's widest layer
    light = sj.GaussianBeam([0, 0, 10], [0, 0, -1], [1, 1, 1], 1)
    material = replace(sj.load_material(name), specular=0.0)
    scene, camera = sj.Scene(splats, light, material), camera_over(9.0, 144)
    exitance = np.pi * np.asarray(sj.render(scene, camera).diffuse)
    squared = np.sum(hits(camera)[..., :2] ** 2, axis=-1)
    widened = sj.SumOfGaussians(material.gaussians.variances + 1.0, material.gaussians.weights)
    truth = np.asarray(widened(jnp.asarray(np.sqrt(squared), float)))
    seen = truth > 1e-2 * truth.max(axis=(0, 1))
    assert np.max(np.abs(exitance / truth - 1)[seen]) < WIDE_TOLERANCE


POWER = 3.0
BEAM = 1.0
HALF_WIDTH = 9.0
PIXELS = 144
COUNT = 3
# A photograph has no error of ours; the error bars here are a thousandth of a coefficient.
FINE = sj.RenderSettings(diffuser=sj.diffusion.ClusterDiffuser(error=2e-4))
# Of a pixel, in shares of the peak, beside shot noise of the same size at the peak.
NOISE = 1e-2


def photograph(medium: sj.Medium) -> np.ndarray:
    gaussians = sj.fit_gaussians(sj.Dipole(medium), COUNT).gaussians
    beam = sj.GaussianBeam([0, 0, 10], [0, 0, -1], POWER, BEAM)
    scene = sj.Scene(sheet(24.0, 0.25), beam, sj.Material(gaussians, eta=1.0, specular=0.0))
    image = np.asarray(sj.render(scene, camera_over(HALF_WIDTH, PIXELS), FINE).diffuse, np.float64)
    noise = np.random.default_rng(0).normal(size=image.shape)
    peak = image.max(axis=(0, 1))
    return image + NOISE * noise * np.sqrt(peak * (peak + image))


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.long
@pytest.mark.usefixtures("double")
def test_a_rendered_dot_gives_the_coefficients_back_within_their_error_bars():
    medium = sj.Medium([0.02], [1.2], [1.4])
    dot = sj.scattering.measure_laser_dot(photograph(medium), 2 * HALF_WIDTH / PIXELS, power=POWER)
    start = sj.Medium(medium.sigma_a * 3, medium.sigma_s_prime / 2, medium.eta)
    found = sj.fitting.fit_medium(dot.profile, start, beam_variance=BEAM, count=COUNT)
    errors = np.sqrt(np.diagonal(np.asarray(found.covariance), axis1=1, axis2=2))
    truth, back = (np.stack([m.sigma_a, m.sigma_s_prime], axis=1) for m in (medium, found.medium))
    away = np.log(back / truth) / errors
    assert np.all(errors < 0.05), errors
    assert np.all(np.abs(away) < 3), away
    np.testing.assert_allclose(found.chi_squared, 1, atol=0.6)
    np.testing.assert_allclose(dot.center, PIXELS / 2, atol=0.1)
