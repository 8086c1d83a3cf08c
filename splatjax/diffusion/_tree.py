"""Splats merged into clusters: fewer sources for wider layers (section 4.2, Figure 5)."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._diffuser import Sources
from ._order import BLOCK, compact_order


class Clusters(eqx.Module):
    """Sources that stand for one or more splats. An empty one has no area."""

    centers: Float[Array, "3 clusters"]
    normals: Float[Array, "3 clusters"]
    """Mean over the area: shorter than one where the surface bends."""
    areas: Float[Array, " clusters"]
    irradiance: Float[Array, "channels clusters"]
    spread: Float[Array, " clusters"]
    """Half the mean squared distance of the splats from the center: the variance per axis of a flat
    cluster, mm^2.
    """
    moments: Float[Array, "channels 3 clusters"] | None
    """Where the energy lies: the sum of area, irradiance and offset from the center. `None` for
    single splats: nothing.
    """
    turns: Float[Array, "channels 3 clusters"] | None
    """The same of the offset from the mean normal."""
    opening: Float[Array, " clusters"]
    """Mean product of both offsets, mm: positive where the surface is convex."""
    bending: Float[Array, " clusters"]
    """Mean square of the offset from the mean normal."""

    @classmethod
    def of(cls, sources: Sources) -> "Clusters":
        none = jnp.zeros_like(sources.areas)
        return cls(
            sources.centers,
            sources.normals,
            sources.areas,
            sources.irradiance,
            none,
            None,
            None,
            none,
            none,
        )

    def lowered(self, depth: Float[Array, ""]) -> "Clusters":
        """Give the clusters of the same splats, each moved so far (mm) against its normal."""
        spread = jnp.maximum(
            self.spread - depth * self.opening + 0.5 * depth * depth * self.bending, 0
        )
        moments = (
            None
            if self.moments is None or self.turns is None
            else self.moments - depth * self.turns
        )
        opening = self.opening - depth * self.bending
        centers = self.centers - depth * self.normals
        return Clusters(
            centers,
            self.normals,
            self.areas,
            self.irradiance,
            spread,
            moments,
            self.turns,
            opening,
            self.bending,
        )

    def merged(
        self,
        parents: Int[Array, " clusters"],
        count: int,
        total: Callable[[Array], Array] = lambda sums: sums,
    ) -> "Clusters":
        """Merge clusters into `count` parents. Area, energy and the first moments of both are kept.
        Differentiable.

        `total` adds up what others have of the same parents.
        """

        def totals(rows: Float[Array, "rows clusters"]) -> Float[Array, "rows parents"]:
            """Sum over the children: a few rows in one pass over them; of many the sums would not
            stay in the cache.
            """
            return total(jax.vmap(lambda row: jax.ops.segment_sum(row, parents, count))(rows))

        channels = self.irradiance.shape[0]
        energy = self.areas[None] * self.irradiance
        own = jnp.concatenate(
            [
                self.areas[None],
                self.areas[None] * self.centers,
                self.areas[None] * self.normals,
                energy,
            ]
        )
        areas, *sums = jnp.split(totals(own), [1, 4, 7])
        inverse = 1 / jnp.where(areas > 0, areas, 1.0)
        centers, normals, irradiance = (each * inverse for each in sums)
        offset = self.centers - centers[:, parents]
        turn = self.normals - normals[:, parents]
        spread = self.spread + 0.5 * jnp.sum(offset * offset, axis=0)
        opening = self.opening + jnp.sum(offset * turn, axis=0)
        bending = self.bending + jnp.sum(turn * turn, axis=0)

        def energy_off(offset, brought):
            """Give the first moments of the children's energy, those that they bring included."""
            moments = energy[:, None] * offset[None]
            return (moments if brought is None else moments + brought).reshape(3 * channels, -1)

        spread, opening, bending = (
            totals(self.areas[None] * jnp.stack([spread, opening, bending])) * inverse
        )
        moments, turns = (
            totals(energy_off(*each)).reshape(channels, 3, count)
            for each in ((offset, self.moments), (turn, self.turns))
        )
        return Clusters(
            centers, normals, areas[0], irradiance, spread, moments, turns, opening, bending
        )


