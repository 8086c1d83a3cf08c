"""The derivative of a fit against fits of moved coefficients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.fitting import (
    FixedTotalReflectance,
    FreeWeights,
    SharedVariances,
    VariancesPerChannel,
    fit_gaussians,
)
from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import Dipole, Layer, Medium, Multipole

# Asked of the derivative; central differences with steps of 1e-4 relative err by 1e-7.
REFITS = 1e-4

STEP = 1e-4

# The Hessian of a fit with an error of 1e-2 loses some three of float32's seven digits.
IN_FLOAT32 = 1e-3

# Logarithms of sigma_a, sigma_s' and eta of marble's red and blue.
POINT = np.log([0.0021, 0.0071, 2.19, 3.0, 1.5, 1.5])


def fit(point, spread, weights):
    """Logarithms of variances and weights of a fit to a dipole, from the logarithms of its
    coefficients.
    """
    sigma_a, sigma_s_prime, eta = jnp.exp(point).reshape(3, 2)
    fitted = fit_gaussians(
        Dipole(Medium(sigma_a, sigma_s_prime, eta)), 3, spread=spread, weights=weights
    )
    gaussians = fitted.gaussians
    return jnp.concatenate(
        [jnp.log(gaussians.variances).ravel(), jnp.log(gaussians.weights).ravel(), fitted.error]
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spread", "weights"),
    [(SharedVariances(), FixedTotalReflectance()), (VariancesPerChannel(), FreeWeights())],
)
def test_derivative_of_a_fit_is_that_of_refits(float64, spread, weights):
    run = eqx.filter_jit(fit)
    forward = eqx.filter_jit(jax.jacfwd(fit))(POINT, spread, weights)
    differences = [
        (run(POINT + h, spread, weights) - run(POINT - h, spread, weights)) / (2 * STEP)
        for h in STEP * np.eye(6)
    ]
    assert np.max(np.abs(forward)) > 0.5
    np.testing.assert_allclose(forward, np.stack(differences, axis=1), rtol=REFITS, atol=REFITS)


def test_reverse_mode_through_a_slab_gives_the_derivative_of_refits(float64):
    """In absorption, scattering, index and thickness."""

    @jax.jit
    def run(point):
        *coefficients, thickness = jnp.exp(point)
        slab = Multipole(Layer(Medium(*coefficients), thickness))
        gaussians = fit_gaussians(slab, 3, weights=FixedTotalReflectance(), throw=False).gaussians
        return jnp.sum(jnp.sin(jnp.log(gaussians.variances))) + jnp.sum(
            gaussians.weights[:, 0] * jnp.arange(1.0, 4.0)
        )

    point = jnp.log(jnp.asarray([0.01, 2.5, 1.4, 2.0]))
    reverse = jax.jit(jax.grad(run))(point)
    differences = [(run(point + h) - run(point - h)) / (2 * STEP) for h in STEP * np.eye(4)]
    assert np.min(np.abs(reverse)) > 1e-2
    np.testing.assert_allclose(reverse, differences, rtol=REFITS, atol=REFITS)


@pytest.mark.slow
def test_without_absorption_the_derivative_is_finite_and_the_limit(float64):
    """Of a free fit: its profile has a derivative there, other than its total."""

    def widest(sigma_a):
        medium = Medium(sigma_a, 1.0, 1.3)
        return fit_gaussians(Dipole(medium), 2, throw=False).gaussians.variances[-1]

    slope = jax.jit(jax.grad(widest))
    at_zero, *near = (float(slope(jnp.asarray(x))) for x in (0.0, 1e-8, 4e-8))
    np.testing.assert_allclose(at_zero, 2 * near[0] - near[1], rtol=1e-3)
    assert at_zero < 0


@pytest.mark.slow
def test_where_the_fit_is_perfect_the_derivative_is_the_identity(float64):
    weights = jnp.asarray([[0.3], [0.2]])

    def again(log_variances):
        return jnp.log(
            fit_gaussians(SumOfGaussians(jnp.exp(log_variances), weights), 2).gaussians.variances
        )

    point = jnp.log(jnp.asarray([0.1, 2.0]))
    np.testing.assert_allclose(jax.jit(jax.jacfwd(again))(point), np.eye(2), atol=1e-6)


@pytest.mark.slow
def test_float32_gives_the_same_derivatives(float64):
    def narrowest(sigma_a, dtype):
        medium = Medium(sigma_a[None], 1.0, 1.3)
        return fit_gaussians(Dipole(medium), 3).gaussians.variances[0]

    slopes = [
        jax.grad(narrowest)(jnp.asarray(0.05, dtype), dtype) for dtype in (jnp.float32, jnp.float64)
    ]
    assert slopes[0].dtype == jnp.float32
    np.testing.assert_allclose(*slopes, rtol=IN_FLOAT32)
