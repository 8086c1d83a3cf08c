"""The search for the best variances: a Gaussian is inserted into the best fit with one fewer, at every place."""

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ._dense import NormalEquations
from ._problem import Problem

_FIRST = (-3.0, 4.0)
"""Log variances, in squared length scales, between which a single Gaussian starts."""

_OUTWARD = 1.5
"""How far, in log variance, a Gaussian starts outside the previous ones: neighbors lie 1.4 to 2.2 apart."""

_SEARCH_STEPS = 64
_FINAL_STEPS = 256


def search(problem: Problem, count: int) -> Float[Array, " gaussians"]:
    """Give the best log variances found, ascending. No derivative goes through it."""
    problem = jax.lax.stop_gradient(problem)
    dtype = problem.target.dtype

    def stage(best, active_count):
        active = jnp.arange(count) < active_count
        starts = jax.vmap(lambda place: _insert(best, active_count, place))(jnp.arange(count))
        found = jax.vmap(lambda start: _descend(problem, start, active, 1e-3, _SEARCH_STEPS))(starts)
        costs = jax.vmap(lambda point: _cost(problem, point, active))(found)
        return _sorted(found[jnp.argmin(costs)], active), None

    best, _ = jax.lax.scan(stage, jnp.zeros(count, dtype), jnp.arange(1, count + 1))
    tolerance = float(10 * jnp.finfo(dtype).eps) ** 0.5 * 1e-2
    refined = _descend(problem, best, None, tolerance, _FINAL_STEPS)
    better = _cost(problem, refined, None) <= _cost(problem, best, None)
    return jnp.sort(jnp.where(better, refined, best))


def _insert(best: Float[Array, " gaussians"], active_count: Int[Array, ""], place: Int[Array, ""]) -> Float[Array, " gaussians"]:
    """Insert one log variance at a place among the first `active_count - 1`, which ascend."""
    count = best.shape[0]
    last = active_count - 1
    place = jnp.minimum(place, last)
    below = best[jnp.maximum(place - 1, 0)]
    above = best[jnp.minimum(place, count - 1)]
    between = 0.5 * (below + above)
    value = jnp.where(place == 0, above - _OUTWARD, jnp.where(place == last, below + _OUTWARD, between))
    index = jnp.arange(count)
    shifted = jnp.roll(best, 1)
    inserted = jnp.where(index < place, best, jnp.where(index == place, value, shifted))
    spread = jnp.linspace(*_FIRST, count, dtype=best.dtype)
    return jnp.where(active_count == 1, jnp.full_like(best, 1) * spread[place], inserted)


def _descend(
    problem: Problem, start: Float[Array, " gaussians"], active: Bool[Array, " gaussians"] | None, tolerance: float, steps: int
) -> Float[Array, " gaussians"]:
    # In units of the start's own residual, so that damping and tolerances mean the same for a good fit as for a poor one.
    unit = jnp.sqrt(_cost(problem, start, active))

    def residuals(point, _):
        return problem.residuals(point, active) / unit

    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=NormalEquations())
    return optx.least_squares(residuals, solver, start, max_steps=steps, throw=False).value


def _cost(problem: Problem, point: Float[Array, " gaussians"], active: Bool[Array, " gaussians"] | None) -> Float[Array, ""]:
    cost = jnp.sum(problem.residuals(point, active) ** 2)
    return jnp.where(jnp.isfinite(cost), cost, jnp.full_like(cost, jnp.inf))


def _sorted(point: Float[Array, " gaussians"], active: Bool[Array, " gaussians"]) -> Float[Array, " gaussians"]:
    ordered = jnp.sort(jnp.where(active, point, jnp.full_like(point, jnp.inf)))
    return jnp.where(active, ordered, jnp.zeros_like(point))
