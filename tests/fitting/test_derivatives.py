"""The derivative of a fit against fits of moved coefficients; the closed forms of variable
projection, and what follows from them. Weights for given variances: against solvers of others, by
hand and by trying all subsets; those of a fit, and of layers that serve many media.
"""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import assert_refused
from scipy.optimize import nnls

import splatjax as sj
from splatjax.fitting import (
    FixedTotalReflectance,
    FreeWeights,
    GivenVariances,
    LeastCount,
    NonNegativeWeights,
    SharedVariances,
    VariancesPerChannel,
    error_by_count,
    fit_gaussians,
    relative_error,
)
from splatjax.fitting._problem import make_problem
from splatjax.scattering import L2_QUADRATURE, Dipole, Medium

# Required of the derivative; central differences with steps of 1e-4 relative err by 1e-7.
REFITS = 1e-4

STEP = 1e-4

# The Hessian of a fit with an error of 1e-2 loses some three of float32's seven digits.
IN_FLOAT32 = 1e-3

HELD = NonNegativeWeights(FixedTotalReflectance())
MARBLE = Dipole(sj.load_medium("marble"))


def of_fit(spread, weights, start=None):
    def fit(point):
        dipole = Dipole(Medium(*jnp.exp(point).reshape(3, 2)))
        fitted = fit_gaussians(dipole, 3, spread=spread, weights=weights, start=start)
        logarithms = jnp.log(fitted.gaussians.variances).ravel()
        return jnp.concatenate([logarithms, fitted.gaussians.weights.ravel(), fitted.error])

    return fit


def of_transport(point):
    """Of the default model, whose rule starts at half a mean free path, which moves too."""
    model = sj.fitting.TransportModel()
    profile = model.profile(Medium(*jnp.exp(point).reshape(3, 2)))
    fitted = fit_gaussians(profile, 3, weights=HELD, rule=model.rule)
    logarithms = jnp.log(fitted.gaussians.variances)
    return jnp.concatenate([logarithms, fitted.gaussians.weights.ravel(), fitted.error])


def of_weights(point):
    profile = Dipole(Medium(*jnp.exp(point).reshape(3, 2)))
    variances = jnp.asarray([0.05, 0.3, 2.0, 15.0])
    return sj.fitting.fit_weights(profile, variances, weights=HELD).weights.ravel()


