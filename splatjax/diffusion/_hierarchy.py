"""Sums over all splats of a body at every splat: near ones one by one, far ones in clusters."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from splatjax._chunking import map_chunks, with_spare

from ._clusters import POINTS_PER_BLOCK, SOURCES_PER_BLOCK

SIZES = 1, 8, 32, 128, 512, 2048  # splats of the clusters of each level, in a compact order
_WIDTH = 16  # blocks of sources in a row
_AT_ONCE = 16  # rows

Planes = tuple[Float[Array, " points"], Float[Array, " points"], Float[Array, " points"]]


class Interactions(eqx.Module):
    """Which blocks of sources are summed at which blocks of points, in rows. Not differentiated.

    **Attributes:**

    - `points`: the block of points of each row, ascending; their number for none.
    - `sources`: blocks of sources; their number or more for none.
    """

    points: Int[Array, " rows"]
    sources: Int[Array, "rows width"]

    @classmethod
    def of(cls, points: Int[np.ndarray, " pairs"], sources: Int[np.ndarray, " pairs"], blocks: int):
        """Sort pairs of blocks into rows.

        **Arguments:**

        - `blocks`: how many blocks of points there are.
        """
        order = np.argsort(points, kind="stable")
        points, sources = points[order], sources[order]
        lengths = np.bincount(points, minlength=blocks)
        counts = -(-lengths // _WIDTH)
        first, begins = (np.cumsum(each) - each for each in (counts, lengths))
        rows = with_spare("interactions", int(counts.sum()), _AT_ONCE, per_octave=4)
        ids = np.full((rows, _WIDTH), np.iinfo(np.int32).max // 2, np.int32)
        ids.reshape(-1)[(first * _WIDTH - begins)[points] + np.arange(len(points))] = sources
        own = np.full(rows, blocks, np.int32)
        own[: counts.sum()] = np.repeat(np.arange(blocks), counts)
        return cls(jnp.asarray(own), jnp.asarray(ids))

    def reduce(
        self,
        function: Callable,
        points: PyTree[Float[Array, " points"]],
        sources: PyTree[Float[Array, " sources"]],
        combine: Callable = jax.ops.segment_sum,
    ) -> PyTree[Float[Array, " points"]]:
        """Apply a function to points `[rows, 1, points]` and sources `[rows, sources, 1]`, and
        combine what it makes of each row, `[rows, points]`. Absent sources are 0.
        """
        blocks = jax.tree.leaves(points)[0].shape[0] // POINTS_PER_BLOCK
        points = jax.tree.map(lambda leaf: leaf.reshape(-1, POINTS_PER_BLOCK), points)
        sources = jax.tree.map(lambda leaf: leaf.reshape(-1, SOURCES_PER_BLOCK), sources)

        def of_rows(own, ids):
            here = jax.tree.map(
                lambda leaf: leaf.at[own].get(mode="fill", fill_value=0)[:, None], points
            )
            there = jax.tree.map(
                lambda leaf: leaf.at[ids].get(mode="fill", fill_value=0).reshape(len(ids), -1, 1),
                sources,
            )
            return function(here, there)

        rows = map_chunks(of_rows, self.points, self.sources, at_once=_AT_ONCE)

        def joined(leaf):
            return combine(leaf, self.points, blocks, indices_are_sorted=True).reshape(-1)

        return jax.tree.map(joined, rows)


def padded_count(count: int) -> int:
    """Return the number of splats, filled up to whole blocks of sources of every level."""
    step = SIZES[-1] * SOURCES_PER_BLOCK
    return -(-count // step) * step


def clusters(charges, dipoles, centers, weights):
    """Merge sources into clusters of all levels: charges and dipoles about the weighted centers.

    **Returns:** charges, dipoles and centers of the sources of all levels but the first.
    """
    made = []
    for size, before in zip(SIZES[1:], SIZES[:-1], strict=True):

        def total(plane, ratio=size // before):
            return jnp.sum(plane.reshape(-1, ratio), axis=1)

        def spread(plane, ratio=size // before):
            return jnp.repeat(plane, ratio)

        mass = total(weights)
        inverse = 1 / jnp.where(mass > 0, mass, 1.0)
        means = tuple(total(weights * axis) * inverse for axis in centers)
        moved = zip(dipoles, centers, means, strict=True)
        dipoles = tuple(
            total(dipole + charges * (axis - spread(mean))) for dipole, axis, mean in moved
        )
        charges, centers, weights = total(charges), means, mass
        made.append((charges, dipoles, centers))
    return jax.tree.map(lambda *levels: jnp.concatenate(levels), *made)


def find_interactions(
    centers: Float[np.ndarray, "splats 3"], exists: np.ndarray, opening: float
) -> tuple[Interactions, Interactions]:
    """Find for every block of points which splats are near, and which clusters are far: smaller
    than `opening` times the distance between their blocks. Not for traced arrays.

    **Arguments:**

    - `centers`: in a compact order, filled up to `padded_count`.
    - `exists`: false for what fills up.
    """
    levels, first = [], 0
    for size in SIZES:
        low, high = _boxes(centers, exists, size * SOURCES_PER_BLOCK)
        least, most = _boxes(centers, exists, size)
        radii = 0.5 * np.linalg.norm(np.maximum(most - least, 0), axis=1)
        radii = radii.reshape(-1, SOURCES_PER_BLOCK).max(axis=1)
        levels.append((low, high, radii, first))
        first += len(low) if size > 1 else 0
    point_low, point_high = _boxes(centers, exists, POINTS_PER_BLOCK)
    blocks = len(point_low)
    top = levels[-1][0].shape[0]
    some = np.flatnonzero(point_low[:, 0] <= point_high[:, 0])
    own, other = (each.reshape(-1) for each in np.meshgrid(some, np.arange(top), indexing="ij"))
    far = []
    for level in range(len(SIZES) - 1, 0, -1):
        low, high, radii, begin = levels[level]
        keep = low[other, 0] <= high[other, 0]
        own, other = own[keep], other[keep]
        gap = np.maximum(low[other] - point_high[own], point_low[own] - high[other])
        distance = np.linalg.norm(np.maximum(gap, 0), axis=1)
        is_far = radii[other] < opening * distance
        far.append((own[is_far], begin + other[is_far]))
        own, other = own[~is_far], other[~is_far]
        ratio = SIZES[level] // SIZES[level - 1]
        own = np.repeat(own, ratio)
        other = (other[:, None] * ratio + np.arange(ratio)).reshape(-1)
    low, high, *_ = levels[0]
    keep = low[other, 0] <= high[other, 0]
    near = Interactions.of(own[keep], other[keep], blocks)
    own, other = (np.concatenate(each) for each in zip(*far, strict=True))
    return near, Interactions.of(own, other, blocks)


def _boxes(centers, exists, size):
    low, high = (
        np.where(exists[:, None], centers, sign * np.inf).reshape(-1, size, 3) for sign in (1, -1)
    )
    return low.min(axis=1), high.max(axis=1)
