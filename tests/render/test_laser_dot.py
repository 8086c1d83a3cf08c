"""A laser dot on a material, photographed: its coefficients come back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import camera_over, sheet

import splatjax as sj
from splatjax.diffusion import ClusterDiffuser
from splatjax.fitting import fit_medium
from splatjax.scattering import measure_laser_dot

POWER = 3.0
BEAM = 1.0
HALF_WIDTH = 9.0
PIXELS = 144
COUNT = 3
FINE = sj.RenderSettings(diffuser=ClusterDiffuser(error=2e-4))
"""A photograph has no error of ours; the error bars here are a thousandth of a coefficient."""
NOISE = 1e-2
"""Of a pixel, in shares of the peak, beside shot noise of the same size at the peak."""


def photograph(medium: sj.Medium) -> np.ndarray:
    """The radiance of the dot from straight above, as splatjax renders it, with noise."""
    gaussians = sj.fit_gaussians(sj.Dipole(medium), COUNT).gaussians
    channels = len(medium.eta)
    beam = sj.GaussianBeam(
        jnp.asarray([0.0, 0.0, 10.0]),
        jnp.asarray([0.0, 0.0, -1.0]),
        jnp.full(channels, POWER),
        jnp.asarray(BEAM),
    )
    scene = sj.Scene(sheet(24.0, 0.25), (beam,), sj.Material(gaussians, specular=0.0))
    image = np.asarray(sj.render(scene, camera_over(HALF_WIDTH, PIXELS), FINE).diffuse, np.float64)
    noise = np.random.default_rng(0).normal(size=image.shape)
    peak = image.max(axis=(0, 1))
    return image + NOISE * noise * np.sqrt(peak * (peak + image))


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.long
def test_a_rendered_dot_gives_the_coefficients_back_within_their_error_bars():
    with jax.enable_x64(True):
        medium = sj.Medium(jnp.asarray([0.02]), jnp.asarray([1.2]), jnp.asarray([1.4]))
        image = photograph(medium)
        dot = measure_laser_dot(image, 2 * HALF_WIDTH / PIXELS, power=POWER)
        start = sj.Medium(medium.sigma_a * 3, medium.sigma_s_prime / 2, medium.eta)
        found = fit_medium(dot.profile, start, beam_variance=BEAM, count=COUNT)
    errors = np.sqrt(np.diagonal(np.asarray(found.covariance), axis1=1, axis2=2))
    truth, back = (np.stack([m.sigma_a, m.sigma_s_prime], axis=1) for m in (medium, found.medium))
    away = np.log(back / truth) / errors
    print("relative errors", errors, "away, in these", away, "chi squared", found.chi_squared)
    assert np.all(errors < 0.05)
    assert np.all(np.abs(away) < 3)
    np.testing.assert_allclose(found.chi_squared, 1, atol=0.6)
    np.testing.assert_allclose(dot.center, PIXELS / 2, atol=0.1)
