"""How far one picture is from another."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax import shading as _shading
from splatjax.scene import Frame

_WINDOW, _RADIUS = 1.5, 5  # pixels: standard deviation and reach of the window
_STABLE = (0.01, 0.03)


class Off(eqx.Module):
    r"""By how much points are off, each by its worst channel, of the truth's root mean square per
    channel.

    **Attributes:** `median`, `most` (the 99th percentile), `largest`, and `rms`, the root mean
    square of all channels.
    """

    median: float
    most: float
    largest: float
    rms: float

    @classmethod
    def of(
        cls,
        found: Float[np.ndarray, "points channels"],
        truth: Float[np.ndarray, "points channels"],
    ) -> "Off":
        """Compare points."""
        off = (found - truth) / np.sqrt(np.mean(truth**2, axis=0))[None]
        worst = np.max(np.abs(off), axis=1)
        return cls(
            float(np.median(worst)),
            float(np.quantile(worst, 0.99)),
            float(worst.max()),
            float(np.sqrt(np.mean(off**2))),
        )


def exitance(frame: Frame) -> Float[Array, "height width channels"]:
    """Give the radiant exitance of a picture before the albedo colors what leaves; of a surface
    that reflects nothing itself.

    What is left is how light has spread: the weighted layers `L_k`; 0 where there is nothing.
    """
    there = frame.coverage > 0
    share = jnp.where(there, frame.coverage, 1.0)[..., None]
    spread = jnp.pi * frame.diffuse / (share * _shading.albedo_root(frame.albedo / share))
    return jnp.where(there[..., None], spread, 0.0)


def similarity(
    first: Float[Array, "height width channels"], second: Float[Array, "height width channels"]
) -> Float[Array, ""]:
    r"""Give the mean structural similarity (SSIM) of two pictures whose values lie between 0 and 1.

    Means, variances and covariance are taken in a Gaussian window of standard deviation 1.5 pixels,
    whole windows alone, and the channels are averaged. Differentiable.

    **Returns:** at most 1, which it is for equal pictures.

    **Source:** Wang, Bovik, Sheikh and Simoncelli 2004.
    """
    line = jnp.arange(-_RADIUS, _RADIUS + 1, dtype=first.dtype)
    window = jnp.exp(-0.5 * (line / _WINDOW) ** 2)
    window = window / jnp.sum(window)

    def mean(picture):
        for axis in (0, 1):
            size = picture.shape[axis] - 2 * _RADIUS
            parts = [weight * _cut(picture, i, size, axis) for i, weight in enumerate(window)]
            picture = sum(parts[1:], parts[0])
        return picture

    mean_a, mean_b = mean(first), mean(second)
    variance_a, variance_b = mean(first * first) - mean_a**2, mean(second * second) - mean_b**2
    covariance = mean(first * second) - mean_a * mean_b
    bright, contrast = (share**2 for share in _STABLE)
    alike = (2 * mean_a * mean_b + bright) * (2 * covariance + contrast)
    return jnp.mean(
        alike / ((mean_a**2 + mean_b**2 + bright) * (variance_a + variance_b + contrast))
    )


def _cut(picture, begin: int, size: int, axis: int):
    return picture[begin : begin + size] if axis == 0 else picture[:, begin : begin + size]
