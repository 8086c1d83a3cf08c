"""Splats in a compact order, and merged into clusters: fewer sources for wider layers (section
4.2, Figure 5).
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import with_spare

from ._diffuser import Sources

POINTS_PER_BLOCK = 32
"""Points of one block; blocks, and their halves and quarters, are compact."""
_TOGETHER = 128 * POINTS_PER_BLOCK  # split side by side from here on


class ClusterTree(eqx.Module):
    """Nested cells around the splats. Which splats share a cell is not differentiated.

    **Attributes:**

    - `parents`: for each level, the cell of every cluster of the level before; of every splat, for
      the first.
    - `counts`: clusters of each level. Static.
    """

    parents: tuple[Int[Array, " _"], ...]
    counts: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        centers: Float[np.ndarray, "splats 3"],
        normals: Float[np.ndarray, "splats 3"],
        exists: Bool[np.ndarray, " splats"],
        cells: Sequence[float],
    ) -> "ClusterTree":
        """Sort splats, and the clusters of each level, into cells by their centers.

        A cell holds only clusters that face one way: the two sides of a thin sheet are apart.

        **Arguments:**

        - `exists`: false for splats that fill a block.
        - `cells`: edges of the cells of each level, mm, ascending.
        """
        parents, counts = [], []
        positions, facing = centers[exists], normals[exists]
        members, slots = np.ones(len(positions)), np.flatnonzero(exists)
        before = len(exists)
        for cell in cells:
            # Cells are numbered along a grid, then split by side, then sorted into a compact order.
            index = np.floor((positions - positions.min(axis=0)) / cell).astype(np.int64)
            extent = index.max(axis=0) + 1
            key = (index[:, 0] * extent[1] + index[:, 1]) * extent[2] + index[:, 2]
            parent = _split_by_side(np.unique(key, return_inverse=True)[1].reshape(-1), facing)
            inside = np.bincount(parent, members)
            positions, facing = (
                _sums(parent, members[:, None] * rows) / inside[:, None]
                for rows in (positions, facing)
            )
            order = compact_order(positions)
            rank = np.empty(len(order), np.int32)
            rank[order] = np.arange(len(order), dtype=np.int32)
            of_slot = np.zeros(before, np.int32)
            of_slot[slots] = rank[parent]
            parents.append(jnp.asarray(of_slot))
            positions, facing, members = positions[order], facing[order], inside[order]
            slots, before = (
                np.arange(len(order)),
                with_spare(len(order), POINTS_PER_BLOCK, per_octave=2),
            )
            counts.append(before)
        return cls(tuple(parents), tuple(counts))

    def with_capacity(self, counts: Sequence[int]) -> "ClusterTree":
        """Add empty clusters to every level up to `counts`."""
        before = (self.parents[0].shape[0], *counts) if self.parents else ()
        parents = tuple(
            jnp.pad(each, (0, count - each.shape[0]))
            for each, count in zip(self.parents, before, strict=False)
        )
        return ClusterTree(parents, tuple(counts))

    def levels(self, sources: Sources) -> list[Sources]:
        """Compute the clusters of every level, the splats themselves first."""
        levels = [sources]
        for parents, count in zip(self.parents, self.counts, strict=True):
            levels.append(levels[-1].merged(parents, count))
        return levels


def _sums(groups: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Sum the rows of each group."""
    return np.stack([np.bincount(groups, column) for column in rows.T], axis=1)


def _split_by_side(groups: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Split each group whose members face both ways, by the side of its main axis that they face;
    number without gaps.
    """
    backs = np.sum(facing * _sums(groups, facing)[groups], axis=1) <= 0
    is_split = np.zeros(groups.max() + 1, bool)
    is_split[groups[backs]] = True
    chosen = np.flatnonzero(is_split[groups])
    own, ways = (np.cumsum(is_split) - 1)[groups[chosen]], facing[chosen]
    rows, columns = np.triu_indices(3)
    products = np.empty((np.sum(is_split), 3, 3))
    products[:, rows, columns] = products[:, columns, rows] = _sums(
        own, ways[:, rows] * ways[:, columns]
    )
    axes = np.linalg.eigh(products)[1][:, :, -1]
    sides = 2 * groups
    sides[chosen] += np.sum(ways * axes[own], axis=1) < 0
    return (np.cumsum(np.bincount(sides) > 0) - 1)[sides]


def compact_order(points: np.ndarray) -> np.ndarray:
    """Find the order `[points]` of a k-d tree whose leaves hold a block of points, but the last,
    and are sorted down to quarters of it.

    **Arguments:** `points`: `[points, 3]`.
    """
    # Turned together with the order: what is compared next is near in memory.
    order, coordinates = np.arange(len(points)), np.array(points.T, np.float32, order="C")
    todo = [(0, len(points))]
    while todo:
        begin, end = todo.pop()
        step = _TOGETHER if end - begin > _TOGETHER else POINTS_PER_BLOCK
        if end - begin <= step or end - begin == _TOGETHER:
            continue
        middle = begin + -(-(end - begin) // (2 * step)) * step
        part = coordinates[:, begin:end]
        turn = np.argpartition(part[np.argmax(np.ptp(part, axis=1))], middle - begin - 1)
        order[begin:end], coordinates[:, begin:end] = order[begin:end][turn], part[:, turn]
        todo += [(begin, middle), (middle, end)]
    together, whole = (len(points) // size * size for size in (_TOGETHER, POINTS_PER_BLOCK))
    for begin in range(0, together, _TOGETHER):
        part = slice(begin, begin + _TOGETHER)
        _halve(order[part], coordinates[:, part], _TOGETHER)
    _halve(order[together:whole], coordinates[:, together:whole], POINTS_PER_BLOCK)
    return order


def _halve(order: np.ndarray, coordinates: np.ndarray, size: int) -> None:
    """Split parts of one size in halves, along their longest axes, down to quarters of a block. In
    place.
    """
    while size > POINTS_PER_BLOCK // 4:
        parts = coordinates.reshape(3, -1, size)
        longest = np.argmax(np.ptp(parts, axis=2), axis=0)
        rows = np.arange(parts.shape[1])
        turn = (
            np.argpartition(parts[longest, rows], size // 2, axis=1) + rows[:, None] * size
        ).reshape(-1)
        order[:], coordinates[:] = order[turn], coordinates[:, turn]
        size //= 2
