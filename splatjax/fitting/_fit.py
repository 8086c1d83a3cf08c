"""Fits of sums of Gaussians to a profile, and the number of Gaussians that a fit needs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._format import channel_names, format_numbers
from splatjax._records import Numbers, as_floats, is_traced, require
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule

from ._problem import FitProblem, make_problem, nonzero
from ._search import (
    AbstractSpread,
    GivenVariances,
    SharedVariances,
    constant,
    greedy_path,
    refine,
    stationary,
)
from ._weights import AbstractWeights, FreeWeights


class ErrorByCount(eqx.Module):
    r"""The error (Eq. 4) as a function of the number of Gaussians.

    **Attributes:**

    - `error`: errors of the best sums of 1, 2, ... Gaussians.
    - `variances`: variances of these sums, mm^2, ascending, padded with infinity. With
      `VariancesPerChannel`, each channel has its own.
    """

    error: Float[Array, "counts channels"]
    variances: Float[Array, "*channels counts gaussians"]

    def least(self, error: float) -> int:
        r"""Find the least number of Gaussians for which no channel exceeds an error.

        **Raises:** `ValueError` if no number suffices, and inside `jit`, because the result depends
        on values.
        """
        require(
            not is_traced(self.error),
            "the least number of Gaussians depends on values; compute it outside of jit and vmap",
        )
        worst = np.max(np.asarray(self.error), axis=1)
        _check_reached(error > 0 and bool(np.any(worst <= error)), error, len(worst), worst[-1])
        return int(np.argmax(worst <= error)) + 1

    def start(self, count: int) -> GivenVariances:
        """Return the start for a fit of `count` Gaussians that refines this result."""
        return GivenVariances(self.variances[..., count - 1, :count])


def _check_reached(is_reached: bool, error: float, count: int, worst: float) -> None:
    require(
        is_reached,
        f"error is {error:g}, and {count} Gaussians reach {worst:.2e} (worst channel); give a "
        "larger error, or allow more Gaussians",
    )


@jit_unless_traced
def error_by_count(
    profile: AbstractProfile,
    max_count: int = 8,
    *,
    spread: AbstractSpread = SharedVariances(),
    weights: AbstractWeights = FreeWeights(),
    rule: AbstractRadialRule = L2_QUADRATURE,
) -> ErrorByCount:
    r"""Find the best sums of 1, 2, ... Gaussians in one search, and the error of each.

    All counts share one compilation. The sums of squares equal those of the best fits to about
    1e-5.

    **Arguments:** as for `fit_gaussians`.

    - `max_count`: number of Gaussians, at least 1.

    **Returns:** an `ErrorByCount`. It is not differentiable.

    **Raises:** `ValueError` as `fit_gaussians` does.
    """
    check_count("max_count", max_count)

    def search(problem: FitProblem, _):
        def summarize(point, count):
            active = jnp.arange(max_count) < count
            error = jnp.sqrt(jnp.sum(problem.residuals(point, active) ** 2, axis=1))
            return error, jnp.where(active, problem.variances(point), jnp.inf)

        return jax.vmap(summarize)(greedy_path(problem, max_count), jnp.arange(1, max_count + 1))

    problem = make_problem(profile, weights, rule)
    error, variances = (
        values.astype(problem.target.dtype)
        for values in spread.over(search, constant(problem), None)
    )
    return ErrorByCount(error[..., 0].T if error.ndim == 3 else error, variances)


class LeastCount(eqx.Module):
    r"""The least number of Gaussians that reaches a required error in every channel.

    **Attributes:**

    - `error`: the largest error (Eq. 4) allowed in any channel, positive.
    - `max_count`: largest number of Gaussians to try.
    """

    error: float
    max_count: int = 12


def check_count(name: str, count: int) -> None:
    """Raise `ValueError` for a number of Gaussians that is not a positive integer."""
    require(
        isinstance(count, int) and not isinstance(count, bool) and count >= 1,
        f"{name} must be a whole number of Gaussians, at least 1; got {count!r}",
    )


class FitResult(eqx.Module):
    r"""A fitted sum of Gaussians, and its errors.

    **Attributes:**

    - `gaussians`: the fitted sum, variances ascending. With `VariancesPerChannel` it has a leading
      axis of channels: variances `[channels, gaussians]`, weights `[channels, gaussians, 1]`.
    - `error`: relative error of each channel (Eq. 4).
    - `energy_error`: sum of the weights divided by the profile's total reflectance, minus 1; 0 with
      `FixedTotalReflectance`.
    - `result`: the outcome of the search, as a message (`optimistix.RESULTS`).
    - `covariance`: uncertainty of the parameters in the Gauss-Newton approximation: a change `d` of
      the parameters with `d @ inv(covariance) @ d <= 1` at most doubles Eq. 3. The parameters are
      the variances, then the weights channel by channel; with `VariancesPerChannel`, there is one
      matrix per channel. For error bars of a measured profile with equal, independent noise at `N`
      radii, divide the matrix by `N` minus the number of parameters.
    """

    gaussians: SumOfGaussians
    error: Float[Array, " channels"]
    energy_error: Float[Array, " channels"]
    result: optx.RESULTS
    covariance: Float[Array, "*channels parameters parameters"]

    def table(self) -> list[tuple[str, str]]:
        """Return the Gaussians and their errors as rows of a name and one number per channel, after
        a heading. With `VariancesPerChannel`, the Gaussians are listed channel by channel. An
        energy error that rounds to 0 is omitted.
        """
        weights = self.gaussians.weights.reshape(-1, self.gaussians.channels)
        names = ", ".join(channel_names(len(self.error)))
        pairs = zip(self.gaussians.variances.ravel(), weights, strict=True)
        total = jnp.sum(self.gaussians.weights, axis=-2).ravel()
        lost = jnp.round(self.energy_error, 6) + 0.0
        return [
            ("variance, mm^2", f"weights ({names})"),
            *((f"{float(variance):.6g}", format_numbers(row, ".5f")) for variance, row in pairs),
            ("sum", format_numbers(total, ".5f")),
            ("error (Eq. 4)", format_numbers(self.error, ".2e")),
            *([("energy error", format_numbers(lost, ".2e"))] if bool(jnp.any(lost)) else []),
        ]

    def _repr_html_(self) -> str:
        """Return the table as HTML, for notebooks."""
        rows = "".join(f"<tr><td>{name}</td><td>{row}</td></tr>" for name, row in self.table())
        return f"<table>{rows}</table>"


def fit_gaussians(
    profile: AbstractProfile,
    count: int | LeastCount = 6,
    *,
    spread: AbstractSpread = SharedVariances(),
    weights: AbstractWeights = FreeWeights(),
    start: GivenVariances | None = None,
    rule: AbstractRadialRule = L2_QUADRATURE,
    throw: bool = True,
) -> FitResult:
    r"""Fit a sum of Gaussians to a profile.

        model, medium = TransportModel(), load_medium("marble")
        weights = NonNegativeWeights(FixedTotalReflectance())
        fitted = fit_gaussians(model.profile(medium), 6, weights=weights, rule=model.rule)
        fitted.gaussians, fitted.error

    This is the fit of `splatjax fit`, and of `Material.of_medium`. With the default `weights` and
    `rule`, the fit minimizes the integral of `r (R(r) - sum_k w_k G(v_k, r))^2` (Eq. 3) over the
    variances `v` and the weights `w`.

    The method is variable projection: for given variances the best weights solve a linear problem,
    and the Levenberg-Marquardt method searches the logarithms of the variances. By default the
    search starts with one Gaussian and adds one at a time: the new Gaussian is tried in every gap
    between the variances of the best fit so far and beyond both ends, and the best result is kept.
    The fit is compiled once per count and kind of profile.

    The result is differentiable in every parameter of the profile, in forward and reverse mode, to
    first order. Derivatives use the implicit function theorem with the full Hessian of Eq. 3. The
    precision is that of the profile. In float32, errors below about 1e-5 are rounding errors; a
    search that reaches them counts as converged.

    **Arguments:**

    - `profile`: 1/mm^2; the integral of `r R(r)^2` must exist. Differentiable.
    - `count`: number of Gaussians, at least 1; or `LeastCount(error)` for the least number that
      reaches an error.
    - `spread`: `SharedVariances()` (default), which a `Material` needs, or `VariancesPerChannel()`.
    - `weights`: `FreeWeights()` (default), `FixedTotalReflectance()`, which conserves the energy,
      or `NonNegativeWeights(among)`, which also excludes negative weights.
    - `start`: `GivenVariances(...)` near those of the best fit, for a single fast search; requires
      a fixed count. By default, fits with fewer Gaussians provide the start.
    - `rule`: the radii of the integral, and their weights. The default covers all radii;
      `TransportModel.rule` starts at half a mean free path; `InverseVariance()` weights a measured
      profile by its standard errors.
    - `throw`: raise if the search has not converged; otherwise `result` reports it.

    **Returns:** a `FitResult`. Its `error` and weights do not depend on the unit of length.

    **Raises:** `ValueError` for a count below 1, for an error that no count reaches, for a `start`
    without a fixed count, and for a profile that is infinite at the origin unless the rule starts
    beyond it (`L2_QUADRATURE.beyond`); an error with the message of `result` if `throw`.

    **Source:** Kim et al. 2010, Eq. 3; variable projection: Golub and Pereyra 1973.
    """
    if isinstance(count, LeastCount):
        require(
            start is None,
            f"start is given together with {count}, which computes its own start; leave start "
            "out, or give a count",
        )
        by_count = error_by_count(
            profile, count.max_count, spread=spread, weights=weights, rule=rule
        )
        # The final refinement of shared variances may move error from one channel to another.
        for trial in range(by_count.least(count.error), count.max_count + 1):
            fitted = _fit_compiled(profile, trial, spread, weights, rule, by_count.start(trial))
            worst = float(jnp.max(fitted.error))
            if worst <= count.error:
                break
        _check_reached(worst <= count.error, count.error, trial, worst)
    else:
        check_count("count", count)
        fitted = _fit_compiled(profile, count, spread, weights, rule, start)
    failed = fitted.result != optx.RESULTS.successful
    return fitted.result.error_if(fitted, failed) if throw else fitted


@eqx.filter_jit
def _fit_compiled(
    profile: AbstractProfile,
    count: int,
    spread: AbstractSpread,
    weights: AbstractWeights,
    rule: AbstractRadialRule,
    start: GivenVariances | None,
) -> FitResult:
    def fit(problem: FitProblem, start: GivenVariances | None):
        searched = constant(problem)
        near = start.search(searched, count) if start else greedy_path(searched, count)[-1]
        optimum, converged = refine(problem, near.astype(problem.target.dtype))
        return problem.outcome(stationary(problem, optimum)), converged

    problem = make_problem(profile, weights, rule)
    (gaussians, error, covariance), converged = spread.over(fit, problem, start)
    total = profile.total_reflectance()
    energy = (jnp.sum(gaussians.weights, axis=-2).reshape(-1) - total) / nonzero(total)
    result = optx.RESULTS.where(
        jnp.all(converged), optx.RESULTS.successful, optx.RESULTS.nonlinear_max_steps_reached
    )
    return FitResult(gaussians, error.reshape(-1), energy, result, covariance)


def fit_weights(
    profile: AbstractProfile,
    variances: Numbers,
    *,
    weights: AbstractWeights = FreeWeights(),
    rule: AbstractRadialRule = L2_QUADRATURE,
) -> SumOfGaussians:
    r"""Fit the weights of Gaussians with given variances to a profile: minimize Eq. 3 over the
    weights.

    The fit is linear and fast. If the variances increase by a factor of 3 and cover the widths of
    many media, the dipole of each medium is fitted with an error (Eq. 4) of about 0.2%; with a
    factor of 2, the error is 0.002%. One set of rendered layers therefore serves all these media.

    **Arguments:**

    - `profile`: 1/mm^2. Differentiable, in forward and reverse mode.
    - `variances`: mm^2, positive, all different. Derivatives treat them as constants.
    - `weights`: as for `fit_gaussians`.
    - `rule`: radii of the integral, in length scales of the profile.

    **Returns:** the Gaussians, in the precision of the profile. With the variances of a fit, the
    weights are those of the fit.

    **Raises:** `ValueError` for a profile that is infinite at the origin unless the rule starts
    beyond it.
    """
    problem = make_problem(profile, weights, rule)
    variances = jax.lax.stop_gradient(as_floats(variances, problem.target.dtype))
    _, coefficients, _, _ = problem.solve(problem.log_variances(variances))
    scale = problem.norm[:, None] * problem.energies(variances)[None]
    return SumOfGaussians(variances, (coefficients * scale).T)
