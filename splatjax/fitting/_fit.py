"""From a profile to a sum of Gaussians."""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule

from ._counts import LeastCount, check_count, error_by_count
from ._problem import FitProblem, make_problem
from ._search import AbstractStart, GreedyInsertion, search
from ._spread import AbstractSpread, SharedVariances
from ._stationary import refine, stationary
from ._weights import AbstractWeights, FreeWeights


class FitResult(eqx.Module):
    r"""A sum of Gaussians and how well it stands for its profile.

    **Attributes:**

    - `gaussians`: variances ascend. With `VariancesPerChannel`, one of a single channel for each
      channel, batched.
    - `error`: Eq. 4 of each channel.
    - `energy_error`: sum of the weights over the profile's total reflectance, minus 1; 0 if the sum
      was held.
    - `result`: what became of the search, as a message (`optimistix.RESULTS`).
    - `covariance`: of the variances, and then of the weights of one channel after the other, by
      Gauss and Newton; with `VariancesPerChannel`, for each channel. Within its ellipsoid Eq. 3 at
      most doubles. Where the residuals are noise of equal size at N independent nodes of Eq. 3,
      divide by N less the number of parameters.
    """

    gaussians: SumOfGaussians
    error: Float[Array, " channels"]
    energy_error: Float[Array, " channels"]
    result: optx.RESULTS
    covariance: Float[Array, "*channels parameters parameters"]


def fit_gaussians(
    profile: AbstractProfile,
    count: int | LeastCount = 6,
    *,
    spread: AbstractSpread = SharedVariances(),
    weights: AbstractWeights = FreeWeights(),
    start: AbstractStart = GreedyInsertion(),
    rule: AbstractRadialRule = L2_QUADRATURE,
    throw: bool = True,
) -> FitResult:
    r"""Fit a sum of Gaussians to a profile: the least Eq. 3 over variances and weights.

    Variable projection: for given variances the best weights are a linear problem, solved inside;
    Levenberg and Marquardt's method moves the logarithms of the variances. Unless told otherwise, a
    fit with one Gaussian more starts from the best fit before, with a Gaussian inserted in each gap
    and at both ends. Compiles once for each count and kind of profile.

    The result is differentiable in every float of the profile, by the implicit function theorem
    with the full Hessian of Eq. 3, in forward and reverse mode; to first order. The precision
    follows the profile. In float32 errors below about 1e-5 are rounding, and reaching that floor
    counts as success.

    **Arguments:**

    - `profile`: 1/mm^2; the integral of `r R(r)^2` must exist. Differentiable.
    - `count`: number of Gaussians, at least 1; or `LeastCount(error)`, the least that leaves no
      more than that.
    - `spread`: `SharedVariances()` (default) or `VariancesPerChannel()`.
    - `weights`: `FreeWeights()` (default), `FixedTotalReflectance()`, or `NonNegativeWeights()`
      among either.
    - `start`: `GreedyInsertion()` (default), which finds the best fit; or `GivenVariances(...)`
      near it, which is fast. Of a given count alone: the least one is found by inserting.
    - `rule`: radii of the integral, in length scales of the profile; or `InverseVariance()`, for
      one with standard errors.
    - `throw`: raise if the search has not converged; otherwise `result` says so.

    **Returns:** a `FitResult`; neither `error` nor `weights` depends on the unit of length.

    **Raises:** `ValueError` for a count below 1, for an error that no count reaches, for a `start`
    without a count, and for a profile that is infinite at the origin unless the rule starts beyond
    it (`L2_QUADRATURE.beyond`); an error with the message of `result` if `throw`.

    **Source:** Kim et al. 2010, Eq. 3; variable projection: Golub and Pereyra 1973.
    """
    if isinstance(count, LeastCount):
        if not isinstance(start, GreedyInsertion):
            raise ValueError(
                f"start is given, and {count}, which finds its own; leave start out, or give a "
                "count"
            )
        by_count = error_by_count(profile, count.largest, spread=spread, weights=weights, rule=rule)
        # Finishing a fit of shared variances may move error from one channel to another.
        for enough in range(by_count.least(count.error), count.largest + 1):
            fitted = _fit_compiled(profile, enough, spread, weights, rule, by_count.start(enough))
            if float(jnp.max(fitted.error)) <= count.error:
                break
    else:
        check_count("count", count)
        fitted = _fit_compiled(profile, count, spread, weights, rule, start)
    if throw:
        fitted = fitted.result.error_if(fitted, fitted.result != optx.RESULTS.successful)
    return fitted


@eqx.filter_jit
def _fit_compiled(
    profile: AbstractProfile,
    count: int,
    spread: AbstractSpread,
    weights: AbstractWeights,
    rule: AbstractRadialRule,
    start: AbstractStart,
) -> FitResult:
    problem = make_problem(profile, weights, rule)
    fit = partial(_fit_problem, count=count)
    (gaussians, error, covariance), converged = spread.over(fit, problem, start)
    energy = jnp.sum(gaussians.weights, axis=-2).reshape(-1) / profile.total_reflectance() - 1
    result = optx.RESULTS.where(
        jnp.all(converged), optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    return FitResult(gaussians, error.reshape(-1), energy, result, covariance)


def _fit_problem(
    problem: FitProblem, start: AbstractStart, count: int
) -> tuple[tuple, Bool[Array, ""]]:
    optimum, converged = refine(problem, search(problem, count, start))
    return problem.outcome(stationary(problem, optimum)), converged
