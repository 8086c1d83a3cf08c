"""Splats merged into clusters: fewer sources for wider layers (section 4.2, Figure 5)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._diffuser import Sources


class Clusters(eqx.Module):
    """Sources that stand for one or more splats. An empty one has no area."""

    centers: Float[Array, "3 clusters"]
    normals: Float[Array, "3 clusters"]
    """Mean over the area: shorter than one where the surface bends."""
    areas: Float[Array, " clusters"]
    irradiance: Float[Array, "channels clusters"]
    spread: Float[Array, " clusters"]
    """Half the mean squared distance of the splats from the center: the variance per axis of a flat cluster, mm^2."""
    moments: Float[Array, "channels 3 clusters"] | None
    """Where the energy lies: the sum of area, irradiance and offset from the center. `None` for single splats: nothing."""
    turns: Float[Array, "channels 3 clusters"] | None
    """The same of the offset from the mean normal."""
    opening: Float[Array, " clusters"]
    """Mean product of both offsets, mm: positive where the surface is convex."""
    bending: Float[Array, " clusters"]
    """Mean square of the offset from the mean normal."""

    @classmethod
    def of(cls, sources: Sources) -> "Clusters":
        none = jnp.zeros_like(sources.areas)
        return cls(sources.centers, sources.normals, sources.areas, sources.irradiance, none, None, None, none, none)

    def lowered(self, depth: Float[Array, ""]) -> "Clusters":
        """Give the clusters of the same splats, each moved so far (mm) against its normal."""
        spread = jnp.maximum(self.spread - depth * self.opening + 0.5 * depth * depth * self.bending, 0)
        moments = None if self.moments is None or self.turns is None else self.moments - depth * self.turns
        opening = self.opening - depth * self.bending
        centers = self.centers - depth * self.normals
        return Clusters(centers, self.normals, self.areas, self.irradiance, spread, moments, self.turns, opening, self.bending)

    def merged(self, parents: Int[Array, " clusters"], count: int) -> "Clusters":
        """Merge clusters into `count` parents. Area, energy and the first moments of both are kept. Differentiable."""

        def total(values):
            return jax.ops.segment_sum(values, parents, count)

        areas = total(self.areas)
        inverse = 1 / jnp.where(areas > 0, areas, 1.0)

        def mean(values):
            return total(self.areas * values) * inverse

        centers = jnp.stack([mean(axis) for axis in self.centers])
        normals = jnp.stack([mean(axis) for axis in self.normals])
        irradiance = jnp.stack([mean(channel) for channel in self.irradiance])
        offset = self.centers - centers[:, parents]
        turn = self.normals - normals[:, parents]
        spread = mean(self.spread + 0.5 * jnp.sum(offset * offset, axis=0))
        opening = mean(self.opening + jnp.sum(offset * turn, axis=0))
        bending = mean(self.bending + jnp.sum(turn * turn, axis=0))

        def energy_off(offset, own):
            """Give the first moments of energy, those that the children bring included."""
            energy = self.areas[None] * self.irradiance
            brought = (lambda c, axis: 0.0) if own is None else (lambda c, axis: own[c, axis])
            return jnp.stack(
                [
                    jnp.stack([total(energy[c] * offset[axis] + brought(c, axis)) for axis in range(3)])
                    for c in range(energy.shape[0])
                ]
            )

        moments, turns = energy_off(offset, self.moments), energy_off(turn, self.turns)
        return Clusters(centers, normals, areas, irradiance, spread, moments, turns, opening, bending)


class ClusterTree(eqx.Module):
    """One nested tree of cubic cells per geometry, finest level first. Which splats share a cell is not differentiated."""

    parents: tuple[Int[Array, " _"], ...]
    """For each level, the cell of every cluster of the level before (of every splat, for the first)."""
    counts: tuple[int, ...] = eqx.field(static=True)
    cells: tuple[float, ...] = eqx.field(static=True)
    """Edge of the cells of each level, mm."""

    @classmethod
    def build(cls, centers: Float[Array, "splats 3"], cells: list[float]) -> "ClusterTree":
        """Sort splats into cells; each edge in `cells` (ascending) is a multiple of the one before."""
        positions = np.asarray(centers, np.float64)
        parents, counts = [], []
        if cells:
            index = np.floor((positions - positions.min(axis=0)) / cells[0]).astype(np.int64)
            for level, cell in enumerate(cells):
                if level:
                    index = index // round(cell / cells[level - 1])
                extent = index.max(axis=0) + 1
                key = (index[:, 0] * extent[1] + index[:, 1]) * extent[2] + index[:, 2]
                _, first, parent = np.unique(key, return_index=True, return_inverse=True)
                count = _round_up(len(first))
                kept = np.zeros(count, np.int64)
                kept[: len(first)] = first
                parents.append(jnp.asarray(parent.reshape(-1), jnp.int32))
                counts.append(count)
                index = index[kept]  # rows beyond the cells repeat the first: they have no area
        return cls(tuple(parents), tuple(counts), tuple(cells))

    def levels(self, sources: Sources) -> list[Clusters]:
        """Give the clusters of every level, the splats themselves first."""
        found = [Clusters.of(sources)]
        for parents, count in zip(self.parents, self.counts, strict=True):
            found.append(found[-1].merged(parents, count))
        return found


def _round_up(count: int) -> int:
    """Round up to the next of sixteen steps per octave, so that a moving surface needs no other program."""
    grain = max(1 << max(count.bit_length() - 5, 0), 1)
    return -(-count // grain) * grain
