"""Which blocks of sources lie near which blocks of points, found once for a geometry."""

import math
from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.splatting import round_up

from ._gaussian_sums import Steps

_AT_ONCE = 1 << 20  # pairs of boxes tested together
_FAN = 32  # blocks of sources tested as one at first


class Boxes(eqx.Module):
    """Boxes around blocks of points; an empty block's is inside out."""

    low: Float[Array, "3 blocks"]
    high: Float[Array, "3 blocks"]

    @classmethod
    def around(cls, points: Float[Array, "3 points"], there, block: int) -> "Boxes":
        points = stop_gradient(points)
        low, high = jnp.where(there, points, jnp.inf), jnp.where(there, points, -jnp.inf)
        return cls(
            jnp.min(low.reshape(3, -1, block), axis=2), jnp.max(high.reshape(3, -1, block), axis=2)
        )

    def beyond(self, planned: "Boxes") -> Float[Array, ""]:
        """Give how far (mm, along an axis) these boxes reach beyond others of the same blocks."""
        out = jnp.maximum(planned.low - self.low, self.high - planned.high)
        return jnp.maximum(
            jnp.max(jnp.where(self.low <= self.high, out, -jnp.inf), initial=-jnp.inf), 0
        )


class Neighbors(eqx.Module):
    """For every block of points the blocks of sources within reach, and what the search
    rested on.
    """

    steps: Steps
    points: Boxes
    sources: Boxes
    reach: Float[Array, ""]

    @classmethod
    def find(
        cls, points: Boxes, sources: Boxes, reach: float, lanes: int, slots: int
    ) -> "Neighbors":
        """Search once; `reach` in mm. The number of steps is rounded up, so that nearby geometries
        need no other program.
        """
        low, high = (np.asarray(each.T, np.float64) for each in (sources.low, sources.high))
        blocks = points.low.shape[1]
        of_points = (np.asarray(each.T, np.float64) for each in (points.low, points.high))
        of, near = (
            np.concatenate(each) for each in zip(*_near(*of_points, low, high, reach), strict=True)
        )
        counts = np.bincount(of, minlength=blocks)
        begins = np.concatenate([[0], np.cumsum(counts)[:-1]])
        lengths = -(-counts // slots)
        sweeps = -(-blocks // lanes)
        longest = np.max(
            np.pad(lengths, (0, sweeps * lanes - blocks)).reshape(sweeps, lanes), axis=1
        )
        last = np.cumsum(longest)
        ids = np.full((round_up(int(last[-1]), 1), lanes, slots), len(low), np.int32)
        within = np.arange(len(of)) - begins[of]
        ids[(last - longest)[of // lanes] + within // slots, of % lanes, within % slots] = near
        order = np.arange(sweeps * lanes)
        steps = Steps(
            *(jnp.asarray(each, jnp.int32) for each in (ids, last - longest, last, order))
        )
        return cls(steps, points, sources, jnp.asarray(reach, points.low.dtype))

    def needed(self, points: Boxes, sources: Boxes, reach: Float[Array, ""]) -> Float[Array, ""]:
        """Give above 1 where sources within `reach` (mm) of these points may be missing."""
        moved = points.beyond(self.points) + sources.beyond(self.sources)
        return (reach + math.sqrt(3) * moved) / self.reach


def _near(
    point_low, point_high, low, high, reach: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of blocks of points and of sources whose boxes are within reach, by block of
    points.
    """
    fans = -(-len(low) // _FAN)
    padding = ((0, fans * _FAN - len(low)), (0, 0))
    low, high = (
        np.pad(low, padding, constant_values=np.inf),
        np.pad(high, padding, constant_values=-np.inf),
    )
    fan_low, fan_high = (
        low.reshape(fans, _FAN, 3).min(axis=1),
        high.reshape(fans, _FAN, 3).max(axis=1),
    )
    step = max(_AT_ONCE // max(fans, 1), 1)
    for begin in range(0, len(point_low), step):
        part = slice(begin, begin + step)
        block, fan = np.nonzero(
            _within(
                point_low[part, None], point_high[part, None], fan_low[None], fan_high[None], reach
            )
        )
        block = np.repeat(block + begin, _FAN)
        source = (fan[:, None] * _FAN + np.arange(_FAN)).reshape(-1)
        near = _within(point_low[block], point_high[block], low[source], high[source], reach)
        yield block[near], source[near]


def _within(low_a, high_a, low_b, high_b, reach: float) -> np.ndarray:
    apart = np.maximum(np.maximum(low_a - high_b, low_b - high_a), 0)
    return np.sum(apart * apart, axis=-1) <= reach * reach
