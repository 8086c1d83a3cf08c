"""The weight of a fragment (Eq. 1) and what it leaves uncovered."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._smooth import smooth_step

_AT_RIM = math.exp(-4.0)


def fragment_weight(squared_radius: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Compute the Gaussian weight of a fragment in object space, `exp(-4 rho^2)`, tapered at the
    rim.

    Its tangent at the rim is taken off, `exp(-4 q) - exp(-4) (5 - 4 q)` with `q = rho^2`, so that
    value and derivative reach zero there, and the weight is positive inside.

    **Arguments:** `squared_radius`: `rho^2` in units of the splat's radius, in [0, 1].
    Differentiable.

    **Returns:** 0.908 at the center, 0 at the rim.
    """
    return jnp.exp(-4 * squared_radius) - _AT_RIM * (5 - 4 * squared_radius)


def fragment_weight_derivative(
    squared_radius: Float[Array, "..."], weight: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Compute the derivative of `fragment_weight` in `rho^2`, from the weight itself."""
    return -4 * weight - 16 * _AT_RIM * (1 - squared_radius)


# The root of weight / (1 - rho^2)^2 as a polynomial, highest power first: the weight is within
# 6e-7.
_ROOT = (
    0.00836205691,
    -0.0539352847,
    0.188329054,
    -0.469631159,
    0.863365958,
    -1.10681572,
    0.95311135,
)


def fast_fragment_weight(squared_radius: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute `fragment_weight`, exactly 0 at the rim; in float32 by a polynomial, which costs a
    third of the exponential.
    """
    if squared_radius.dtype != jnp.float32:
        return jnp.where(squared_radius < 1, fragment_weight(squared_radius), 0.0)
    root = _ROOT[0]
    for coefficient in _ROOT[1:]:
        root = root * squared_radius + coefficient
    root = root * (1 - squared_radius)
    return root * root


def coverage(weight_sum: Float[Array, "..."], full: float) -> Float[Array, "..."]:
    """Compute the fraction of a pixel that a surface covers: a smooth step of the sum of its
    weights, 1 from `full` on.
    """
    return smooth_step(weight_sum, 0, full)