# Logarithms of sigma_a, sigma_s' and eta of two channels. Those of ketchup lie so far apart that
# some weights vanish.
KETCHUP = np.log([0.061, 0.97, 0.18, 0.07, 1.3, 1.3])
MARBLE_RED_AND_BLUE = np.log([0.0021, 0.0071, 2.19, 3.0, 1.5, 1.5])
REFITTED = {
    "shared": (of_fit(SharedVariances(), HELD, GivenVariances([0.3, 5, 26])), KETCHUP, jax.jacfwd),
    "per channel": (
        of_fit(VariancesPerChannel(), FreeWeights()),
        MARBLE_RED_AND_BLUE,
        jax.jacrev,
    ),
    "transport": (of_transport, np.log([0.03, 0.12, 1.5, 1.8, 1.45, 1.45]), jax.jacfwd),
    "weights": (of_weights, np.log([0.02, 0.2, 1.0, 0.7, 1.3, 1.3]), jax.jacfwd),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", REFITTED)
def test_derivative_of_a_fit_is_that_of_refits(float64, case):
    function, point, jacobian = REFITTED[case]

    @jax.jit
    def slopes_and_values(point):
        return jacobian(lambda point: (function(point),) * 2, has_aux=True)(point)

    found, values = slopes_and_values(jnp.asarray(point))
    steps = STEP * np.eye(len(point))
    there, back = ([slopes_and_values(point + h)[1] for h in sign * steps] for sign in (1, -1))
    differences = np.subtract(there, back).T / (2 * STEP)
    assert np.max(np.abs(found)) > 0.01
    np.testing.assert_allclose(found, differences, rtol=REFITS, atol=REFITS)
    if case == "shared":
        assert np.any(values == 0)
        single = slopes_and_values(jnp.asarray(point, jnp.float32))[0]
        assert single.dtype == jnp.float32
        # All but the errors.
        np.testing.assert_allclose(single[:-2], found[:-2], rtol=IN_FLOAT32)


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
        truth = sj.SumOfGaussians(jnp.exp(log_variances), weights)
        return jnp.log(fit_gaussians(truth, 2).gaussians.variances)

    slopes = jax.jit(jax.jacfwd(again))(jnp.log(jnp.asarray([0.1, 2.0])))
    np.testing.assert_allclose(slopes, np.eye(2), atol=1e-6)


EXACT = 1e-12

ALL_BUT_ONE = (True, True, True, False)


@pytest.mark.parametrize(
    ("weights", "active"),
    [(FreeWeights(), None), (FixedTotalReflectance(), ALL_BUT_ONE), (HELD, ALL_BUT_ONE)],
)
def test_the_expansion_is_that_of_automatic_differentiation(float64, weights, active):
    problem = make_problem(MARBLE, weights, L2_QUADRATURE)
    active = None if active is None else jnp.asarray(active)

    def gradient(point):
        slopes = jax.jacfwd(lambda point: jnp.sum(problem.residuals(point, active) ** 2))(point)
        return slopes, slopes

    @jax.jit
    def compute(point):
        jacobian = jax.jacfwd(lambda point: problem.residuals(point, active))(point)
        return problem.expand(point, active), jacobian, jax.jacfwd(gradient, has_aux=True)(point)

    closed, jacobian, (hessian, slopes) = compute(jnp.asarray([-3.2, -1.9, 0.1, 2.2]))
    for name, expected in (("jacobian", jacobian), ("gradient", slopes), ("hessian", hessian)):
        largest = float(np.max(np.abs(expected)))
        assert largest > 0
        np.testing.assert_allclose(getattr(closed, name), expected, atol=EXACT * largest)


def covariance(profile, weights, log_variances) -> np.ndarray:
    outcome = make_problem(profile, weights, L2_QUADRATURE).outcome
    return np.asarray(jax.jit(lambda point: outcome(point)[-1])(jnp.asarray(log_variances)))


def test_held_weights_do_not_vary_together(float64):
    weights = covariance(MARBLE, FixedTotalReflectance(), [-2.0, 1.0])[2:, 2:]
    rounding = 1e-12 * np.trace(weights)
    assert abs(weights[:2, :2].sum()) < rounding
    assert np.all(np.linalg.eigvalsh(weights) > -rounding)


def test_the_variance_of_a_gaussian_without_weight_is_anything(float64):
    one = sj.SumOfGaussians([1.0], [[0.5]])
    # Next to the truth: what the second Gaussian would add is negative.
    found = covariance(one, NonNegativeWeights(), np.log([0.9, 0.4]))
    assert np.isinf(found[1, 1])
    assert np.all(np.isfinite(np.delete(np.diag(found), 1)))


def assert_covariance_is_that_of_all_parameters(fitted):
    """By Gauss and Newton: the inverse normal matrix of the Jacobian in variances and weights,
    times the sum of squares.
    """
    problem = make_problem(MARBLE, FreeWeights(), L2_QUADRATURE)
    r = jnp.sqrt(problem.squared_radii)

    @jax.jit
    def residuals(parameters):
        gaussians = sj.SumOfGaussians(parameters[:3], parameters[3:].reshape(3, 3).T)
        values = jnp.stack([gaussians(r[channel])[:, channel] for channel in range(3)])
        return (problem.target - problem.root_weights * values / problem.norm[:, None]).ravel()

    best = np.concatenate([fitted.gaussians.variances, np.ravel(fitted.gaussians.weights.T)])
    jacobian = np.asarray(jax.jit(jax.jacfwd(residuals))(best))
    expected = np.linalg.inv(jacobian.T @ jacobian) * np.sum(np.square(residuals(best)))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(fitted.covariance / scale, expected / scale, atol=1e-8)


def test_the_least_count_that_reaches_an_error(float64):
    by_count = error_by_count(MARBLE, 4)
    worst = np.max(np.asarray(by_count.error), axis=1)
    assert np.all(np.diff(worst) < 0)
    assert by_count.least(float(worst[2])) == 3
    required = 1.01 * float(worst[2])
    fitted = fit_gaussians(MARBLE, LeastCount(required, max_count=4))
    assert np.max(fitted.error) <= required
    assert fitted.gaussians.variances.shape == (3,)
    norms = [np.linalg.norm(each) for each in (fitted.error, by_count.error[2])]
    np.testing.assert_allclose(*norms, rtol=1e-4)
    np.testing.assert_allclose(relative_error(MARBLE, fitted.gaussians), fitted.error, rtol=1e-9)
    assert_covariance_is_that_of_all_parameters(fitted)
    fit = partial(fit_gaussians, MARBLE, LeastCount(required), start=by_count.start(3))
    assert_refused(lambda: by_count.least(1e-6), "error is 1e-06, and 4 Gaussians")
    assert_refused(fit, r"start is given .*LeastCount\(")
    assert_refused(lambda: eqx.filter_jit(by_count.least)(0.1), "depends on values")
    assert_refused(lambda: error_by_count(MARBLE, 0), "max_count must be .* at least 1; got 0")


SOLVED = 1e-9


@eqx.filter_jit
def solve(weights, basis, target, energies):
    given = map(jnp.asarray, (basis, target, energies, 1.3))
    return weights.solve(*given)[0]


@pytest.mark.parametrize("seed", range(8))
def test_non_negative_weights_are_the_best(float64, seed):
    """Those of Lawson and Hanson; and for a held sum, those of Kuhn and Tucker's conditions."""
    noise = np.random.default_rng(seed)
    basis = np.exp(-(np.subtract.outer(np.linspace(-2, 2, 40), np.linspace(-1.5, 1.5, 6)) ** 2))
    basis /= np.linalg.norm(basis, axis=0)
    target, energies = noise.normal(size=40), noise.uniform(0.5, 2, 6)
    target /= np.linalg.norm(target)
    found = solve(NonNegativeWeights(), basis, target, energies)
    np.testing.assert_allclose(found, nnls(basis, target)[0], atol=SOLVED)
    assert np.all(found >= 0)
    assert np.any(solve(FreeWeights(), basis, target, energies) < 0)
    held = np.asarray(solve(HELD, basis, target, energies))
    assert np.all(held >= 0)
    np.testing.assert_allclose(energies @ held, 1.3, rtol=SOLVED)
    gains = basis.T @ (target - basis @ held) / energies  # of a unit of the sum
    np.testing.assert_allclose(gains[held > 0], np.max(gains), atol=SOLVED)


@jax.jit
def weights_of_transport(g, medium, variances) -> sj.SumOfGaussians:
    model = sj.fitting.TransportModel(g)
    return sj.fitting.fit_weights(model.profile(medium), variances, weights=HELD, rule=model.rule)


def test_with_the_variances_of_a_fit_they_are_its_weights(float64):
    """Of a material that comes with the package: with as many digits as its file has."""
    fitted = sj.load_material("marble").gaussians
    found = weights_of_transport(0.0, sj.load_medium("marble"), fitted.variances)
    np.testing.assert_allclose(found.weights, fitted.weights, atol=1e-7)
    np.testing.assert_array_equal(found.variances, fitted.variances)


def test_weights_follow_the_phase_function(float64):
    """Against differences, of one mean cosine for all channels and of one for each."""
    given = sj.Medium([0.3, 1.0], [1.0, 0.7], 1.3), jnp.asarray([0.1, 1.0, 9.0])
    fit = jax.jit(lambda g: weights_of_transport(g, *given))
    for g in (jnp.asarray(0.7), jnp.asarray([0.7, -0.2])):
        found = jax.jvp(fit, (g,), (jnp.ones_like(g),))[1].weights
        moved = (fit(g + STEP).weights - fit(g - STEP).weights) / (2 * STEP)
        assert np.min(np.abs(np.sum(moved, axis=0))) > 1e-4
        np.testing.assert_allclose(found, moved, atol=1e-6)


def test_wide_variances_serve_all_media_near(float64):
    near = sj.Medium([0.02, 0.2], [1.0, 0.7], 1.3)
    variances = sj.inverse.wide_variances([near], sj.Splats(np.eye(3) * 1e4, np.eye(3), 1, 1))
    assert len(variances) < 20
    fit = jax.jit(lambda profile: sj.fitting.fit_weights(profile, variances, weights=HELD))
    for a, s in itertools.product((1 / 3, 1, 3), repeat=2):
        profile = sj.Dipole(sj.Medium(near.sigma_a * a, near.sigma_s_prime * s, near.eta))
        found, total = fit(profile), profile.total_reflectance()
        assert np.max(relative_error(profile, found)) < 0.004
        np.testing.assert_allclose(found.total_reflectance(), total, rtol=1e-12)
