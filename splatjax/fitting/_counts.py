"""How many Gaussians a profile needs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from splatjax.gaussians import AbstractProfile
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule

from ._search import GivenVariances, InsertedGaussians, constant, ladder
from ._spread import AbstractSpread, SharedVariances
from ._weights import AbstractWeights, FreeWeights


class ErrorByCount(eqx.Module):
    r"""The error (Eq. 4) over the number of Gaussians.

    **Attributes:**

    - `error`: of the best sums of 1, 2, ... Gaussians.
    - `variances`: theirs, mm^2, ascending; infinite where there are fewer. With
      `VariancesPerChannel`, for each channel.
    """

    error: Float[Array, "counts channels"]
    variances: Float[Array, "*channels counts gaussians"]

    def least(self, error: float) -> int:
        r"""Give the least number of Gaussians with which no channel exceeds an error.

        **Raises:** `ValueError` if none of them does, and inside `jit`, where the answer depends on
        values.
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
        """Give where a fit of so many Gaussians starts, to finish what was found."""
        return GivenVariances(self.variances[..., count - 1, :count])


def error_by_count(
    profile: AbstractProfile,
    largest: int = 8,
    *,
    spread: AbstractSpread | None = None,
    weights: AbstractWeights | None = None,
    rule: AbstractRadialRule = L2_QUADRATURE,
) -> ErrorByCount:
    r"""Find the best sums of 1, 2, ... Gaussians in one search, and what error each leaves.

    One compilation serves all of them; their sums of squares are those of the best fits to about
    1e-5.

    **Arguments:** as `fit_gaussians` has them.

    - `largest`: number of Gaussians, at least 1.

    **Returns:** an `ErrorByCount`; no derivative goes through it.

    **Raises:** `ValueError` as `fit_gaussians` does.
    """
    check_count("largest", largest)
    spread = SharedVariances() if spread is None else spread
    return _error_by_count(
        profile, largest, spread, FreeWeights() if weights is None else weights, rule
    )


class LeastCount(eqx.Module):
    r"""The least number of Gaussians that reaches a wanted error in every channel.

    **Attributes:**

    - `error`: Eq. 4 that no channel may exceed, positive.
    - `largest`: number of Gaussians to try.
    """

    error: float
    largest: int = 12


def check_count(name: str, count: int) -> None:
    """Raise `ValueError` for what is no number of Gaussians."""
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
    def climb(problem, start):
        del start
        rungs = ladder(problem, largest)

        def leave(rung, count):
            active = jnp.arange(largest) < count
            residuals = problem.residuals(rung, active)
            variances = jnp.where(active, problem.variances(rung), jnp.full_like(rung, jnp.inf))
            return jnp.sqrt(jnp.sum(residuals * residuals, axis=1)), variances

        return jax.vmap(leave)(rungs, jnp.arange(1, largest + 1))

    problem = spread.problem(profile, weights, rule)
    error, variances = spread.over(climb, constant(problem), InsertedGaussians())
    error, variances = (each.astype(problem.target.dtype) for each in (error, variances))
    if error.ndim == 3:
        error = error[..., 0].T
    return ErrorByCount(error, variances)
