"""The derivative of a fit, and whether it is one: the point where the gradient of Eq. 3 vanishes."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._dense import invert
from ._problem import Problem

_GAIN = 1e-6
"""A fit has converged when a Newton step would lower the sum of squares by less than this share of it,"""

_FLOOR = 100.0
"""or by less than the square of this many units of rounding of the profile's norm: there is no more in the numbers."""


def stationary(problem: Problem, found: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
    r"""Give `found` with the derivative that the implicit function theorem gives it.

    `g(log_variances, profile) = 0` at the optimum, so `d log_variances = -H^-1 dg`, where `H`, the derivative of `g`, is the full
    Hessian of Eq. 3 after the weights are eliminated (not that of Gauss and Newton). Forward and reverse mode.
    """

    def tangent_solve(linear, tangent):
        hessian = jax.vmap(linear, out_axes=1)(jnp.eye(tangent.shape[0], dtype=tangent.dtype))
        return invert(hessian) @ tangent

    found = jax.lax.stop_gradient(found)
    return jax.lax.custom_root(lambda point: problem.gradient(point), found, lambda _, guess: guess, tangent_solve)


def has_converged(problem: Problem, found: Float[Array, " gaussians"]) -> Bool[Array, ""]:
    """Give whether no small step could improve the fit by more than rounding or a millionth."""
    problem, found = jax.lax.stop_gradient((problem, found))
    gradient = problem.gradient(found)
    hessian = jax.jacfwd(problem.gradient)(found)
    gain = 0.5 * gradient @ invert(hessian) @ gradient
    cost = jnp.sum(problem.residuals(found) ** 2)
    floor = (_FLOOR * float(jnp.finfo(cost.dtype).eps)) ** 2
    return jnp.isfinite(gain) & (jnp.abs(gain) <= _GAIN * cost + floor)
