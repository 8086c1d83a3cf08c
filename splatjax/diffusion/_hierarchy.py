"""Sums over all splats of a body at every splat: near ones one by one, far ones in clusters."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from splatjax._chunking import map_chunks, with_spare

from ._clusters import POINTS_PER_BLOCK, SOURCES_PER_BLOCK
from ._neighbors import in_rows

# Number of splats in the clusters of each level: runs of the compact order, which is halved down to
# the first level.
SIZES = 1, *(SOURCES_PER_BLOCK << level for level in range(9))
AXES = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)  # of second moments
_WIDTH = 128  # sources in a row
_ROWS = 16  # rows evaluated together
_NONE = np.iinfo(np.int32).max // 2  # index of an absent block, beyond all blocks


class Interactions(eqx.Module):
    """Which blocks of sources are summed at which blocks of points, in rows. Not differentiated.

    **Attributes:**

    - `points`: the block of points of each row, ascending; their number for none.
    - `sources`: blocks of sources; their number or more for none.
    - `block`: sources of a block. Static.
    """

    points: Int[Array, " rows"]
    sources: Int[Array, "rows width"]
    block: int = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        points: Int[np.ndarray, " pairs"],
        sources: Int[np.ndarray, " pairs"],
        blocks: int,
        block: int,
    ) -> "Interactions":
        """Sort pairs of blocks into rows; `blocks` is the number of blocks of points."""
        rows, counts = in_rows(points, sources, blocks, _WIDTH // block, _NONE)
        lacking = with_spare(("interactions", block), len(rows), _ROWS) - len(rows)
        row_points = np.pad(
            np.repeat(np.arange(blocks), counts), (0, lacking), constant_values=blocks
        )
        rows = np.pad(rows, ((0, lacking), (0, 0)), constant_values=_NONE)
        return cls(jnp.asarray(row_points, jnp.int32), jnp.asarray(rows), block)

    def reduce(
        self,
        function: Callable,
        points: PyTree[Array],
        sources: PyTree[Array],
        combine: Callable = jax.ops.segment_sum,
        used: Bool[Array, " points"] | None = None,
    ) -> Float[Array, "results points"]:
        """Apply a function to planes of points `[rows, 1, points]` and of sources `[rows, sources,
        1]`, and combine each of its results, `[rows, points]`. Absent sources are 0.

        **Arguments:**

        - `used`: the points whose results are used; all for `None`.
        """
        blocks = jax.tree.leaves(points)[0].shape[-1] // POINTS_PER_BLOCK
        if used is not None:  # of the rows
            of_blocks = jnp.any(used.reshape(blocks, -1), axis=1)
            used = of_blocks.at[self.points].get(mode="fill", fill_value=False)
        # Read before the loop, so that the derivative adds to the sources once.
        x = jax.tree.map(lambda leaf: _read(leaf, self.points[:, None], POINTS_PER_BLOCK), points)
        y = jax.tree.map(lambda leaf: _read(leaf, self.sources, self.block), sources)

        def of_rows(x, y):
            x = jax.tree.map(lambda plane: plane[:, None], x)
            return function(x, jax.tree.map(lambda plane: plane[:, :, None], y))

        rows = jnp.stack(map_chunks(of_rows, x, y, at_once=_ROWS, used=used), axis=1)
        combined = combine(rows, self.points, blocks, indices_are_sorted=True)
        return jnp.swapaxes(combined, 0, 1).reshape(combined.shape[1], -1)


def _read(leaf: Float[Array, "*planes elements"], at: Int[Array, "rows blocks"], size: int):
    """Read blocks of elements in rows: a plane `[rows, elements]`, or nested tuples of planes."""
    blocks = leaf.reshape(-1, leaf.shape[-1] // size, size)
    rows = blocks.at[:, at].get(mode="fill", fill_value=0)
    planes = jnp.unstack(rows.reshape(*rows.shape[:2], -1))
    for length in reversed(leaf.shape[:-1]):
        planes = [tuple(planes[i : i + length]) for i in range(0, len(planes), length)]
    return planes[0]


class Hierarchy(eqx.Module):
    """The splats near every block of splats, and clusters of those that are far from it."""

    near: Interactions
    far: Interactions

    def reduce(
        self,
        near: Callable,
        far: Callable,
        points: PyTree[Array],
        splats: PyTree[Array],
        clusters: PyTree[Array],
        *,
        combine: Callable = jax.ops.segment_sum,
        join: Callable = jnp.add,
        used: Bool[Array, " points"] | None = None,
    ) -> Float[Array, "results points"]:
        """Combine `near` of near splats and `far` of clusters, as `Interactions.reduce`, and join
        the results: sums by default.
        """
        return join(
            self.near.reduce(near, points, splats, combine, used),
            self.far.reduce(far, points, clusters, combine, used),
        )

    @classmethod
    def build(
        cls,
        centers: Float[np.ndarray, "splats 3"],
        exists: Bool[np.ndarray, " splats"],
        opening: float,
        least: float,
    ) -> "Hierarchy":
        """Choose the splats and the clusters over which every block of splats sums. Not for traced
        arrays.

        **Arguments:**

        - `centers`: in a compact order, padded to complete clusters of all levels.
        - `exists`: false for padding.
        - `opening`: radius of a cluster over its distance, at most; with 0 all splats are near.
        - `least`: least distance of a cluster, mm: nearer ones are within reach of the softening.
        """
        boxes = [_boxes(centers, exists, size) for size in SIZES[1:]]
        radii = [0.5 * np.linalg.norm(np.maximum(high - low, 0), axis=1) for low, high in boxes]
        begins = np.cumsum([0, *map(len, radii[:-1])])
        low_x, high_x = _boxes(centers, exists, POINTS_PER_BLOCK)
        occupied, coarsest = np.flatnonzero(low_x[:, 0] <= high_x[:, 0]), len(radii[-1])
        targets = np.repeat(occupied, coarsest)
        sources = np.tile(np.arange(coarsest), len(occupied))
        far = []
        for level in reversed(range(len(boxes))):
            low, high = boxes[level]
            keep = low[sources, 0] <= high[sources, 0]
            targets, sources = targets[keep], sources[keep]
            gap = np.maximum(low[sources] - high_x[targets], low_x[targets] - high[sources])
            squared = np.sum(np.square(np.maximum(gap, 0)), axis=1)
            is_far = (radii[level][sources] ** 2 < opening**2 * squared) & (squared > least**2)
            far.append((targets[is_far], begins[level] + sources[is_far]))
            targets, sources = targets[~is_far], sources[~is_far]
            if level:
                targets = np.repeat(targets, 2)
                sources = (2 * sources[:, None] + np.arange(2)).reshape(-1)
        pairs = (np.concatenate(levels) for levels in zip(*far, strict=True))
        return cls(
            near=Interactions.of(targets, sources, len(low_x), SOURCES_PER_BLOCK),
            far=Interactions.of(*pairs, len(low_x), 1),
        )


def padded(rows: PyTree[Array]) -> PyTree[Array]:
    """Append zeros along the last axis, the splats, to complete clusters of all levels."""

    lacking = -jax.tree.leaves(rows)[0].shape[-1] % SIZES[-1]
    return jax.tree.map(lambda row: jnp.pad(row, [(0, 0)] * (row.ndim - 1) + [(0, lacking)]), rows)


def cluster_totals(rows: Float[Array, "*rows splats"]) -> Float[Array, "*rows clusters"]:
    """Sum over the clusters of every level except the first."""
    levels = [rows.reshape(*rows.shape[:-1], -1, size) for size in SIZES[1:]]
    return jnp.concatenate([jnp.sum(level, axis=-1) for level in levels], axis=-1)


class Clusters(eqx.Module):
    """The clusters of every level except the first.

    **Attributes:**

    - `totals`: sums of the weights.
    - `centers`: weighted means of the splats' centers.
    - `moments`: half the second moments xx, yy, zz, xy, xz, yz about the center, over the totals.
    """

    totals: Float[Array, " clusters"]
    centers: Float[Array, "3 clusters"]
    moments: Float[Array, "6 clusters"]

    @classmethod
    def of(cls, centers: Float[Array, "3 splats"], weights: Float[Array, " splats"]) -> "Clusters":
        """Merge the splats."""

        def of_level(size: int) -> Clusters:
            x, of_splats = centers.reshape(3, -1, size), weights.reshape(-1, size)
            totals = jnp.sum(of_splats, axis=-1)
            shares = of_splats / jnp.where(totals > 0, totals, 1.0)[:, None]
            means = jnp.sum(shares[None] * x, axis=-1)
            offsets = x - means[..., None]
            products = jnp.stack([0.5 * offsets[i] * offsets[j] for i, j in AXES])
            return cls(totals, means, jnp.sum(shares[None] * products, axis=-1))

        levels = map(of_level, SIZES[1:])
        return jax.tree.map(lambda *parts: jnp.concatenate(parts, axis=-1), *levels)


def _boxes(centers, exists, size):
    low, high = (
        np.where(exists[:, None], centers, sign * np.inf).reshape(-1, size, 3) for sign in (1, -1)
    )
    return low.min(axis=1), high.max(axis=1)
