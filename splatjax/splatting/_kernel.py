"""The weight of a fragment (Eq. 1) and what it leaves uncovered."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

_AT_RIM = math.exp(-4.0)


def fragment_weight(squared_radius: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Give the Gaussian weight of a fragment in object space, `exp(-4 rho^2)`, tapered at the rim.

    Its tangent at the rim is taken off, `exp(-4 q) - exp(-4) (5 - 4 q)` with `q = rho^2`, so that value and derivative
    reach zero there, and the weight is positive inside.

    **Arguments:** `squared_radius`: `rho^2` in units of the splat's radius, in [0, 1]. Differentiable.

    **Returns:** 0.908 at the center, 0 at the rim.
    """
    return jnp.exp(-4 * squared_radius) - _AT_RIM * (5 - 4 * squared_radius)


def fragment_weight_derivative(squared_radius: Float[Array, "..."]) -> Float[Array, "..."]:
    """Give the derivative of `fragment_weight` in `rho^2`."""
    return -4 * jnp.exp(-4 * squared_radius) + 4 * _AT_RIM


def coverage(weight_sum: Float[Array, "..."], full: float) -> Float[Array, "..."]:
    """Give the share of a pixel that a surface covers: a smooth step of the sum of its weights, 1 from `full` on."""
    t = jnp.clip(weight_sum / full, 0, 1)
    return t * t * (3 - 2 * t)