class ClusterTree(eqx.Module):
    """Splats in a compact order, and cells in cells around them. Which splats share a cell is not
    differentiated.
    """

    order: Int[Array, " places"]
    """The splat at each place; the number of splats, which is none, at the places that fill the
    last block.
    """
    parents: tuple[Int[Array, " _"], ...]
    """For each level, the cell of every cluster of the level before (of the splat at every place,
    for the first).
    """
    counts: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        centers: Float[Array, "splats 3"],
        normals: Float[Array, "splats 3"],
        cells: Sequence[float],
    ) -> "ClusterTree":
        """Sort splats, and the clusters of each level, into cells of the edges `cells` (mm,
        ascending) by their centers.

        A cell holds what faces one way: the two sides of a thin sheet are clusters of their own.
        """
        positions, facing = np.asarray(centers, np.float64), np.asarray(normals, np.float64)
        splats = len(positions)
        order = compact_order(positions)
        positions, facing, members = positions[order], facing[order], np.ones(splats)
        parents, counts = [], []
        for cell in cells:
            found = np.floor((positions - positions.min(axis=0)) / cell).astype(np.int64)
            extent = found.max(axis=0) + 1
            key = (found[:, 0] * extent[1] + found[:, 1]) * extent[2] + found[:, 2]
            parent = _by_side(np.unique(key, return_inverse=True)[1].reshape(-1), facing)
            inside = np.bincount(parent, members)
            middle, toward = (
                _sums(parent, members[:, None] * rows) / inside[:, None]
                for rows in (positions, facing)
            )
            place = compact_order(middle)
            rank = np.empty(len(place), np.int64)
            rank[place] = np.arange(len(place))
            before = counts[-1] if counts else blocks_of(splats)
            parents.append(jnp.asarray(np.pad(rank[parent], (0, before - len(parent))), jnp.int32))
            counts.append(_round_up(len(place)))
            positions, facing, members = middle[place], toward[place], inside[place]
        order = np.pad(order, (0, blocks_of(splats) - splats), constant_values=splats)
        return cls(jnp.asarray(order, jnp.int32), tuple(parents), tuple(counts))

    def with_room(self, counts: Sequence[int]) -> "ClusterTree":
        """Give the same tree with room for so many clusters at each level, as many at least as
        there are; the rest are empty.
        """
        before = (self.order.shape[0], *counts)
        parents = tuple(
            jnp.pad(each, (0, room - each.shape[0]))
            for each, room in zip(self.parents, before, strict=False)
        )
        return ClusterTree(self.order, parents, tuple(counts))

    def levels(self, sources: Sources) -> list[Clusters]:
        """Give the clusters of every level, the splats themselves first."""

        def placed(values):
            return values.at[..., self.order].get(mode="fill", fill_value=0)

        return self.above(Clusters.of(jax.tree.map(placed, sources)))

    def above(self, clusters: Clusters) -> list[Clusters]:
        """Give clusters, and those of every level that merges them."""
        found = [clusters]
        for parents, count in zip(self.parents, self.counts, strict=True):
            found.append(found[-1].merged(parents, count))
        return found

    def largest(
        self, values: Float[np.ndarray, " splats"], level: int
    ) -> Float[np.ndarray, " clusters"]:
        """Give the largest value, 0 or above, of the splats in each cluster of a level. Not for
        traced arrays.
        """
        found = np.append(values, np.zeros(1, values.dtype))[np.asarray(self.order)]
        for parents, count in zip(self.parents[:level], self.counts[:level], strict=True):
            before, found = found, np.zeros(count, found.dtype)
            np.maximum.at(found, np.asarray(parents), before)
        return found


def _sums(groups: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Add up the rows of each group."""
    return np.stack([np.bincount(groups, column) for column in rows.T], axis=1)


def _by_side(groups: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Split each group by which way along its main axis its members face; give new groups, numbered
    without gaps.
    """
    rows, columns = np.triu_indices(3)
    products = np.empty((groups.max() + 1, 3, 3))
    products[:, rows, columns] = products[:, columns, rows] = _sums(
        groups, facing[:, rows] * facing[:, columns]
    )
    axes = np.linalg.eigh(products)[1][:, :, -1]
    sides = 2 * groups + (np.sum(facing * axes[groups], axis=1) < 0)
    return (np.cumsum(np.bincount(sides) > 0) - 1)[sides]


def blocks_of(count: int) -> int:
    """Round up to whole blocks."""
    return max(-(-count // BLOCK), 1) * BLOCK


def _round_up(count: int) -> int:
    """Round up to the next of sixteen steps per octave and to whole blocks, so that a moving
    surface needs no other program.
    """
    grain = 1 << max(count.bit_length() - 5, 0)
    return blocks_of(-(-count // grain) * grain)
