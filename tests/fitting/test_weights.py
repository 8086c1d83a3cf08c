"""Weights for given variances: against solvers of others, by hand and by trying all subsets; those
of a fit, and of layers that serve many media.
"""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import nnls

import splatjax as sj
from splatjax.fitting import FixedTotalReflectance, FreeWeights, NonNegativeWeights, fit_gaussians
from splatjax.inverse import wide_variances
from splatjax.io import load_medium
from splatjax.scattering import Dipole, EganFresnel, Medium

SOLVED = 1e-9


def problem(seed: int):
    """Columns of unit length that overlap, and a target that no mixture of them reaches."""
    noise = np.random.default_rng(seed)
    x = np.linspace(-2, 2, 40)[:, None]
    basis = np.exp(-((x - np.linspace(-1.5, 1.5, 6)) ** 2))
    basis /= np.linalg.norm(basis, axis=0)
    target = noise.normal(size=40)
    return basis, target / np.linalg.norm(target), noise.uniform(0.5, 2, 6), 1.3


def solve(weights, basis, target, energies, total):
    coefficients, _ = weights.solve(
        *(jnp.asarray(each) for each in (basis, target, energies)), jnp.asarray(total)
    )
    return np.asarray(coefficients)


@pytest.mark.parametrize("seed", range(8))
def test_non_negative_weights_are_those_of_lawson_and_hanson(float64, seed):
    basis, target, energies, total = problem(seed)
    found = solve(NonNegativeWeights(), basis, target, energies, total)
    np.testing.assert_allclose(found, nnls(basis, target)[0], atol=SOLVED)
    assert np.all(found >= 0)
    assert np.any(solve(FreeWeights(), basis, target, energies, total) < 0)


@pytest.mark.parametrize("seed", range(4))
def test_non_negative_weights_of_a_held_sum_are_the_best_of_all_subsets(float64, seed):
    basis, target, energies, total = problem(seed)
    best = np.inf
    for size in range(1, 7):
        for subset in map(list, combinations(range(6), size)):
            # Lagrange's equations of the equality alone.
            gram = basis[:, subset].T @ basis[:, subset]
            edge = energies[subset]
            system = np.block([[gram, edge[:, None]], [edge[None], np.zeros((1, 1))]])
            weights = np.linalg.solve(system, np.append(basis[:, subset].T @ target, total))[:-1]
            if np.all(weights >= 0):
                best = min(best, np.linalg.norm(target - basis[:, subset] @ weights))
    found = solve(NonNegativeWeights(FixedTotalReflectance()), basis, target, energies, total)
    assert np.all(found >= 0)
    np.testing.assert_allclose(energies @ found, total, rtol=SOLVED)
    np.testing.assert_allclose(np.linalg.norm(target - basis @ found), best, rtol=SOLVED)


def test_a_fit_with_weights_at_zero_converges_and_has_the_derivative_of_refits(float64):
    """Ketchup's channels lie so far apart that some weights vanish."""
    medium = load_medium("ketchup")

    def fit(scale):
        moved = Medium(medium.sigma_a * scale, medium.sigma_s_prime, medium.eta)
        return fit_gaussians(
            Dipole(moved, EganFresnel()), 3, weights=NonNegativeWeights(), throw=False
        )

    @jax.jit
    def fit_and_slope(scale):
        fitted, slope = jax.jvp(fit, (scale,), (jnp.ones_like(scale),))
        return fitted.gaussians, slope.gaussians.variances, fitted.result == optx.RESULTS.successful

    gaussians, slope, converged = fit_and_slope(jnp.asarray(1.0))
    assert bool(converged)
    assert np.all(gaussians.weights >= 0)
    assert np.sum(np.asarray(gaussians.weights) == 0) >= 1
    step = 1e-4
    there, back = (fit_and_slope(jnp.asarray(1 + h))[0].variances for h in (step, -step))
    np.testing.assert_allclose(slope, (there - back) / (2 * step), rtol=1e-4)


HELD = NonNegativeWeights(FixedTotalReflectance())


def test_with_the_variances_of_a_fit_they_are_its_weights(float64):
    """Of a material that comes with the package: with as many digits as its file has."""
    fitted = sj.load_material("marble").gaussians
    found = sj.fitting.fit_weights(sj.load_profile("marble"), fitted.variances, weights=HELD)
    np.testing.assert_allclose(found.weights, fitted.weights, atol=1e-7)
    np.testing.assert_array_equal(found.variances, fitted.variances)


def test_wide_variances_serve_all_media_near(float64):
    """Within a factor of three of the start in both coefficients."""
    near = sj.Medium([0.02, 0.2], [1.0, 0.7], 1.3)
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
