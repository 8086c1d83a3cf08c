"""The derivative of a fit against fits of moved coefficients; the closed forms of variable
projection, and what follows from them. Weights for given variances: against solvers of others, by
hand and by trying all subsets; those of a fit, and of layers that serve many media.
"""

from itertools import combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from scipy.optimize import nnls

import splatjax as sj
from splatjax.fitting import (
    FixedTotalReflectance,
    FreeWeights,
    LeastCount,
    NonNegativeWeights,
    SharedVariances,
    VariancesPerChannel,
    error_by_count,
    fit_gaussians,
    relative_error,
)
from splatjax.fitting._problem import make_problem
from splatjax.scattering import L2_QUADRATURE, Dipole, EganFresnel, Layer, Medium, Multipole

# Required of the derivative; central differences with steps of 1e-4 relative err by 1e-7.
REFITS = 1e-4

STEP = 1e-4

# The Hessian of a fit with an error of 1e-2 loses some three of float32's seven digits.
IN_FLOAT32 = 1e-3

HELD = NonNegativeWeights(FixedTotalReflectance())
# Logarithms of sigma_a, sigma_s' and eta of marble's red and blue.
POINT = np.log([0.0021, 0.0071, 2.19, 3.0, 1.5, 1.5])


def of_fit(spread, weights):
    def fit(point):
        sigma_a, sigma_s_prime, eta = jnp.exp(point).reshape(3, 2)
        dipole = Dipole(Medium(sigma_a, sigma_s_prime, eta))
        fitted = fit_gaussians(dipole, 3, spread=spread, weights=weights)
        logarithms = jax.tree.map(jnp.log, (fitted.gaussians.variances, fitted.gaussians.weights))
        return jnp.concatenate([*map(jnp.ravel, logarithms), fitted.error])

    return fit


def of_slab(point):
    *coefficients, thickness = jnp.exp(point)
    slab = Multipole(Layer(Medium(*coefficients), thickness))
    fitted = fit_gaussians(slab, 3, weights=FixedTotalReflectance(), throw=False).gaussians
    return jnp.concatenate([jnp.log(fitted.variances), fitted.weights[:, 0]])


def of_weights(point):
    """Of given variances. Nodes of the integrals are constants of the derivative, and they move
    with the medium: an integral has none.
    """
    profile = Dipole(Medium(jnp.exp(point[:2]), jnp.exp(point[2:]), jnp.full(2, 1.3)))
    variances = jnp.asarray([0.05, 0.3, 2.0, 15.0])
    return sj.fitting.fit_weights(profile, variances, weights=HELD).weights.ravel()


REFITTED = {
    "shared": (of_fit(SharedVariances(), FixedTotalReflectance()), POINT, jax.jacfwd),
    "per channel": (of_fit(VariancesPerChannel(), FreeWeights()), POINT, jax.jacfwd),
    "slab": (of_slab, np.log([0.01, 2.5, 1.4, 2.0]), jax.jacrev),
    "weights": (of_weights, np.log([0.02, 0.2, 1.0, 0.7]), jax.jacfwd),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", REFITTED)
def test_derivative_of_a_fit_is_that_of_refits(float64, case):
    function, point, jacobian = REFITTED[case]
    run, found = jax.jit(function), jax.jit(jacobian(function))(jnp.asarray(point))
    steps = STEP * np.eye(len(point))
    differences = [(run(point + h) - run(point - h)) / (2 * STEP) for h in steps]
    assert np.max(np.abs(found)) > 0.01
    np.testing.assert_allclose(found, np.stack(differences, axis=1), rtol=REFITS, atol=REFITS)


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
            fit_gaussians(sj.SumOfGaussians(jnp.exp(log_variances), weights), 2).gaussians.variances
        )

    point = jnp.log(jnp.asarray([0.1, 2.0]))
    np.testing.assert_allclose(jax.jit(jax.jacfwd(again))(point), np.eye(2), atol=1e-6)


@pytest.mark.slow
def test_float32_gives_the_same_derivatives(float64):
    def fitted(sigma_a, dtype):
        medium = Medium(sigma_a[None], jnp.asarray([1.0], dtype), jnp.asarray([1.3], dtype))
        gaussians = fit_gaussians(Dipole(medium), 3, weights=HELD).gaussians
        return jnp.concatenate([jnp.log(gaussians.variances), gaussians.weights[:, 0]])

    slopes = [
        jax.jacfwd(fitted)(jnp.asarray(0.05, dtype), dtype) for dtype in (jnp.float32, jnp.float64)
    ]
    assert slopes[0].dtype == jnp.float32
    np.testing.assert_allclose(*slopes, rtol=IN_FLOAT32)


EXACT = 1e-12
LOG_VARIANCES = jnp.asarray([-3.2, -1.9, 0.1, 2.2])


MARBLE = Dipole(sj.load_medium("marble"))


