"""The closed forms of variable projection, and what follows from them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.fitting import (
    FixedTotalReflectance,
    FreeWeights,
    LeastCount,
    NonNegativeWeights,
    error_by_count,
    fit_gaussians,
    relative_error,
)
from splatjax.fitting._problem import make_problem
from splatjax.gaussians import SumOfGaussians
from splatjax.io import load_medium
from splatjax.scattering import L2_QUADRATURE, Dipole

EXACT = 1e-12
POINT = jnp.asarray([-3.2, -1.9, 0.1, 2.2])


def marble() -> Dipole:
    return Dipole(load_medium("marble"))


@pytest.mark.parametrize(
    "weights", [FreeWeights(), FixedTotalReflectance(), NonNegativeWeights(FixedTotalReflectance())]
)
@pytest.mark.parametrize("active", [None, (True, True, True, False)])
def test_the_expansion_is_that_of_automatic_differentiation(float64, weights, active):
    problem = make_problem(marble(), weights, L2_QUADRATURE)
    active = None if active is None else jnp.asarray(active)
    point = POINT.astype(float)

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
    profile = marble()
    fitted = fit_gaussians(profile, 3)
    problem = make_problem(profile, FreeWeights(), L2_QUADRATURE)
    r = jnp.sqrt(problem.squared_radii)

    def residuals(parameters):
        gaussians = SumOfGaussians(parameters[:3], parameters[3:].reshape(3, 3).T)
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
    fitted = fit_gaussians(marble(), 2, weights=FixedTotalReflectance())
    weights = np.asarray(fitted.covariance)[2:, 2:]
    of_sum = weights[:2, :2].sum()
    assert abs(of_sum) < 1e-12 * np.trace(weights)
    assert np.all(np.linalg.eigvalsh(weights) > -1e-12 * np.trace(weights))


def test_the_variance_of_a_gaussian_without_weight_is_anything(float64):
    one = SumOfGaussians(jnp.asarray([1.0]), jnp.asarray([[0.5]]))
    problem = make_problem(one, NonNegativeWeights(), L2_QUADRATURE)
    # Next to the truth: what the second Gaussian would add is negative.
    _, _, covariance = problem.outcome(jnp.log(jnp.asarray([0.9, 0.4])))
    assert np.isinf(covariance[1, 1])
    assert np.all(np.isfinite(np.delete(np.diag(covariance), 1)))


def test_the_least_count_that_reaches_an_error(float64):
    by_count = error_by_count(marble(), 4)
    worst = np.max(np.asarray(by_count.error), axis=1)
    assert np.all(np.diff(worst) < 0)
    assert by_count.least(float(worst[2])) == 3
    wanted = 1.01 * float(worst[2])
    fitted = fit_gaussians(marble(), LeastCount(wanted, largest=4))
    assert np.max(np.asarray(fitted.error)) <= wanted
    assert fitted.gaussians.variances.shape == (3,)
    np.testing.assert_allclose(
        np.linalg.norm(fitted.error), np.linalg.norm(by_count.error[2]), rtol=1e-4
    )
    np.testing.assert_allclose(relative_error(marble(), fitted.gaussians), fitted.error, rtol=1e-9)
    for refused, message in (
        (lambda: by_count.least(1e-6), "an error of 1e-06 is not reached: 4 Gaussians leave"),
        (
            lambda: fit_gaussians(marble(), LeastCount(wanted), start=by_count.start(3)),
            r"start is given, and LeastCount\(",
        ),
        (
            lambda: eqx.filter_jit(lambda found: found.least(0.1))(by_count),
            "depends on values; find it outside of jit",
        ),
        (lambda: error_by_count(marble(), 0), "largest must be .* at least 1; got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            refused()
