"""From a coarse grid of surface points to the pixels, across the surface and not across its silhouettes."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Samples(eqx.Module):
    """One surface point per block of pixels, with the layer's value there and its slope in space (1/mm)."""

    points: Float[Array, "3 rows columns"]
    there: Bool[Array, "rows columns"]
    values: Float[Array, "channels rows columns"]
    slopes: Float[Array, "3 channels rows columns"]


def _blocks(planes: Float[Array, "planes height width"], stride: int, fill) -> Float[Array, "planes rows columns pixels"]:
    count, height, width = planes.shape
    rows, columns = -(-height // stride), -(-width // stride)
    padded = jnp.pad(planes, ((0, 0), (0, rows * stride - height), (0, columns * stride - width)), constant_values=fill)
    blocks = padded.reshape(count, rows, stride, columns, stride).transpose(0, 1, 3, 2, 4)
    return blocks.reshape(count, rows, columns, stride * stride)


def block_samples(
    points: Float[Array, "3 height width"], covered: Bool[Array, "height width"], stride: int
) -> tuple[Float[Array, "3 rows columns"], Bool[Array, "rows columns"]]:
    """Choose in every block the covered pixel nearest its middle. The choice is not differentiated, the point is."""
    middle = (jnp.arange(stride, dtype=points.dtype) - 0.5 * (stride - 1)) ** 2
    distance = (middle[:, None] + middle[None]).reshape(-1)
    there = _blocks(covered[None], stride, False)[0]
    choice = jnp.argmin(jnp.where(there, distance[None, None], jnp.inf), axis=-1)
    chosen = jnp.take_along_axis(_blocks(points, stride, 0.0), choice[None, ..., None], axis=-1)[..., 0]
    return chosen, jnp.any(there, axis=-1)


def resample(
    samples: Samples, points: Float[Array, "3 height width"], variance: Float[Array, ""], stride: int
) -> Float[Array, "channels height width"]:
    r"""Blend the samples of the nine blocks around each pixel.

    A sample counts by a quadratic spline in the picture, and by how near it is in space (within a standard deviation of the
    layer), so that nothing leaks across a silhouette. It is continued along half its slope: the full slope errs by as much
    as none does, with the other sign.
    """
    height, width = points.shape[1:]
    rows, columns = samples.there.shape
    at = (jnp.arange(stride, dtype=points.dtype) + 0.5) / stride - 0.5
    spline = jnp.stack([0.5 * (0.5 - at) ** 2, 0.75 - at * at, 0.5 * (0.5 + at) ** 2])
    planes = jnp.concatenate(
        [
            samples.points,
            samples.there[None].astype(points.dtype),
            samples.values,
            samples.slopes.reshape(-1, rows, columns),
        ]
    )
    around = jnp.pad(planes, ((0, 0), (1, 1), (1, 1)))
    channels = samples.values.shape[0]
    padded = jnp.pad(points, ((0, 0), (0, rows * stride - height), (0, columns * stride - width)), mode="edge")
    pixel = padded.reshape(3, rows, stride, columns, stride)
    total = jnp.zeros((channels, rows, stride, columns, stride), points.dtype)
    weights = jnp.zeros((rows, stride, columns, stride), points.dtype)
    for i in range(3):
        for j in range(3):
            near = around[:, i : i + rows, j : j + columns][:, :, None, :, None]
            offset = pixel - near[:3]
            squared = jnp.sum(offset * offset, axis=0) / variance
            close = 1 / (1 + squared * squared)
            close = close * close
            weight = spline[i][None, :, None, None] * spline[j][None, None, None] * near[3] * (close + 1e-12)
            slopes = near[4 + channels :].reshape(3, channels, rows, 1, columns, 1)
            value = near[4 : 4 + channels] + 0.5 * close[None] * jnp.sum(slopes * offset[:, None], axis=0)
            total = total + weight[None] * value
            weights = weights + weight
    there = weights > 0
    blended = jnp.where(there[None], total / jnp.where(there, weights, 1.0)[None], 0.0)
    return blended.reshape(channels, rows * stride, columns * stride)[:, :height, :width]
