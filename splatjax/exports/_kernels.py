"""Blurs of screen space."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax.gaussians import SumOfGaussians


@jit_unless_traced
def separable_kernel(
    gaussians: SumOfGaussians, samples: int = 25, reach: float | None = None
) -> tuple[Float[Array, " samples"], Float[Array, "samples channels"]]:
    r"""Compute a kernel for separable subsurface scattering: one blur along each axis of the
    screen.

    Offsets are denser toward the middle, `reach sign(t) t^2` for equally spaced `t` from -1 to 1; a
    weight is the profile at the offset times half the distance between the neighbors, and those of
    a channel add up to 1. Two such blurs in turn are not the radial profile, unless it is one
    Gaussian.

    **Arguments:**

    - `gaussians`: Differentiable.
    - `samples`: odd, at least 3.
    - `reach`: largest offset, mm; by default twice the root of the mean squared distance per axis
      of the widest channel.

    **Returns:** offsets, mm, ascending, and the weights at them.

    **Raises:** `ValueError` for an even number of samples, or fewer than 3.

    **Source:** Jimenez et al. 2015, "Separable subsurface scattering", and the code that comes with
    it.
    """
    if samples < 3 or samples % 2 == 0:
        raise ValueError(
            f"samples must be odd and at least 3, so that one is in the middle; got {samples}"
        )
    if reach is None:
        farthest = 2 * jnp.sqrt(
            jnp.max(gaussians.variances @ gaussians.weights / gaussians.total_reflectance())
        )
    else:
        farthest = jnp.asarray(reach, gaussians.variances.dtype)
    t = jnp.linspace(-1.0, 1.0, samples, dtype=gaussians.variances.dtype)
    offsets = farthest * jnp.sign(t) * t * t
    steps = jnp.diff(offsets)
    widths = 0.5 * (jnp.append(steps, 0.0) + jnp.insert(steps, 0, 0.0))
    weights = widths[:, None] * gaussians(offsets)
    return offsets, weights / jnp.sum(weights, axis=0)[None]
