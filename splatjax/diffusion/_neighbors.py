"""Which blocks of sources lie near which blocks of points, found once for a geometry."""

import math
from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.splatting import round_up

from ._gaussian_sums import Steps

LANES = 64
SLOTS = 8
"""Blocks of sources that each lane meets in a step."""
SOURCES = 16
"""Sources of a block."""
_AT_ONCE = 1 << 20  # pairs of boxes tested together
_FAN = 32  # blocks of sources tested as one at first


class Boxes(eqx.Module):
    """Boxes around blocks of points; an empty block's is inside out."""

    low: Float[Array, "blocks 3"]
    high: Float[Array, "blocks 3"]

    @classmethod
    def around(
        cls, points: Float[Array, "3 points"], exists: Bool[Array, " points"], block: int
    ) -> "Boxes":
        """Enclose the points that exist, `block` of them at a time. Not differentiated."""
        points = stop_gradient(points)
        low, high = (
            jnp.where(exists, points, sign * jnp.inf).reshape(3, -1, block) for sign in (1, -1)
        )
        return cls(jnp.min(low, axis=2).T, jnp.max(high, axis=2).T)

    def beyond(self, planned: "Boxes") -> Float[Array, ""]:
        """Measure how far (mm, along an axis) these boxes reach beyond those planned."""
        out = jnp.maximum(planned.low - self.low, self.high - planned.high)
        out = jnp.where(self.low <= self.high, out, -jnp.inf)
        return jnp.maximum(jnp.max(out, initial=-jnp.inf), 0)


class Neighbors(eqx.Module):
    """The blocks of sources within reach of every block of points, and what the search assumed."""

    steps: Steps
    points: Boxes
    sources: Boxes
    reach: Float[Array, ""]

    def needed(self, points: Boxes, sources: Boxes, reach: Float[Array, ""]) -> Float[Array, ""]:
        """Compute a number above 1 if sources within `reach` (mm) of a point may be missing."""
        moved = points.beyond(self.points) + sources.beyond(self.sources)
        return (reach + math.sqrt(3) * moved) / self.reach


def find_neighbors(points: Boxes, sources: Boxes, reach: float) -> Steps:
    """Search for the blocks of sources within `reach` (mm) of every block of points.

    The number of steps is rounded up, so that nearby geometries need no other program. Not for
    traced arrays.
    """
    boxes = (
        np.asarray(each, np.float64)
        for each in (points.low, points.high, sources.low, sources.high)
    )
    pairs = list(_pairs_in_reach(*boxes, reach))
    of, near = (np.concatenate(each) for each in zip(*pairs, strict=True))
    blocks, empty = points.low.shape[0], sources.low.shape[0]
    lanes = min(LANES, blocks)
    counts = np.bincount(of, minlength=blocks)
    rank = np.arange(len(of)) - (np.cumsum(counts) - counts)[of]
    # Lanes that are swept together have lists of about one length.
    order = np.argsort(-(-counts // SLOTS), kind="stable")
    sweeps = -(-blocks // lanes)
    spare = sweeps * lanes - blocks  # lanes of the last sweep with no block and an empty list
    order = np.concatenate([order, np.arange(blocks, blocks + spare)])
    lane = np.empty(blocks + spare, np.int64)
    lane[order] = np.arange(blocks + spare)
    longest = np.pad(-(-counts // SLOTS), (0, spare))[order].reshape(sweeps, lanes).max(axis=1)
    ends = np.cumsum(longest)
    ids = np.full((round_up(int(ends[-1]), 1), lanes, SLOTS), empty, np.int32)
    step = (ends - longest)[lane[of] // lanes] + rank // SLOTS
    ids[step, lane[of] % lanes, rank % SLOTS] = near
    return Steps(*(jnp.asarray(each, jnp.int32) for each in (ids, ends - longest, ends, order)))


def _pairs_in_reach(
    point_low, point_high, low, high, reach: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of blocks of points and of sources whose boxes are in reach, by block of points.

    Sources are tested many blocks at a time first, then one by one.
    """
    fans = -(-len(low) // _FAN)
    padding = ((0, fans * _FAN - len(low)), (0, 0))
    low, high = (
        np.pad(low, padding, constant_values=np.inf),
        np.pad(high, padding, constant_values=-np.inf),
    )
    fan_low = low.reshape(fans, _FAN, 3).min(axis=1)
    fan_high = high.reshape(fans, _FAN, 3).max(axis=1)
    step = max(_AT_ONCE // max(fans, 1), 1)
    for begin in range(0, len(point_low), step):
        part = slice(begin, begin + step)
        block, fan = np.nonzero(
            _in_reach(point_low[part, None], point_high[part, None], fan_low, fan_high, reach)
        )
        block = np.repeat(block + begin, _FAN)
        source = (fan[:, None] * _FAN + np.arange(_FAN)).reshape(-1)
        near = _in_reach(point_low[block], point_high[block], low[source], high[source], reach)
        yield block[near], source[near]


def _in_reach(low_a, high_a, low_b, high_b, reach: float) -> np.ndarray:
    apart = np.maximum(np.maximum(low_a - high_b, low_b - high_a), 0)
    return np.sum(apart * apart, axis=-1) <= reach * reach
