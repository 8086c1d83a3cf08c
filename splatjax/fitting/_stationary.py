"""The derivative of a fit, and whether it is one: the point where the gradient of Eq. 3
vanishes.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._dense import invert_moving
from ._problem import Expansion, FitProblem

# A fit has converged when a step of Gauss and Newton would lower the sum of squares by less than
# this share of it,
_GAIN = 1e-6

# or by less than the square of this many units of rounding of the profile's norm: there is no more
# in the numbers.
_FLOOR = 100.0

_STEPS = 32
# A step in log variance below this many units of rounding is none.
_STEP = 10.0


def stationary(
    problem: FitProblem, optimum: Float[Array, " gaussians"]
) -> Float[Array, " gaussians"]:
    r"""Differentiate an optimum by the implicit function theorem; its value is unchanged.

    `g(log_variances, profile) = 0` at the optimum, so `d log_variances = -H^-1 dg`, where `H`, the
    derivative of `g`, is the full Hessian of Eq. 3 after the weights are eliminated (not that of
    Gauss and Newton). Forward and reverse mode.
    """

    def tangent_solve(linear, tangent):
        hessian = jax.vmap(linear, out_axes=1)(jnp.eye(tangent.shape[0], dtype=tangent.dtype))
        return invert_moving(hessian) @ tangent

    return jax.lax.custom_root(
        lambda point: problem.expand(point).gradient,
        jax.lax.stop_gradient(optimum),
        lambda _, guess: guess,
        tangent_solve,
    )


def refine(
    problem: FitProblem, start: Float[Array, " gaussians"]
) -> tuple[Float[Array, " gaussians"], Bool[Array, ""]]:
    """Finish a fit by Newton's method with the full Hessian; also return whether it has
    converged.
    """
    problem, start = jax.lax.stop_gradient((problem, start))

    def step(state):
        best, newton, _, steps = state
        trial = best[0] - newton
        expansion = problem.expand(trial)
        # Steps of the size of rounding have gains and losses of that size: they end the search and
        # are not taken.
        moved = (steps == 0) | (
            jnp.max(jnp.abs(newton)) > _STEP * float(jnp.finfo(trial.dtype).eps)
        )
        better = moved & (expansion.cost < best[1])
        reached = trial, expansion.cost, _gain(expansion)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), reached, best)
        return best, invert_moving(expansion.hessian) @ expansion.gradient, better, steps + 1

    unknown = jnp.full((), jnp.inf, start.dtype)
    # The best point with its cost and gain, the next step, whether to go on, and how many steps.
    state = (start, unknown, unknown), jnp.zeros_like(start), jnp.asarray(True), jnp.asarray(0)
    best, *_ = jax.lax.while_loop(lambda state: state[2] & (state[3] <= _STEPS), step, state)
    point, cost, gain = best
    floor = (_FLOOR * float(jnp.finfo(start.dtype).eps)) ** 2
    return point, gain <= _GAIN * cost + floor


def _gain(expansion: Expansion) -> Float[Array, ""]:
    """Compute by how much the sum of squares would fall if the residuals were linear: accurate in
    float32, where the Hessian is not.
    """
    normal = jnp.einsum("cni,cnj->ij", expansion.jacobian, expansion.jacobian)
    squared = jnp.diagonal(normal)
    lengths = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    # Not half the gradient: the Jacobian is orthogonal to the basis, so that the rounding of the
    # weights does not enter.
    along = jnp.einsum("cnk,cn->k", expansion.jacobian, expansion.residuals) / lengths
    return along @ invert_moving(normal / (lengths[:, None] * lengths[None])) @ along
