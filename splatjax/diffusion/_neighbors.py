"""Lists of the blocks of sources near each block of points: search (once a geometry) and sweep."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import with_spare

BLOCKS_PER_ROW = 16  # blocks of sources in a row of a list
LANES = 256  # blocks of points that are swept together
_ROWS = 7  # for every block of points: more than most bodies need, so that they share a program
_AT_ONCE = 1 << 13  # pairs of boxes whose parts are tested together: they stay in cache
_FAN = 4  # parts of a box of a coarser level


class Lists(eqx.Module):
    """The blocks of sources in the lists of the blocks of points, for every layer. Not
    differentiated.

    **Attributes:**

    - `rows`: blocks of sources in rows of fixed length, padded by the number of blocks, whose block
      is empty; so is the last row.
    - `first`, `counts`: the rows of each list: one for every block of points, layer after layer.
    - `order`: of the lists, the longest first.
    """

    rows: Int[Array, "rows width"]
    first: Int[Array, " lists"]
    counts: Int[Array, " lists"]
    order: Int[Array, " lists"]

    def only(self, chosen: Bool[Array, " points_blocks"]) -> "Lists":
        """Remove all other blocks of points."""
        counts = jnp.where(chosen, self.counts.reshape(-1, len(chosen)), 0).reshape(-1)
        # A stable sort: those without a row come last.
        order = self.order[jnp.argsort(counts[self.order] == 0)]
        return Lists(self.rows, self.first, counts, order)

    def sweep(self, sweep: Callable, out):
        """Apply `sweep(lanes, out)` to all lists with a row, `LANES` of them at a time."""
        count = len(self.order)
        lanes = min(LANES, count)
        order = jnp.pad(self.order, (0, -count % lanes), constant_values=count)
        sweeps = (jnp.sum(self.counts > 0) + lanes - 1) // lanes

        def step(i, out):
            of_lanes = jax.lax.dynamic_slice_in_dim(order, i * lanes, lanes)
            first, counts = (
                each.at[of_lanes].get(mode="fill", fill_value=0)
                for each in (self.first, self.counts)
            )
            return sweep(Lanes(of_lanes, first, counts), out)

        return jax.lax.fori_loop(jnp.zeros_like(sweeps), sweeps, step, out)


class Lanes(eqx.Module):
    """Lists that are swept together; the number of lists in a lane without one."""

    lists: Int[Array, " lanes"]
    first: Int[Array, " lanes"]
    counts: Int[Array, " lanes"]

    def read(self, rows: Float[Array, "lists ..."], fill=0.0):
        return rows.at[self.lists].get(mode="fill", fill_value=fill)

    def write(self, rows: Float[Array, "lists ..."], values):
        return rows.at[self.lists].set(values, mode="drop")

    def each_row(self, lists: Lists, add: Callable, start):
        """Apply `add(ids, carry)` to the blocks of sources `[lanes, width]` of row after row."""

        def step(i, carry):
            row = jnp.where(i < self.counts, self.first + i, len(lists.rows) - 1)
            return add(lists.rows.at[row].get(mode="promise_in_bounds"), carry)

        return jax.lax.fori_loop(0, jnp.max(self.counts), step, start)


class Boxes(eqx.Module):
    """Boxes around blocks of points; an empty block's is inside out."""

    low: Float[Array, "blocks 3"]
    high: Float[Array, "blocks 3"]

    @classmethod
    def around(
        cls, points: Float[Array, "3 points"], exists: Bool[Array, " points"], block: int
    ) -> "Boxes":
        """Enclose the points that exist, `block` of them at a time. Not differentiated."""
        points = jax.lax.stop_gradient(points)
        low, high = (
            jnp.where(exists, points, sign * jnp.inf).reshape(3, -1, block) for sign in (1, -1)
        )
        return cls(jnp.min(low, axis=2).T, jnp.max(high, axis=2).T)

    def beyond(self, planned: "Boxes") -> Float[Array, " blocks"]:
        """Measure the distance (mm, along an axis) by which each box exceeds the planned one."""
        out = jnp.maximum(planned.low - self.low, self.high - planned.high)
        return jnp.maximum(jnp.max(jnp.where(self.low <= self.high, out, 0), axis=1), 0)


