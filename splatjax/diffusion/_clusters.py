"""Splats in a compact order, and merged into clusters: fewer sources for wider layers (section
4.2, Figure 5).
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import jit_unless_traced, with_spare

from ._diffuser import Sources

POINTS_PER_BLOCK = 32  # blocks, and their halves and quarters, are compact
SOURCES_PER_BLOCK = 8
_CHEAP = 1 << 15  # blocks of sources that take hardly any time
_REUSED = 2.0  # largest earlier capacity that is reused, over the one planned
_TOGETHER = 128 * POINTS_PER_BLOCK  # size of parts that are then halved together


class LayerSources(eqx.Module):
    """The sources of every layer: its splats below the surface, or clusters of them.

    **Attributes:** the choice of clusters is not differentiated

    - `parents`: for each layer the source of each splat, an index beyond all for none; the sources
      of all layers form one sequence.
    - `layers`: the layer of every block of sources.
    """

    parents: Int[Array, "layers splats"]
    layers: Int[Array, " blocks"]

    @classmethod
    def build(
        cls,
        centers: Float[np.ndarray, "splats 3"],
        normals: Float[np.ndarray, "splats 3"],
        exists: Bool[np.ndarray, " splats"],
        edges: Sequence[float],
    ) -> "LayerSources":
        """Choose the sources of layers.

        The capacity is rounded up, so that similar bodies and materials share a program.

        **Arguments:**

        - `exists`: false for splats that fill a block.
        - `edges`: of the cells of each layer, mm; 0 for single splats, inf for none.
        """
        cells = sorted({edge for edge in edges if 0 < edge < np.inf})
        nested = {
            0.0: (np.arange(len(exists)), len(exists)),
            np.inf: (np.full(len(exists), np.iinfo(np.int32).max // 2), 0),
            **dict(zip(cells, nested_cells(centers, normals, exists, cells), strict=True)),
        }
        cells_of_splats, counts = zip(*(nested[edge] for edge in edges), strict=True)
        blocks = -(-np.asarray(counts) // SOURCES_PER_BLOCK)
        layers, ends = np.repeat(np.arange(len(edges)), blocks), np.cumsum(blocks)
        parents = np.stack(cells_of_splats) + SOURCES_PER_BLOCK * (ends - blocks)[:, None]
        most = len(edges) * -(-len(exists) // SOURCES_PER_BLOCK)
        planned = with_spare(("sources", most), len(layers), 256, cheap=_CHEAP, most=_REUSED)
        layers = np.pad(layers, (0, min(planned, most) - len(layers)))
        return cls(jnp.asarray(parents, jnp.int32), jnp.asarray(layers, jnp.int32))

    @jit_unless_traced
    def merged(self, splats: Sources, depths: Float[Array, " layers"]) -> Sources:
        """Sink the splats below the surface by the depth of each layer, mm, and merge them. Area
        and energy are kept. Differentiable.

        **Returns:** area-weighted means, and the total areas, 0 without splats.
        """

        own_light = splats.irradiance.ndim == 3

        @jax.checkpoint
        def add_layer(totals, layer):
            parents, depth, light = layer
            sunk = splats.centers - depth * splats.normals
            light = light if own_light else splats.irradiance
            rows = splats.areas, *(splats.areas * row for row in (*sunk, *light))
            both = zip(totals, rows, strict=True)
            return [total.at[parents].add(row, mode="drop") for total, row in both], None

        # Sum layer by layer: a sum over all layers at once would copy every row.
        shape = 4 + len(splats.irradiance), SOURCES_PER_BLOCK * len(self.layers)
        start = list(jnp.zeros(shape, splats.areas.dtype))
        light = splats.irradiance.swapaxes(0, 1) if own_light else None
        (areas, *rows), _ = jax.lax.scan(add_layer, start, (self.parents, depths, light))
        means = jnp.stack(rows) / jnp.where(areas > 0, areas, 1.0)[None]
        return Sources(means[:3], None, areas, means[3:])


def nested_cells(
    centers: Float[np.ndarray, "splats 3"],
    normals: Float[np.ndarray, "splats 3"],
    exists: Bool[np.ndarray, " splats"],
    cells: Sequence[float],
) -> list[tuple[Int[np.ndarray, " splats"], int]]:
    """Sort splats into cells by their centers, and these cells into larger ones by their means.

    A cell contains only splats of one orientation: the two sides of a thin sheet are separate.

    **Arguments:**

    - `exists`: false for splats that fill a block; they count as in the first cell.
    - `cells`: edges of the cells of each level, mm, ascending.

    **Returns:** for each level the cell of every splat, in a compact order, and the number of
    cells.
    """
    levels = []
    positions, facing = centers[exists], normals[exists]
    members, of_splats = np.ones(len(positions)), np.arange(len(positions))
    for cell in cells:
        # Number cells along a grid, split them by side, and sort them in a compact order.
        index = np.floor((positions - positions.min(axis=0)) / cell).astype(np.int64)
        extent = index.max(axis=0) + 1
        key = (index[:, 0] * extent[1] + index[:, 1]) * extent[2] + index[:, 2]
        parent = _split_by_side(np.unique(key, return_inverse=True)[1].reshape(-1), facing)
        inside = np.bincount(parent, members)
        positions, facing = (
            _sums(parent, members[:, None] * rows) / inside[:, None] for rows in (positions, facing)
        )
        order = compact_order(positions)
        positions, facing, members = positions[order], facing[order], inside[order]
        of_splats = np.argsort(order)[parent][of_splats]
        cell_of_splat = np.zeros(len(exists), np.int32)
        cell_of_splat[exists] = of_splats
        levels.append((cell_of_splat, len(order)))
    return levels


def _sums(groups: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Sum the rows of each group."""
    return np.stack([np.bincount(groups, column) for column in rows.T], axis=1)


