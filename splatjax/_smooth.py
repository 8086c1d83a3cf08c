"""The smooth step, the root of an albedo, and the mean of an exponential."""

import jax.numpy as jnp
from jaxtyping import Array, Float

_ALBEDO_FLOOR = 1e-4


def smooth_step(x, low, high):
    """Compute the smooth step of NumPy or JAX arrays: 0 below `low`, 1 above `high`, a cubic
    between, and the reverse for `low > high`.
    """
    t = ((x - low) / (high - low)).clip(0, 1)
    return t * t * (3 - 2 * t)


def albedo_root(albedo: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute `sqrt(max(albedo, 1e-4))`, the factor of the albedo before and again after diffusion.

    **Arguments:**

    - `albedo`: diffuse color, linear, in [0, 1]. Differentiable; the gradient is `1 / (2
      sqrt(albedo))` above the floor and 0 at and below it, since the derivative of the root itself
      diverges at a black texel.

    **Returns:** at least 0.01. Its square is the albedo, except for texels darker than 1e-4.

    **Source:** d'Eon and Luebke 2007 (GPU Gems 3, chapter 14): pre- and post-scatter texturing in
    equal parts.
    """
    return jnp.sqrt(jnp.where(albedo > _ALBEDO_FLOOR, albedo, _ALBEDO_FLOOR))


def mean_decay(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute `(1 - exp(-x)) / x`, the mean of `exp(-t)` from 0 to x. At 0 it is 1, and its
    derivative is -1/2.
    """
    is_small = x < 1e-2
    small, large = jnp.where(is_small, x, 0.0), jnp.where(is_small, 1.0, x)
    series = 1 - small / 2 * (1 - small / 3 * (1 - small / 4 * (1 - small / 5 * (1 - small / 6))))
    return jnp.where(is_small, series, -jnp.expm1(-large) / large)
