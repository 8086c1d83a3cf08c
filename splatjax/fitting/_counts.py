"""How many Gaussians a profile needs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from splatjax.gaussians import AbstractProfile
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule

from ._problem import FitProblem, make_problem
from ._search import GivenVariances, GreedyInsertion, constant, greedy_path
from ._spread import AbstractSpread, SharedVariances
from ._weights import AbstractWeights, FreeWeights


class ErrorByCount(eqx.Module):
    r"""The error (Eq. 4) over the number of Gaussians.

    **Attributes:**

    - `error`: of the best sums of 1, 2, ... Gaussians.
    - `variances`: of these sums, mm^2, ascending; the unused last ones are infinite. With
      `VariancesPerChannel`, for each channel.
    """

    error: Float[Array, "counts channels"]
    variances: Float[Array, "*channels counts gaussians"]

    def least(self, error: float) -> int:
        r"""Find the least number of Gaussians with which no channel exceeds an error.

        **Raises:** `ValueError` if no number suffices, and inside `jit`, where the answer depends
        on values.
        """
        if isinstance(self.error, Tracer):
            raise ValueError(
                "the least number of Gaussians depends on values; find it outside of jit and vmap"
            )
        worst = np.max(np.asarray(self.error), axis=1)
        if not error > 0 or not np.any(worst <= error):
            left = f"{len(worst)} Gaussians leave {worst[-1]:.2e} (worst channel)"
            raise ValueError(
                f"an error of {error:g} is not reached: {left}; ask for that, or allow more "
                "Gaussians"
            )
        return int(np.argmax(worst <= error)) + 1

    def start(self, count: int) -> GivenVariances:
        """Return the start of a fit of so many Gaussians, which finishes this search."""
        return GivenVariances(self.variances[..., count - 1, :count])


def error_by_count(
    profile: AbstractProfile,
    largest: int = 8,
    *,
    spread: AbstractSpread = SharedVariances(),
    weights: AbstractWeights = FreeWeights(),
    rule: AbstractRadialRule = L2_QUADRATURE,
) -> ErrorByCount:
    r"""Find the best sums of 1, 2, ... Gaussians in one search, and the error of each.

    One compilation serves all of them; their sums of squares are those of the best fits to about
    1e-5.

    **Arguments:** as for `fit_gaussians`.

    - `largest`: number of Gaussians, at least 1.

    **Returns:** an `ErrorByCount`; no derivative goes through it.

    **Raises:** `ValueError` as `fit_gaussians` does.
    """
    check_count("largest", largest)
    return _error_by_count(profile, largest, spread, weights, rule)


class LeastCount(eqx.Module):
    r"""The least number of Gaussians that reaches a required error in every channel.

    **Attributes:**

    - `error`: Eq. 4 that no channel may exceed, positive.
    - `largest`: number of Gaussians to try.
    """

    error: float
    largest: int = 12


def check_count(name: str, count: int) -> None:
    """Raise `ValueError` for a number of Gaussians that is not a positive integer."""
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ValueError(f"{name} must be a whole number of Gaussians, at least 1; got {count!r}")


@eqx.filter_jit
def _error_by_count(
    profile: AbstractProfile,
    largest: int,
    spread: AbstractSpread,
    weights: AbstractWeights,
    rule: AbstractRadialRule,
) -> ErrorByCount:
    def search(problem: FitProblem, _):
        def summarize(point, count):
            active = jnp.arange(largest) < count
            residuals = problem.residuals(point, active)
            error = jnp.sqrt(jnp.sum(residuals * residuals, axis=1))
            return error, jnp.where(active, problem.variances(point), jnp.inf)

        points = greedy_path(problem, largest)
        return jax.vmap(summarize)(points, jnp.arange(1, largest + 1))

    problem = make_problem(profile, weights, rule)
    found = spread.over(search, constant(problem), GreedyInsertion())
    error, variances = (values.astype(problem.target.dtype) for values in found)
    return ErrorByCount(error[..., 0].T if error.ndim == 3 else error, variances)
