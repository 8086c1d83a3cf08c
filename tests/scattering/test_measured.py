"""Profiles that were measured: from a table, and from a photograph."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import assert_close, assert_refused

import splatjax as sj
from splatjax.scattering import (
    L2_QUADRATURE,
    InverseVariance,
    Tabulated,
    integrated_reflectance,
    measure_laser_dot,
)

TRUTH = sj.SumOfGaussians([0.3, 2.0], [[0.3, 0.2], [0.4, 0.1]])
NEAR = sj.fitting.GivenVariances([0.4, 1.7])
MM_PER_PIXEL = 0.1


def photograph(
    pixels: int = 121, noise: float = 0.0, power: float = 2.0, center=(60.2, 61.3)
) -> np.ndarray:
    y, x = np.mgrid[:pixels, :pixels] + 0.5
    radius = MM_PER_PIXEL * np.hypot(x - center[0], y - center[1])
    image = power * np.asarray(TRUTH(jnp.asarray(radius)), float) / np.pi
    return image + noise * image.max() * np.random.default_rng(3).normal(size=image.shape)


def test_integrals_of_a_table_are_sums_over_its_radii(float64):
    r = jnp.linspace(0.1, 6.0, 300)
    table = Tabulated(r, TRUTH(r))
    np.testing.assert_allclose(integrated_reflectance(table), table.total_reflectance(), rtol=1e-3)
    radii, weights = L2_QUADRATURE.beyond(1.0).radii(table)
    np.testing.assert_array_equal(weights > 0, radii >= table.length_scale()[None])


def test_half_of_a_table_lies_within_its_length_scale(float64):
    """The first r^2 of 2 exp(-r^2) hold a share of 1 - exp(-r^2), however the radii are spaced."""
    r = np.linspace(0.02, 2.2, 700) ** 2
    table = Tabulated(r, np.stack([2 * np.exp(-(r**2)), -np.exp(-(r**2) / 9)], axis=1))
    # Of the second, which falls three times as far out, 7% lie beyond the last radius.
    expected = [np.sqrt(np.log(2.0)), 3 * np.sqrt(-np.log((1 + np.exp(-(r[-1] ** 2) / 9)) / 2))]
    np.testing.assert_allclose(table.length_scale(), expected, rtol=5e-3)


def test_a_fit_weighed_by_its_errors_is_the_likeliest(float64):
    """Noise of very different sizes: the scatter of repetitions is as stated, and less than by the
    integral's weights.
    """
    r = jnp.linspace(0.05, 5.0, 80)
    clean = np.asarray(TRUTH(r))[:, :1]
    deviation = 0.03 * clean + 1e-5
    values = clean + deviation * np.random.default_rng(1).normal(size=(200, 80, 1))

    def fit(values, rule):
        table = Tabulated(r, values, deviation)
        return sj.fit_gaussians(table, 2, rule=rule, start=NEAR, throw=False)

    fits = eqx.filter_jit(eqx.filter_vmap(fit, in_axes=(0, None)))
    found, plain = fits(values, InverseVariance()), fits(values, L2_QUADRATURE)
    gaussians, stated = found.gaussians, np.median(found.covariance, axis=0) / (80 - 4)
    parameters = np.concatenate([gaussians.variances, gaussians.weights[..., 0]], axis=1)
    np.testing.assert_allclose(np.cov(parameters.T), stated, rtol=0.3, atol=1e-6)
    chi_squared = found.error[:, 0] ** 2 * np.sum((values / deviation) ** 2, axis=(1, 2))
    assert abs(np.mean(chi_squared) - (80 - 4)) < 3
    assert np.std(found.gaussians.weights[:, 1, 0]) < 0.7 * np.std(plain.gaussians.weights[:, 1, 0])


def test_weighing_needs_errors(float64):
    r = jnp.linspace(0.05, 5.0, 30)
    for profile in (Tabulated(r, TRUTH(r)), TRUTH):
        assert_refused(
            partial(sj.fit_gaussians, profile, 2, rule=InverseVariance()),
            f"{type(profile).__name__} has no standard errors",
        )
    # Radii that nothing was counted at say nothing.
    table = Tabulated(r, TRUTH(r)[:, 0], jnp.where(r < 4, 1e-3, 0.0))
    radii, weights = InverseVariance().radii(table)
    expected = np.where(r < 4, 1e6, 0.0)[:, None]
    np.testing.assert_allclose(weights * radii, expected, rtol=1e-12)


def test_a_table_is_fitted_over_its_own_radii_and_a_total_that_is_known_is_held(float64):
    """A table that ends early does not contain the tail: the Gaussians behind it come back all the
    same.
    """
    r, total = jnp.linspace(0.05, 2.0, 60), TRUTH.total_reflectance()
    assert Tabulated(r, TRUTH(r)).total_reflectance()[0] < 0.85 * total[0]
    table = Tabulated(r, TRUTH(r), total=total)
    fitted = sj.fit_gaussians(table, 2, weights=sj.fitting.FixedTotalReflectance(), start=NEAR)
    assert_close(fitted.gaussians, TRUTH, rtol=1e-6)


def test_a_photograph_gives_the_profile_and_its_noise(float64):
    dot = measure_laser_dot(photograph(noise=0.01), MM_PER_PIXEL, power=2.0)
    np.testing.assert_allclose(dot.center, [60.2, 61.3], atol=0.1)
    away = (dot.profile.values - TRUTH(dot.profile.radii)) / dot.profile.deviation
    assert np.max(np.abs(away)) < 4.5
    np.testing.assert_allclose(np.std(away), 1, atol=0.25)


def test_power_and_pixel_scale_what_a_photograph_gives(float64):
    one = measure_laser_dot(photograph(), MM_PER_PIXEL, power=2.0).profile
    other = measure_laser_dot(photograph(), 2 * MM_PER_PIXEL, power=4.0).profile
    expected = 2 * one.radii, one.values / 2
    assert_close((other.radii, other.values), expected, rtol=1e-12)


def test_a_gray_picture_has_one_channel(float64):
    gray, colored = photograph()[..., 0], photograph()[..., :1]
    dots = [measure_laser_dot(image, MM_PER_PIXEL, power=2.0) for image in (gray, colored)]
    assert_close(*dots)


@pytest.mark.once
@pytest.mark.parametrize("center", [(20.5, 61.0), (60.0, 14.5), (98.0, 60.5), (61.5, 103.0)])
def test_rings_end_at_the_nearest_edge(center):
    nearest = MM_PER_PIXEL * min(*center, 121 - center[0], 121 - center[1])
    given = {"image": photograph(center=center), "power": 2.0, "center": center}
    for end, more in ((nearest, {}), (1.0, {"largest": 1.0})):
        profile = measure_laser_dot(mm_per_pixel=MM_PER_PIXEL, **given, **more).profile
        assert end - 1.5 * MM_PER_PIXEL < float(profile.radii[-1]) < end
        np.testing.assert_allclose(profile.values, TRUTH(profile.radii), rtol=0.02, atol=1e-4)


def test_a_ring_is_where_its_pixels_are_on_average(float64):
    """What falls as the square of the distance from the center is found at every radius as it is,
    however wide the rings.
    """
    y, x = np.mgrid[:40, :40] + 0.5
    image = 9 - MM_PER_PIXEL**2 * ((x - 17.3) ** 2 + (y - 20.6) ** 2)[..., None]
    given = {"power": np.pi, "center": (17.3, 20.6)}
    for step in (1.0, 2.5):
        profile = measure_laser_dot(image, MM_PER_PIXEL, **given, step=step).profile
        np.testing.assert_allclose(profile.values[:, 0], 9 - profile.radii**2, rtol=1e-12)


def test_saturated_rings_are_left_out(float64):
    limit = 0.5 * photograph().max()
    image = np.minimum(photograph(), limit)
    found = measure_laser_dot(image, MM_PER_PIXEL, power=2.0, saturation=limit).profile
    np.testing.assert_allclose(found.values, TRUTH(found.radii), rtol=0.03)
    assert float(jnp.max(found.values)) < np.pi * limit / 2


@pytest.mark.once
@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"mm_per_pixel": 0.0}, "mm_per_pixel must be positive"),
        ({"power": -1.0}, "power must be positive"),
        ({"power": np.asarray([2.0, -1.0])}, "power must be positive"),
        ({"largest": -1.0}, "largest must be positive"),
        ({"image": np.zeros((9, 9, 1))}, "brightest pixel of image must be positive"),
        ({"step": 0.5}, "step must be at least 1 pixel"),
        (
            {"saturation": 0.0},
            r"rings, of \d+, that are not saturated must be at least 2.*got 0",
        ),
        ({"center": (-3.0, 4.0)}, "center -3, 4 is outside of the picture of 121 x 121 pixels"),
        ({"image": np.full((3, 3, 1), np.nan)}, "image must be finite"),
    ],
)
def test_bad_arguments_of_a_measurement_are_refused(change, complaint):
    arguments = {"image": photograph(), "mm_per_pixel": MM_PER_PIXEL, "power": 1.0}
    assert_refused(lambda: measure_laser_dot(**(arguments | change)), complaint)
