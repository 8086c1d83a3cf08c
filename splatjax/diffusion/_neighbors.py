"""Lists of the blocks of sources near each block of points: found once for a geometry; swept."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import with_spare

SOURCES_PER_BLOCK = 8
"""Sources of a block."""
BLOCKS_PER_ROW = 16
"""Blocks of sources in a row of a list."""
LANES = 128
"""Blocks of points that are swept together."""
_ROWS = 7  # for every block of points: more than most bodies need, so that they share a program
_AT_ONCE = 1 << 13  # pairs of boxes whose parts are tested together: they stay in cache
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
        # A stable sort: blocks without a list come last.
        order = self.order[jnp.argsort(counts[self.order] == 0)]
        return Lists(self.rows, self.first, counts, order)

    def sweep(self, sweep: Callable, out):
        """Apply `sweep(lanes, out)` to all blocks with a list, `LANES` of them at a time."""
        blocks = len(self.order)
        lanes = min(LANES, blocks)
        order = jnp.pad(self.order, (0, -blocks % lanes), constant_values=blocks)
        sweeps = (jnp.sum(self.counts > 0) + lanes - 1) // lanes

        def step(i, out):
            blocks = lax.dynamic_slice_in_dim(order, i * lanes, lanes)
            first, counts = (
                each.at[blocks].get(mode="fill", fill_value=0) for each in (self.first, self.counts)
            )
            return sweep(PointBlocks(blocks, first, counts), out)

        return lax.fori_loop(jnp.zeros_like(sweeps), sweeps, step, out)


class PointBlocks(eqx.Module):
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


def find_neighbors(
    points: Boxes, sources: Boxes, reach: float, parts: int = 1, least: int = 0
) -> Lists:
    """Search for the blocks of sources within `reach` (mm) of every block of points.

    The number of rows is rounded up, so that nearby geometries need no other program. Not for
    traced arrays.

    **Arguments:**

    - `parts`: equal parts of the points, each with lists of its own, one after the other.
    - `least`: rows of each part.
    """
    corners = (np.split(np.asarray(corner), parts) for corner in (points.low, points.high))
    found = [_list(low, high, sources, reach) for low, high in zip(*corners, strict=True)]
    # At least one row, the last, stays empty: lanes whose list has ended read it.
    least = max(least, _ROWS * len(found[0][1]))
    count = max(least, *(with_spare(len(ids), 1, per_octave=2) for ids, *_ in found))
    padded = [
        (np.pad(ids, ((0, count - len(ids)), (0, 0)), constant_values=len(sources.low)), *each)
        for ids, *each in found
    ]
    whole = (np.concatenate(each) for each in zip(*padded, strict=True))
    return Lists(*(jnp.asarray(each, jnp.int32) for each in whole))


def _list(low: np.ndarray, high: np.ndarray, sources: Boxes, reach: float):
    """Return the rows of blocks of sources; for every block of points its first row and their
    number; and the order of the blocks.
    """
    of, near = _pairs_in_reach((low, high), (sources.low, sources.high), reach)
    by_block = np.argsort(of, kind="stable")
    of, near = of[by_block], near[by_block]
    lengths = np.bincount(of, minlength=len(low))
    counts = -(-lengths // BLOCKS_PER_ROW)
    first, begins = (np.cumsum(each) - each for each in (counts, lengths))
    ids = np.full((counts.sum(), BLOCKS_PER_ROW), len(sources.low), np.int32)
    ids.reshape(-1)[(first * BLOCKS_PER_ROW - begins)[of] + np.arange(len(of))] = near
    return ids, first, counts, np.argsort(-counts, kind="stable")


def _levels(corners: tuple, depth: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the corners `[3, parents, parts]` of boxes, `_FAN` of them to a parent, and of ever
    coarser boxes around these; empty boxes fill each level.
    """
    levels, corners = [], tuple(np.asarray(corner).T for corner in corners)
    for _ in range(depth):
        lacking = ((0, 0), (0, -corners[0].shape[1] % _FAN))
        low, high = (
            np.pad(each, lacking, constant_values=empty).reshape(3, -1, _FAN)
            for each, empty in zip(corners, (np.inf, -np.inf), strict=True)
        )
        levels.append((low, high))
        corners = low.min(axis=2), high.max(axis=2)
    return levels


def _pairs_in_reach(points: tuple, sources: tuple, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the pairs of boxes, given by their corners, that are in reach of each other, from coarse
    to fine.
    """
    depth = math.ceil(math.log(max(len(points[0]), len(sources[0]), 2), _FAN))
    each = zip(_levels(points, depth), _levels(sources, depth), strict=True)
    levels = [(*of_points, *of_sources) for of_points, of_sources in each]
    root, none = np.zeros(1, np.int32), np.zeros(0, np.int32)
    todo, found = [(depth - 1, root, root)], [(none, none)]
    while todo:
        level, own, other = todo.pop()
        for begin in range(0, len(own), _AT_ONCE):
            a, b = own[begin : begin + _AT_ONCE], other[begin : begin + _AT_ONCE]
            gaps = (
                np.maximum(
                    low_a[a][:, :, None] - high_b[b][:, None],
                    low_b[b][:, None] - high_a[a][:, :, None],
                )
                for low_a, high_a, low_b, high_b in zip(*levels[level], strict=True)
            )
            squared = sum(np.square(np.maximum(gap, 0)) for gap in gaps)
            pair, part, other_part = np.nonzero(squared <= reach * reach)
            pairs = a[pair] * _FAN + part, b[pair] * _FAN + other_part
            if level == 0:
                found.append(pairs)
            else:
                todo.append((level - 1, *pairs))
    own, other = (np.concatenate(each) for each in zip(*found, strict=True))
    return own, other