@pytest.mark.parametrize(
    "weights", [FreeWeights(), FixedTotalReflectance(), NonNegativeWeights(FixedTotalReflectance())]
)
@pytest.mark.parametrize("active", [None, (True, True, True, False)])
def test_the_expansion_is_that_of_automatic_differentiation(float64, weights, active):
    problem = make_problem(MARBLE, weights, L2_QUADRATURE)
    active = None if active is None else jnp.asarray(active)
    point = LOG_VARIANCES.astype(float)

    @jax.jit
    def both(point):
        def cost(point):
            return jnp.sum(problem.residuals(point, active) ** 2)

        slopes = jax.jacfwd(lambda point: problem.residuals(point, active))(point)
        return (
            problem.expand(point, active),
            slopes,
            jax.jacfwd(cost)(point),
            jax.jacfwd(jax.jacfwd(cost))(point),
        )

    found, jacobian, gradient, hessian = both(point)
    for closed, automatic in (
        (found.jacobian, jacobian),
        (found.gradient, gradient),
        (found.hessian, hessian),
    ):
        assert np.max(np.abs(automatic)) > 0
        np.testing.assert_allclose(closed, automatic, atol=EXACT * float(np.max(np.abs(automatic))))


def test_covariance_is_that_of_a_fit_of_all_parameters(float64):
    """By Gauss and Newton: the inverse normal matrix of the Jacobian in variances and weights,
    times the sum of squares.
    """
    profile = MARBLE
    fitted = fit_gaussians(profile, 3)
    problem = make_problem(profile, FreeWeights(), L2_QUADRATURE)
    r = jnp.sqrt(problem.squared_radii)

    def residuals(parameters):
        gaussians = sj.SumOfGaussians(parameters[:3], parameters[3:].reshape(3, 3).T)
        values = jnp.stack([gaussians(r[channel])[:, channel] for channel in range(3)])
        return (problem.target - problem.root_weights * values / problem.norm[:, None]).ravel()

    best = jnp.concatenate([fitted.gaussians.variances, fitted.gaussians.weights.T.ravel()])
    jacobian = np.asarray(jax.jit(jax.jacfwd(residuals))(best))
    expected = np.linalg.inv(jacobian.T @ jacobian) * float(jnp.sum(residuals(best) ** 2))
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        fitted.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-8
    )


def test_held_weights_do_not_vary_together(float64):
    fitted = fit_gaussians(MARBLE, 2, weights=FixedTotalReflectance())
    weights = np.asarray(fitted.covariance)[2:, 2:]
    of_sum = weights[:2, :2].sum()
    assert abs(of_sum) < 1e-12 * np.trace(weights)
    assert np.all(np.linalg.eigvalsh(weights) > -1e-12 * np.trace(weights))


def test_the_variance_of_a_gaussian_without_weight_is_anything(float64):
    one = sj.SumOfGaussians(jnp.asarray([1.0]), jnp.asarray([[0.5]]))
    problem = make_problem(one, NonNegativeWeights(), L2_QUADRATURE)
    # Next to the truth: what the second Gaussian would add is negative.
    _, _, covariance = problem.outcome(jnp.log(jnp.asarray([0.9, 0.4])))
    assert np.isinf(covariance[1, 1])
    assert np.all(np.isfinite(np.delete(np.diag(covariance), 1)))


def test_the_least_count_that_reaches_an_error(float64):
    by_count = error_by_count(MARBLE, 4)
    worst = np.max(np.asarray(by_count.error), axis=1)
    assert np.all(np.diff(worst) < 0)
    assert by_count.least(float(worst[2])) == 3
    required = 1.01 * float(worst[2])
    fitted = fit_gaussians(MARBLE, LeastCount(required, max_count=4))
    assert np.max(np.asarray(fitted.error)) <= required
    assert fitted.gaussians.variances.shape == (3,)
    np.testing.assert_allclose(
        np.linalg.norm(fitted.error), np.linalg.norm(by_count.error[2]), rtol=1e-4
    )
    np.testing.assert_allclose(relative_error(MARBLE, fitted.gaussians), fitted.error, rtol=1e-9)
    for refused, message in (
        (lambda: by_count.least(1e-6), "error is 1e-06, and 4 Gaussians"),
        (
            lambda: fit_gaussians(MARBLE, LeastCount(required), start=by_count.start(3)),
            r"start is given .*LeastCount\(",
        ),
        (
            lambda: eqx.filter_jit(lambda found: found.least(0.1))(by_count),
            "depends on values",
        ),
        (lambda: error_by_count(MARBLE, 0), "max_count must be .* at least 1; got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            refused()


SOLVED = 1e-9


def problem(seed: int):
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
    medium = sj.load_medium("ketchup")

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


def test_with_the_variances_of_a_fit_they_are_its_weights(float64):
    """Of a material that comes with the package: with as many digits as its file has."""
    fitted, model = sj.load_material("marble").gaussians, sj.fitting.TransportModel()
    profile = model.profile(sj.load_medium("marble"))
    found = sj.fitting.fit_weights(profile, fitted.variances, weights=HELD, rule=model.rule)
    np.testing.assert_allclose(found.weights, fitted.weights, atol=1e-7)
    np.testing.assert_array_equal(found.variances, fitted.variances)


def test_wide_variances_serve_all_media_near(float64):
    near = sj.Medium([0.02, 0.2], [1.0, 0.7], 1.3)
    variances = sj.inverse.wide_variances(
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
