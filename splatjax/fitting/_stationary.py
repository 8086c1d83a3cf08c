"""The derivative of a fit, and whether it is one: the point where the gradient of Eq. 3
vanishes.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._dense import invert_moving
from ._problem import Expansion, Problem

_GAIN = 1e-6
"""A fit has converged when a step of Gauss and Newton would lower the sum of squares by less than
this share of it,
"""

_FLOOR = 100.0
"""or by less than the square of this many units of rounding of the profile's norm: there is no more
in the numbers.
"""

_STEPS = 32
_STEP = 10.0
"""A step in log variance below this many units of rounding is none."""


def stationary(problem: Problem, found: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
    r"""Give `found` with the derivative that the implicit function theorem gives it.

    `g(log_variances, profile) = 0` at the optimum, so `d log_variances = -H^-1 dg`, where `H`, the
    derivative of `g`, is the full Hessian of Eq. 3 after the weights are eliminated (not that of
    Gauss and Newton). Forward and reverse mode.
    """

    def tangent_solve(linear, tangent):
        hessian = jax.vmap(linear, out_axes=1)(jnp.eye(tangent.shape[0], dtype=tangent.dtype))
        return invert_moving(hessian) @ tangent

    found = jax.lax.stop_gradient(found)
    return jax.lax.custom_root(
        lambda point: problem.gradient(point), found, lambda _, guess: guess, tangent_solve
    )


def refine(
    problem: Problem, start: Float[Array, " gaussians"]
) -> tuple[Float[Array, " gaussians"], Bool[Array, ""]]:
    """Finish a fit by Newton's method with the full Hessian; also give whether no small step could
    improve it any more.
    """
    problem, start = jax.lax.stop_gradient((problem, start))

    def step(state):
        best, newton, _, steps = state
        trial = best.point - newton
        expansion = problem.expand(trial)
        # Once the steps are rounding, so are their gains and losses: they end the search, and are
        # not taken.
        moved = (steps == 0) | (
            jnp.max(jnp.abs(newton)) > _STEP * float(jnp.finfo(trial.dtype).eps)
        )
        better = moved & (expansion.cost < best.cost)
        reached = _Reached(trial, expansion.cost, _gain(expansion))
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), reached, best)
        return best, invert_moving(expansion.hessian) @ expansion.gradient, better, steps + 1

    nowhere = jnp.full((), jnp.inf, start.dtype)
    state = (
        _Reached(start, nowhere, nowhere),
        jnp.zeros_like(start),
        jnp.asarray(True),
        jnp.asarray(0),
    )
    best, *_ = jax.lax.while_loop(lambda state: state[2] & (state[3] <= _STEPS), step, state)
    floor = (_FLOOR * float(jnp.finfo(start.dtype).eps)) ** 2
    return best.point, best.gain <= _GAIN * best.cost + floor


class _Reached(eqx.Module):
    point: Float[Array, " gaussians"]
    cost: Float[Array, ""]
    gain: Float[Array, ""]


def _gain(expansion: Expansion) -> Float[Array, ""]:
    """Give by how much the sum of squares would fall if the residuals were linear: sound in
    float32, where the Hessian is not.
    """
    normal = expansion.normal()
    squared = jnp.diagonal(normal)
    lengths = jnp.sqrt(jnp.where(squared > 0, squared, jnp.ones_like(squared)))
    # Not half the gradient: the Jacobian is orthogonal to the basis, so that the rounding of the
    # weights does not count.
    along = jnp.einsum("cnk,cn->k", expansion.jacobian, expansion.residuals) / lengths
    return along @ invert_moving(normal / (lengths[:, None] * lengths[None])) @ along