class Neighbors(eqx.Module):
    """The blocks of sources within reach of every block of points, and the assumptions of the
    search.

    **Attributes:**

    - `layers`: of the blocks of sources.
    - `reaches`: of the layers, mm.
    """

    lists: Lists
    points: Boxes
    sources: Boxes
    layers: Int[Array, " blocks"]
    reaches: Float[Array, " layers"]

    def needed(
        self, points: Boxes, sources: Boxes, reaches: Float[Array, " layers"]
    ) -> Float[Array, ""]:
        """Compute a number above 1 if sources within reach of points may be missing."""
        moved = jax.ops.segment_max(sources.beyond(self.sources), self.layers, len(reaches))
        moved = jnp.maximum(moved, 0) + jnp.max(points.beyond(self.points), initial=0)
        return jnp.max((reaches + math.sqrt(3) * moved) / self.reaches)


def find_neighbors(
    points: Boxes,
    sources: Boxes,
    layers: Int[np.ndarray, " blocks"],
    reaches: Sequence[float],
    parts: int = 1,
    least: int = 0,
) -> Lists:
    """Search for the blocks of sources within reach of every block of points, layer by layer.

    The number of rows is rounded up, so that similar geometries share a program. Not for traced
    arrays.

    **Arguments:**

    - `layers`: of the blocks of sources.
    - `reaches`: of the layers, mm; nothing is in reach of a layer with 0.
    - `parts`: equal parts of the points, each with separate lists, one after the other.
    - `least`: rows of each part.
    """
    low, high = (np.asarray(each) for each in (sources.low, sources.high))
    corners = (np.split(np.asarray(corner), parts) for corner in (points.low, points.high))
    own = [np.flatnonzero(layers == layer) for layer in range(len(reaches))]

    def search(part: tuple, layer: int):
        """Find the pairs of a block of a part and a block of sources."""
        of, near = pairs_in_reach(part, (low[own[layer]], high[own[layer]]), reaches[layer])
        return of, own[layer][near]

    # Only NumPy computes in the threads, since JAX's precision may be set for one thread.
    of_parts = list(zip(*corners, strict=True))
    with ThreadPoolExecutor() as pool:
        pairs = [
            [pool.submit(search, part, layer) for layer in range(len(reaches))] for part in of_parts
        ]
    blocks = len(of_parts[0][0])
    found = [_lists([each.result() for each in part], blocks, len(low)) for part in pairs]
    # At least one row, the last, stays empty: lanes whose list has ended read it.
    lists = len(found[0][1])
    rows = max(len(ids) for ids, *_ in found)
    count = max(least, _ROWS * lists, with_spare(("rows", lists), rows, 1, per_octave=2))
    padded = [
        (np.pad(ids, ((0, count - len(ids)), (0, 0)), constant_values=len(low)), *each)
        for ids, *each in found
    ]
    whole = (np.concatenate(each) for each in zip(*padded, strict=True))
    return Lists(*(jnp.asarray(each, jnp.int32) for each in whole))


def _lists(pairs: Sequence[tuple[np.ndarray, np.ndarray]], blocks: int, empty: int):
    """Return the rows of blocks of sources; for every list its first row and their number; and the
    order of the lists.

    **Arguments:**

    - `pairs`: of each layer, the blocks of points and of sources that are in reach.
    - `blocks`: of points.
    - `empty`: the index for no block of sources.
    """
    of = np.concatenate([layer * blocks + each for layer, (each, _) in enumerate(pairs)])
    near = np.concatenate([each for _, each in pairs])
    by_list = np.argsort(of, kind="stable")
    of, near = of[by_list], near[by_list]
    lengths = np.bincount(of, minlength=blocks * len(pairs))
    counts = -(-lengths // BLOCKS_PER_ROW)
    first, begins = (np.cumsum(each) - each for each in (counts, lengths))
    ids = np.full((counts.sum(), BLOCKS_PER_ROW), empty, np.int32)
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


def pairs_in_reach(points: tuple, sources: tuple, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the pairs of boxes, given by their corners, that are in reach of each other, from coarse
    to fine.
    """
    if not reach:
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
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
