"""Gaussian blurs of pictures along one axis, with a width per pixel."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Trust = Callable[[Float[Array, "height width"]], Float[Array, "height width"]]


class BlurSums(eqx.Module):
    """The weighted sums of a blur at each pixel."""

    sums: Float[Array, "rows height width"]
    """Weighted sums of trusted values."""
    trusted: Float[Array, "height width"]
    """Weight of trusted taps."""
    total: Float[Array, "height width"]
    """Weight of all taps."""

    def renormalized(self) -> Float[Array, "rows height width"]:
        """Compute the mean over trusted taps; 0 where there are none."""
        is_trusted = self.trusted > 0
        return jnp.where(
            is_trusted[None], self.sums / jnp.where(is_trusted, self.trusted, 1.0)[None], 0.0
        )

    def filled(
        self, values: Float[Array, "rows height width"]
    ) -> Float[Array, "rows height width"]:
        """Compute the mean over all taps, with the pixel's own value in place of untrusted ones."""
        return (self.sums + (self.total - self.trusted)[None] * values) / self.total[None]


def blur_along(
    axis: int,
    values: Float[Array, "rows height width"],
    guide: Float[Array, "height width"],
    trust: Trust,
    variance: Float[Array, "height width"],
    reach: int,
) -> BlurSums:
    r"""Gather along one axis by Gaussian weights, `sum_s exp(-s^2 / 2 variance) trust(guide(x + s))
    values(x + s)`.

    Taps are on whole pixels, so that they miss no detail of the picture. Sampled weights of a
    Gaussian narrower than a pixel have too small a variance; these are corrected to the given one.

    **Arguments:**

    - `axis`: 0 gathers from above and below, 1 from the left and the right. Static.
    - `values`: Differentiable.
    - `guide`: a picture from which `trust` computes the weight of a tap; beyond the picture it is
      0.
    - `trust`: computes the trust in a tap, in [0, 1], from its guide; it must be 0 for a guide of
      0.
    - `variance`: variance at each pixel, pixels^2, at least 0. Differentiable except at 1/2, where
      the result jumps by 0.4%.
    - `reach`: the farthest tap, pixels. Static.

    **Returns:** `BlurSums`.
    """
    pad = [(0, 0), (0, 0)]
    pad[axis] = (reach, reach)
    size = values.shape[axis + 1]
    around, guides = jnp.pad(values, [(0, 0), *pad]), jnp.pad(guide, pad)
    rate = _rate(variance)

    def shifted(step):
        tap = jax.lax.dynamic_slice_in_dim(around, reach + step, size, axis + 1)
        return tap, trust(jax.lax.dynamic_slice_in_dim(guides, reach + step, size, axis))

    @jax.checkpoint
    def add(sums, step):
        weight = jnp.exp(-rate * step.astype(rate.dtype) ** 2)
        for tap, trusted in (shifted(step), shifted(-step)):
            counted = weight * trusted
            sums = BlurSums(
                sums.sums + counted[None] * tap, sums.trusted + counted, sums.total + weight
            )
        return sums, None

    trusted = trust(guide)
    start = BlurSums(trusted[None] * values, trusted, jnp.ones_like(rate))
    sums, _ = jax.lax.scan(add, start, jnp.arange(1, reach + 1, dtype=jnp.int32))
    return sums


def _rate(variance: Float[Array, "height width"]) -> Float[Array, "height width"]:
    """Find the `rate` of weights `exp(-rate s^2)` on whole pixels that have a given variance."""
    narrow = variance < 0.5
    v = jnp.where(narrow, variance, 0.25)
    q = v / (2 * (1 - v))  # exp(-rate): of three taps the variance is 2 q / (1 + 2 q)
    for _ in range(4):  # and of five
        q = 0.5 * v * (1 + 2 * q + 2 * q**4) - 4 * q**4
    return jnp.where(
        narrow, -jnp.log(jnp.maximum(q, 1e-12)), 0.5 / jnp.where(narrow, 1.0, variance)
    )