def _split_by_side(groups: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Split each group that has members of both orientations, by the side of its main axis that
    they face, and number the groups without gaps.
    """
    backs = np.sum(facing * _sums(groups, facing)[groups], axis=1) <= 0
    is_split = np.zeros(groups.max() + 1, bool)
    is_split[groups[backs]] = True
    chosen = np.flatnonzero(is_split[groups])
    chosen_groups, ways = (np.cumsum(is_split) - 1)[groups[chosen]], facing[chosen]
    products = _sums(chosen_groups, (ways[:, :, None] * ways[:, None]).reshape(-1, 9))
    axes = np.linalg.eigh(products.reshape(-1, 3, 3))[1][:, :, -1]
    sides = 2 * groups
    sides[chosen] += np.sum(ways * axes[chosen_groups], axis=1) < 0
    return (np.cumsum(np.bincount(sides) > 0) - 1)[sides]


def compact_order(points: np.ndarray) -> np.ndarray:
    """Find the order `[points]` of a k-d tree whose leaves hold a block of points, except for the
    last, and are sorted down to quarters of a block.

    **Arguments:** `points`: `[points, 3]`.
    """
    # Sorted together with the order, so that the next comparison reads contiguous memory.
    order, coordinates = np.arange(len(points)), np.array(points.T, np.float32, order="C")
    todo = [(0, len(points))]
    while todo:
        begin, end = todo.pop()
        part, count = slice(begin, end), end - begin
        if count in (_TOGETHER, POINTS_PER_BLOCK):
            _halve(order[part], coordinates[:, part])
        elif count > POINTS_PER_BLOCK:
            step = _TOGETHER if count > _TOGETHER else POINTS_PER_BLOCK
            middle = begin + -(-count // (2 * step)) * step
            longest = np.argmax(np.ptp(coordinates[:, part], axis=1))
            turn = np.argpartition(coordinates[longest, part], middle - begin - 1)
            order[part], coordinates[:, part] = order[part][turn], coordinates[:, part][:, turn]
            todo += [(begin, middle), (middle, end)]
    return order


def _halve(order: np.ndarray, coordinates: np.ndarray) -> None:
    """Split points in halves, along the longest axis of each part, down to quarters of a block. In
    place.
    """
    size = len(order)
    while size > POINTS_PER_BLOCK // 4:
        parts = coordinates.reshape(3, -1, size)
        longest = np.argmax(np.ptp(parts, axis=2), axis=0)
        rows = np.arange(parts.shape[1])
        turn = (
            np.argpartition(parts[longest, rows], size // 2, axis=1) + rows[:, None] * size
        ).reshape(-1)
        order[:], coordinates[:] = order[turn], coordinates[:, turn]
        size //= 2
