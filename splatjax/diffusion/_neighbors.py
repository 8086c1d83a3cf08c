"""Lists of the blocks of sources near each block of points: found once for a geometry; swept."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from splatjax.splatting import round_up

SOURCES = 8
"""Sources of a block."""
WIDTH = 16
"""Blocks of sources in a row of a list."""
LANES = 64
"""Blocks of points that are swept together."""
_AT_ONCE = 1 << 18  # pairs of boxes whose parts are tested together
_FAN = 4  # parts of a box of a coarser level


class Lists(eqx.Module):
    """Which blocks of sources the blocks of points meet. Not differentiated.

    **Attributes:**

    - `rows`: blocks of sources, so many to a row; the number of blocks, whose block is empty, in
      what is left of a row, and in the last row.
    - `first`, `counts`: the rows of each block of points.
    - `order`: of the blocks of points, those with the longest lists first.
    """

    rows: Int[Array, "rows width"]
    first: Int[Array, " points_blocks"]
    counts: Int[Array, " points_blocks"]
    order: Int[Array, " points_blocks"]

    def only(self, blocks: Int[Array, " some"]) -> "Lists":
        """Leave out all other blocks of points."""
        chosen = jnp.zeros(len(self.counts), bool).at[blocks].set(True, mode="drop")
        counts = jnp.where(chosen, self.counts, 0)
        order = self.order[jnp.argsort(counts[self.order] == 0)]
        return Lists(self.rows, self.first, counts, order)

    def sweep(self, sweep: Callable, out):
        """Apply `sweep(lanes, out)` to all blocks with a list."""
        blocks = len(self.order)
        lanes = min(LANES, blocks)
        order = jnp.pad(self.order, (0, -blocks % lanes), constant_values=blocks)
        sweeps = (jnp.sum(self.counts > 0) + lanes - 1) // lanes

        def step(i, out):
            blocks = lax.dynamic_slice_in_dim(order, i * lanes, lanes)
            first, counts = (
                each.at[blocks].get(mode="fill", fill_value=0) for each in (self.first, self.counts)
            )
            return sweep(Lanes(blocks, first, counts), out)

        return lax.fori_loop(jnp.zeros_like(sweeps), sweeps, step, out)


class Lanes(eqx.Module):
    """Blocks of points that are swept together, and their lists; the number of blocks in a lane
    without one.
    """

    blocks: Int[Array, " lanes"]
    first: Int[Array, " lanes"]
    counts: Int[Array, " lanes"]

    def read(self, rows: Float[Array, "points_blocks ..."], fill=0.0):
        return rows.at[self.blocks].get(mode="fill", fill_value=fill)

    def write(self, rows: Float[Array, "points_blocks ..."], values):
        return rows.at[self.blocks].set(values, mode="drop")

    def each_row(self, lists: Lists, add: Callable, start):
        """Apply `add(ids, carry)` to the blocks of sources `[lanes, width]` of row after row."""

        def step(i, carry):
            row = jnp.where(i < self.counts, self.first + i, len(lists.rows) - 1)
            return add(lists.rows.at[row].get(mode="promise_in_bounds"), carry)

        return lax.fori_loop(0, jnp.max(self.counts), step, start)


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

    lists: Lists
    points: Boxes
    sources: Boxes
    reach: Float[Array, ""]

    def needed(self, points: Boxes, sources: Boxes, reach: Float[Array, ""]) -> Float[Array, ""]:
        """Compute a number above 1 if sources within `reach` (mm) of points may be missing."""
        moved = points.beyond(self.points) + sources.beyond(self.sources)
        return (reach + math.sqrt(3) * moved) / self.reach


def find_neighbors(points: Boxes, sources: Boxes, reach: float) -> Lists:
    """Search for the blocks of sources within `reach` (mm) of every block of points.

    The number of rows is rounded up, so that nearby geometries need no other program. Not for
    traced arrays.
    """
    of, near = _pairs_in_reach(_levels(points), _levels(sources), reach)
    blocks, empty = points.low.shape[0], sources.low.shape[0]
    by_block = np.argsort(of, kind="stable")
    of, near = of[by_block], near[by_block]
    lengths = np.bincount(of, minlength=blocks)
    counts = -(-lengths // WIDTH)
    first, begins = (np.cumsum(each) - each for each in (counts, lengths))
    ids = np.full((round_up(int(counts.sum()), 1), WIDTH), empty, np.int32)
    ids.reshape(-1)[(first * WIDTH - begins)[of] + np.arange(len(of))] = near
    order = np.argsort(-counts, kind="stable")
    return Lists(*(jnp.asarray(each, jnp.int32) for each in (ids, first, counts, order)))


def _levels(boxes: Boxes) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the corners `[3, boxes]` of boxes, and of ever coarser boxes around `_FAN` of them;
    empty boxes fill each level.
    """
    levels = [(np.asarray(boxes.low).T, np.asarray(boxes.high).T)]
    while True:
        corners = []
        for rows, empty in zip(levels[-1], (np.inf, -np.inf), strict=True):
            lacking = ((0, 0), (0, -rows.shape[1] % _FAN))
            corners.append(np.pad(rows, lacking, constant_values=empty))
        levels[-1] = low, high = corners[0], corners[1]
        if low.shape[1] <= _FAN:
            return levels
        coarser = low.reshape(3, -1, _FAN).min(axis=2), high.reshape(3, -1, _FAN).max(axis=2)
        levels.append(coarser)


def _pairs_in_reach(points: list, sources: list, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the pairs of boxes of the finest levels that are in reach of each other."""
    none, level = np.zeros(0, np.int32), max(len(points), len(sources)) - 1
    found = [(none, none)]
    own, other = (np.arange(each[-1][0].shape[1], dtype=np.int32) for each in (points, sources))
    todo = [(level, *(each.reshape(-1) for each in np.meshgrid(own, other)))]
    while todo:
        level, own, other = todo.pop()
        corners = *_taken(points, level, own), *_taken(sources, level, other)
        near = np.flatnonzero(_are_in_reach(*corners, reach))
        own, other = own[near], other[near]
        if level == 0:
            found.append((own, other))
            continue
        for begin in range(0, len(near), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            own_parts = _parts(points, level, own[part])[:, :, None]
            parts = np.broadcast_arrays(own_parts, _parts(sources, level, other[part])[:, None])
            todo.append((level - 1, *(each.reshape(-1) for each in parts)))
    own, other = (np.concatenate(each) for each in zip(*found, strict=True))
    return own, other


def _taken(levels: list, level: int, boxes: np.ndarray) -> list[np.ndarray]:
    """Read the corners of boxes of a level, of the coarsest one if there are not so many."""
    return [rows[:, boxes] for rows in levels[min(level, len(levels) - 1)]]


def _parts(levels: list, level: int, boxes: np.ndarray) -> np.ndarray:
    """Return the parts of each box, of the next finer level."""
    if level >= len(levels):
        return boxes[:, None]
    return boxes[:, None] * _FAN + np.arange(_FAN, dtype=boxes.dtype)


def _are_in_reach(low_a, high_a, low_b, high_b, reach: float) -> np.ndarray:
    apart = np.maximum(np.maximum(low_a - high_b, low_b - high_a), 0)
    return np.sum(apart * apart, axis=0) <= reach * reach
