"""Weights for variances that are given: those of a fit, and of layers that serve many media."""

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.inverse import wide_variances

HELD = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())


def medium(sigma_a=(0.02, 0.2), sigma_s_prime=(1.0, 0.7)):
    return sj.Medium(
        jnp.asarray(sigma_a, float), jnp.asarray(sigma_s_prime, float), jnp.full(2, 1.3)
    )


def test_with_the_variances_of_a_fit_they_are_its_weights(float64):
    """Of a material that comes with the package: with as many digits as its file has."""
    fitted = sj.load_material("marble").gaussians
    found = sj.fitting.fit_weights(sj.load_profile("marble"), fitted.variances, weights=HELD)
    np.testing.assert_allclose(found.weights, fitted.weights, atol=1e-7)
    np.testing.assert_array_equal(found.variances, fitted.variances)


def test_wide_variances_serve_all_media_near(float64):
    """Within a factor of three of the start in both coefficients."""
    near = medium()
    variances = wide_variances(
        [near], sj.Splats(jnp.asarray(np.eye(3) * 1e4), jnp.eye(3), jnp.ones(3), jnp.ones(3))
    )
    assert len(variances) < 20

    @jax.jit
    def error(sigma_a, sigma_s_prime):
        profile = sj.Dipole(sj.Medium(sigma_a, sigma_s_prime, near.eta))
        found = sj.fitting.fit_weights(profile, variances, weights=HELD)
        return sj.fitting.relative_error(
            profile, found
        ), found.total_reflectance() / profile.total_reflectance() - 1

    for a in (1 / 3, 1, 3):
        for s in (1 / 3, 1, 3):
            errors, energy = error(near.sigma_a * a, near.sigma_s_prime * s)
            assert np.max(errors) < 0.004
            assert np.max(np.abs(energy)) < 1e-12


def test_they_have_derivatives_in_the_coefficients(float64):
    variances = jnp.asarray([0.05, 0.3, 2.0, 15.0])

    @jax.jit
    def weights(point):
        profile = sj.Dipole(sj.Medium(jnp.exp(point[:2]), jnp.exp(point[2:]), jnp.full(2, 1.3)))
        return sj.fitting.fit_weights(profile, variances, weights=HELD).weights

    point, way, step = (
        jnp.log(jnp.asarray([0.02, 0.2, 1.0, 0.7])),
        jnp.asarray([0.7, -0.4, 0.5, 1.0]),
        1e-5,
    )
    _, slope = jax.jvp(weights, (point,), (way,))
    difference = (weights(point + step * way) - weights(point - step * way)) / (2 * step)
    # Nodes of the integrals are constants of the derivative, and they move with the medium: an
    # integral has none.
    np.testing.assert_allclose(slope, difference, atol=1e-6 * float(jnp.max(jnp.abs(slope))))
    assert float(jnp.max(jnp.abs(slope))) > 0.01
