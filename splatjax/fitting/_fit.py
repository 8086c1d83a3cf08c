"""From a profile to a sum of Gaussians."""

import equinox as eqx
import optimistix as optx
from jaxtyping import Array, Float

from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import NORM_RULE, RadialRule

from ._search import AbstractStart, InsertedGaussians
from ._spread import AbstractSpread, SharedVariances
from ._weights import AbstractWeights, FreeWeights


class FitResult(eqx.Module):
    r"""A sum of Gaussians and how well it stands for its profile.

    **Attributes:**

    - `gaussians`: variances ascend. With `VariancesPerChannel`, one of a single channel for each channel, batched.
    - `error`: Eq. 4 of each channel.
    - `energy_error`: sum of the weights over the profile's total reflectance, minus 1; 0 if the sum was held.
    - `result`: what became of the search, as a message (`optimistix.RESULTS`).
    """

    gaussians: SumOfGaussians
    error: Float[Array, " channels"]
    energy_error: Float[Array, " channels"]
    result: optx.RESULTS


def fit_gaussians(
    profile: AbstractProfile,
    count: int = 6,
    *,
    spread: AbstractSpread | None = None,
    weights: AbstractWeights | None = None,
    start: AbstractStart | None = None,
    rule: RadialRule = NORM_RULE,
    throw: bool = True,
) -> FitResult:
    r"""Fit a sum of Gaussians to a profile: the least Eq. 3 over variances and weights.

    Variable projection: for given variances the best weights are a linear problem, solved inside; Levenberg and Marquardt's
    method moves the logarithms of the variances. Unless told otherwise, a fit with one Gaussian more starts from the best fit
    before, with a Gaussian inserted in each gap and at both ends. Compiles once for each count and kind of profile.

    The result is differentiable in every float of the profile, by the implicit function theorem with the full Hessian of Eq. 3,
    in forward and reverse mode; to first order. The precision follows the profile. In float32 errors below about 1e-5 are
    rounding, and reaching that floor counts as success.

    **Arguments:**

    - `profile`: 1/mm^2; the integral of `r R(r)^2` must exist. Differentiable.
    - `count`: number of Gaussians, at least 1.
    - `spread`: `SharedVariances()` (default) or `VariancesPerChannel()`.
    - `weights`: `FreeWeights()` (default), `TotalReflectanceHeld()`, or `NonNegativeWeights()` among either.
    - `start`: `InsertedGaussians()` (default), which finds the best fit; or `GivenVariances(...)` near it, which is fast.
    - `rule`: radii of the integral, in length scales of the profile.
    - `throw`: raise if the search has not converged; otherwise `result` says so.

    **Returns:** a `FitResult`; neither `error` nor `weights` depends on the unit of length.

    **Raises:** `ValueError` for a count below 1, and for a profile that is infinite at the origin unless the rule starts beyond
    it (`NORM_RULE.beyond`); an error with the message of `result` if `throw`.

    **Source:** Kim et al. 2010, Eq. 3; variable projection: Golub and Pereyra 1973.
    """
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"count must be a whole number of Gaussians, at least 1; got {count!r}")
    spread = SharedVariances() if spread is None else spread
    weights = FreeWeights() if weights is None else weights
    start = InsertedGaussians() if start is None else start
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
    rule: RadialRule,
    start: AbstractStart,
) -> FitResult:
    gaussians, error, energy, converged = spread.fit(profile, count, weights, rule, start)
    result = optx.RESULTS.where(converged, optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached)
    return FitResult(gaussians, error, energy / profile.total_reflectance() - 1, result)
