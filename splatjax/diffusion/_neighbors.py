"""Search for the blocks of sources near each block of points, once for a geometry."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import with_spare

BLOCKS_PER_ROW = 16  # blocks of sources in a row of a list
_ROWS = 7  # least rows per list, more than most bodies need, so that bodies share a program
_AT_ONCE = 1 << 13  # pairs of boxes whose parts are tested together, few enough for the cache
_FAN = 4  # parts of a box of a coarser level

Corners = tuple[Float[np.ndarray, "_boxes 3"], Float[np.ndarray, "_boxes 3"]]
Pairs = tuple[Int[np.ndarray, " _pairs"], Int[np.ndarray, " _pairs"]]


class NeighborLists(eqx.Module):
    """The blocks of sources in the lists of the blocks of points, for every layer. Not
    differentiated.

    **Attributes:**

    - `rows`: indices of source blocks, in rows of fixed length; padding is the number of blocks,
      the index of an empty block. The last row is all padding.
    - `first`, `counts`: first row and number of rows of each list, per layer and block of points.
    """

    rows: Int[Array, "rows width"]
    first: Int[Array, " lists"]
    counts: Int[Array, " lists"]


class Boxes(eqx.Module):
    """Boxes around blocks of points; the box of an empty block is inside out."""

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

    @property
    def corners(self) -> Corners:
        """The low and the high corners, for NumPy."""
        return np.asarray(self.low), np.asarray(self.high)

    def beyond(self, planned: "Boxes") -> Float[Array, " blocks"]:
        """Measure the distance (mm, along an axis) by which each box exceeds the planned one."""
        out = jnp.maximum(planned.low - self.low, self.high - planned.high)
        return jnp.maximum(jnp.max(jnp.where(self.low <= self.high, out, 0), axis=1), 0)


def find_neighbors(
    points: Boxes,
    sources: Boxes,
    layers: Int[Array, " blocks"] | Int[np.ndarray, " blocks"],
    reaches: Sequence[float],
    parts: int = 1,
) -> NeighborLists:
    """Search for the blocks of sources within reach of every block of points, layer by layer.

    The number of rows is rounded up, so that similar geometries share a program. Not for traced
    arrays.

    **Arguments:**

    - `layers`: the layer of each block of sources.
    - `reaches`: the reach of each layer, mm; with 0 a layer has no neighbors.
    - `parts`: number of equal parts of the points, one after the other, with separate lists.
    """
    low, high = sources.corners
    corners = (np.split(corner, parts) for corner in points.corners)
    layers = np.asarray(layers)
    blocks = len(points.low) // parts
    lists = blocks * len(reaches)  # of a part

    def search(part: Corners, layer: int) -> Pairs:
        """Find the pairs of a list of a part and a block of sources."""
        of_layer = np.flatnonzero(layers == layer)
        targets, near = pairs_in_reach(part, (low[of_layer], high[of_layer]), reaches[layer])
        return layer * blocks + targets, of_layer[near]

    tables = []
    # Only NumPy computes in the threads, since JAX's precision may be set for one thread.
    with ThreadPoolExecutor() as pool:
        for part in zip(*corners, strict=True):
            pairs = pool.map(partial(search, part), range(len(reaches)))
            targets, near = (np.concatenate(column) for column in zip(*pairs, strict=True))
            rows, counts = in_rows(targets, near, lists, BLOCKS_PER_ROW, len(low))
            tables.append((rows, np.cumsum(counts) - counts, counts))
    rows, first, counts = zip(*tables, strict=True)
    # At least one row, the last, stays empty: lanes whose list has ended read it.
    count = max(_ROWS * lists, with_spare(("rows", lists), max(map(len, rows)), 1, per_octave=2))
    rows = [
        np.pad(part, ((0, count - len(part)), (0, 0)), constant_values=len(low)) for part in rows
    ]
    joined = (np.concatenate(table) for table in (rows, first, counts))
    return NeighborLists(*(jnp.asarray(table, jnp.int32) for table in joined))


def in_rows(
    targets: Int[np.ndarray, " pairs"],
    sources: Int[np.ndarray, " pairs"],
    count: int,
    width: int,
    empty: int,
) -> tuple[Int[np.ndarray, "rows width"], Int[np.ndarray, " targets"]]:
    """Sort the sources of pairs into rows of one target each, targets in ascending order; `empty`
    fills rows up. Also return the number of rows of each of `count` targets.
    """
    order = np.argsort(targets, kind="stable")
    targets, sources = targets[order], sources[order]
    lengths = np.bincount(targets, minlength=count)
    counts = -(-lengths // width)
    first, begins = (np.cumsum(number) - number for number in (counts, lengths))
    rows = np.full((counts.sum(), width), empty, np.int32)
    rows.reshape(-1)[(first * width - begins)[targets] + np.arange(len(targets))] = sources
    return rows, counts


def _levels(corners: Corners, depth: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the corners `[3, parents, parts]` of boxes, `_FAN` of them to a parent, and of ever
    coarser boxes around these; empty boxes fill each level.
    """
    levels, (low, high) = [], (corner.T for corner in corners)
    for _ in range(depth):
        lacking = ((0, 0), (0, -low.shape[1] % _FAN))
        low, high = (
            np.pad(corner, lacking, constant_values=empty).reshape(3, -1, _FAN)
            for corner, empty in ((low, np.inf), (high, -np.inf))
        )
        levels.append((low, high))
        low, high = low.min(axis=2), high.max(axis=2)
    return levels


def pairs_in_reach(points: Corners, sources: Corners, reach: float) -> Pairs:
    """Find the pairs of boxes, given by their corners, that are in reach of each other, from coarse
    to fine.
    """
    if not reach:
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
    depth = math.ceil(math.log(max(len(points[0]), len(sources[0]), 2), _FAN))
    both_levels = zip(_levels(points, depth), _levels(sources, depth), strict=True)
    levels = [(*of_points, *of_sources) for of_points, of_sources in both_levels]
    root, none = np.zeros(1, np.int32), np.zeros(0, np.int32)
    todo, in_reach = [(depth - 1, root, root)], [(none, none)]
    while todo:
        level, target_boxes, source_boxes = todo.pop()
        for begin in range(0, len(target_boxes), _AT_ONCE):
            a, b = target_boxes[begin : begin + _AT_ONCE], source_boxes[begin : begin + _AT_ONCE]
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
                in_reach.append(pairs)
            else:
                todo.append((level - 1, *pairs))
    targets, near = (np.concatenate(column) for column in zip(*in_reach, strict=True))
    return targets, near
