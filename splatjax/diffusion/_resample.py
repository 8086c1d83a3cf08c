"""From a coarse grid of surface points to the pixels, across the surface and not across its silhouettes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped


class Samples(eqx.Module):
    """One surface point per block of pixels, with the layer's value there and its slope in space (1/mm)."""

    points: Float[Array, "3 rows columns"]
    there: Bool[Array, "rows columns"]
    values: Float[Array, "channels rows columns"]
    slopes: Float[Array, "3 channels rows columns"]


def _blocks(planes: Shaped[Array, "planes height width"], stride: int, fill) -> Shaped[Array, "planes rows columns pixels"]:
    count, height, width = planes.shape
    rows, columns = -(-height // stride), -(-width // stride)
    padded = jnp.pad(planes, ((0, 0), (0, rows * stride - height), (0, columns * stride - width)), constant_values=fill)
    blocks = padded.reshape(count, rows, stride, columns, stride).transpose(0, 1, 3, 2, 4)
    return blocks.reshape(count, rows, columns, stride * stride)


def block_samples(
    points: Float[Array, "3 height width"], covered: Bool[Array, "height width"], stride: int, variance: Float[Array, ""]
) -> tuple[Float[Array, "3 rows columns"], Bool[Array, "rows columns"]]:
    """Choose a point per block: between its four middle pixels if they see one surface, else at the covered pixel nearest them.

    The choice is not differentiated, the point is.
    """
    middle = (jnp.arange(stride, dtype=points.dtype) - 0.5 * (stride - 1)) ** 2
    distance = (middle[:, None] + middle[None]).reshape(-1)
    blocks = _blocks(points, stride, 0.0)
    there = _blocks(covered[None], stride, False)[0]
    choice = jnp.argmin(jnp.where(there, distance[None, None], jnp.inf), axis=-1)
    nearest = jnp.take_along_axis(blocks, choice[None, ..., None], axis=-1)[..., 0]
    low = stride // 2 - 1
    four = np.asarray([(low + i) * stride + low + j for i in (0, 1) for j in (0, 1)])
    between = 0.25 * jnp.sum(blocks[..., four], axis=-1)
    apart = jnp.sum((blocks[..., four] - between[..., None]) ** 2, axis=0)
    together = jnp.all(there[..., four] & (apart < 0.25 * variance), axis=-1)
    return jnp.where(together[None], between, nearest), jnp.any(there, axis=-1)


def resample(
    samples: Samples, points: Float[Array, "3 height width"], variance: Float[Array, ""], stride: int
) -> Float[Array, "channels height width"]:
    r"""Blend the samples of the nine blocks around each pixel.

    A sample counts by a quadratic spline in the picture, and by how near it is in space (within a standard deviation of the
    layer), so that nothing leaks across a silhouette. It is continued along half its slope: the full slope errs by as much
    as none does, with the other sign, so that the error is of third order in the size of a block.
    """
    height, width = points.shape[1:]
    rows, columns = samples.there.shape
    channels = samples.values.shape[0]
    at = (np.arange(stride) + 0.5) / stride - 0.5
    spline = jnp.asarray(np.stack([0.5 * (0.5 - at) ** 2, 0.75 - at * at, 0.5 * (0.5 + at) ** 2]), points.dtype)
    low = [samples.points, samples.there[None].astype(points.dtype), samples.values, samples.slopes.reshape(-1, rows, columns)]
    around = jnp.pad(jnp.concatenate(low), ((0, 0), (1, 1), (1, 1)))
    # One picture per place in the block, columns last, so that a block's neighbors are a shift of whole rows.
    pixel = [_phases(axis, rows, columns, stride) for axis in points]

    def look(near):
        """Give the offset from a block's sample to each pixel, and how near they are: 1 at the sample, 0 far away."""
        offset = [axis - center for axis, center in zip(pixel, near[:3], strict=True)]
        squared = (offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2) / variance
        close = 1 / (1 + squared * squared)
        return offset, close * close

    def rise(near, channel: int, offset):
        slope = near[4 + channels + channel :: channels]
        return slope[0] * offset[0] + slope[1] * offset[1] + slope[2] * offset[2]

    @jax.checkpoint
    def add_neighbor(sums, tap):
        total, away, weights = sums
        i, j = tap // 3, tap % 3
        near = jax.lax.dynamic_slice(around, (jnp.zeros_like(i), i, j), (around.shape[0], rows, columns))[:, None, None]
        offset, close = look(near)
        across = spline[i][:, None, None, None] * spline[j][None, :, None, None]
        weight = across * near[3] * (close + 1e-12)
        half = 0.5 * close
        added = [
            total[channel] + weight * (near[4 + channel] + half * rise(near, channel, offset)) for channel in range(channels)
        ]
        return (tuple(added), tuple(a + weight * o for a, o in zip(away, offset, strict=True)), weights + weight), None

    zero = jnp.zeros_like(pixel[0])
    start = (zero,) * channels, (zero,) * 3, zero
    (total, away, weights), _ = jax.lax.scan(add_neighbor, start, jnp.arange(9, dtype=jnp.int32))
    there = weights > 0
    inverse = jnp.where(there, 1 / jnp.where(there, weights, 1.0), 0.0)
    # Where neighbors are missing (borders, silhouettes) the offsets do not cancel: the other half of the slope makes up for it.
    own = around[:, None, None, 1 : 1 + rows, 1 : 1 + columns]
    _, close = look(own)
    half = 0.5 * close * own[3]
    blended = [(each + half * rise(own, channel, away)) * inverse for channel, each in enumerate(total)]
    planes = [each.transpose(2, 0, 3, 1).reshape(rows * stride, columns * stride) for each in blended]
    return jnp.stack(planes)[:, :height, :width]


def _phases(
    plane: Float[Array, "height width"], rows: int, columns: int, stride: int
) -> Float[Array, "stride stride rows columns"]:
    height, width = plane.shape
    padded = jnp.pad(plane, ((0, rows * stride - height), (0, columns * stride - width)), mode="edge")
    return padded.reshape(rows, stride, columns, stride).transpose(1, 3, 0, 2)
