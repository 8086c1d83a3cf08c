"""The derivative of a fit, and whether it is one: the point where the gradient of Eq. 3 vanishes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._dense import invert
from ._problem import Problem

_GAIN = 1e-6
"""A fit has converged when a step of Gauss and Newton would lower the sum of squares by less than this share of it,"""

_FLOOR = 100.0
"""or by less than the square of this many units of rounding of the profile's norm: there is no more in the numbers."""

_STEPS = 32
_STEP = 10.0
"""A step in log variance below this many units of rounding is none."""


def stationary(problem: Problem, found: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
    r"""Give `found` with the derivative that the implicit function theorem gives it.

    `g(log_variances, profile) = 0` at the optimum, so `d log_variances = -H^-1 dg`, where `H`, the derivative of `g`, is the full
    Hessian of Eq. 3 after the weights are eliminated (not that of Gauss and Newton). Forward and reverse mode.
    """

    def tangent_solve(linear, tangent):
        hessian = jax.vmap(linear, out_axes=1)(jnp.eye(tangent.shape[0], dtype=tangent.dtype))
        return _invert_moving(hessian) @ tangent

    found = jax.lax.stop_gradient(found)
    return jax.lax.custom_root(lambda point: problem.gradient(point), found, lambda _, guess: guess, tangent_solve)


def refine(problem: Problem, start: Float[Array, " gaussians"]) -> tuple[Float[Array, " gaussians"], Bool[Array, ""]]:
    """Finish a fit by Newton's method with the full Hessian; also give whether no small step could improve it any more."""
    problem, start = jax.lax.stop_gradient((problem, start))

    def cost_of(point):
        return jnp.sum(problem.residuals(point) ** 2)

    def step(state):
        point, cost, _, steps = state
        gradient = problem.gradient(point)
        newton = _invert_moving(jax.jacfwd(problem.gradient)(point)) @ gradient
        trial = point - newton
        trial_cost = cost_of(trial)
        # Once the steps are rounding, so are their gains and losses: they end the search, and are not taken.
        better = (trial_cost < cost) & (jnp.max(jnp.abs(newton)) > _STEP * float(jnp.finfo(cost.dtype).eps))
        return jnp.where(better, trial, point), jnp.where(better, trial_cost, cost), better, steps + 1

    state = (start, cost_of(start), jnp.asarray(True), jnp.asarray(0))
    found, cost, *_ = jax.lax.while_loop(lambda state: state[2] & (state[3] < _STEPS), step, state)
    floor = (_FLOOR * float(jnp.finfo(cost.dtype).eps)) ** 2
    return found, _gain(problem, found) <= _GAIN * cost + floor


def _invert_moving(hessian: Float[Array, "gaussians gaussians"]) -> Float[Array, "gaussians gaussians"]:
    """Invert a Hessian; a Gaussian of weight zero in all channels changes nothing, and stays where it is."""
    still = jnp.diagonal(hessian) == 0
    return invert(hessian + jnp.diag(still.astype(hessian.dtype)))


def _gain(problem: Problem, point: Float[Array, " gaussians"]) -> Float[Array, ""]:
    """Give by how much the sum of squares would fall if the residuals were linear: sound in float32, where the Hessian is not."""
    residuals = problem.residuals(point).ravel()
    slopes = jax.jacfwd(problem.residuals)(point).reshape(residuals.shape[0], -1)
    lengths = jnp.sqrt(jnp.sum(slopes * slopes, axis=0))
    slopes = slopes / jnp.broadcast_to(jnp.where(lengths > 0, lengths, 1.0), slopes.shape)
    along = slopes.T @ residuals
    return along @ _invert_moving(slopes.T @ slopes) @ along
