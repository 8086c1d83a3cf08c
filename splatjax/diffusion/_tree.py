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
    areas: Float[Array, " clusters"]
    irradiance: Float[Array, "channels clusters"]
    spread: Float[Array, " clusters"]
    """Half the mean squared distance of the splats from the center: the variance per axis of a flat cluster, mm^2."""
    moments: Float[Array, "channels 3 clusters"] | None
    """Where the energy lies: the sum of area, irradiance and offset from the center. `None` for single splats: nothing."""

    @classmethod
    def of(cls, sources: Sources) -> "Clusters":
        return cls(sources.centers, sources.areas, sources.irradiance, jnp.zeros_like(sources.areas), None)

    def merged(self, parents: Int[Array, " clusters"], count: int) -> "Clusters":
        """Merge clusters into `count` parents. Area, energy and the first moments of both are kept. Differentiable."""

        def total(values):
            return jax.ops.segment_sum(values, parents, count)

        areas = total(self.areas)
        inverse = 1 / jnp.where(areas > 0, areas, 1.0)

        def mean(values):
            return total(self.areas * values) * inverse

        centers = jnp.stack([mean(axis) for axis in self.centers])
        irradiance = jnp.stack([mean(channel) for channel in self.irradiance])
        offset = self.centers - centers[:, parents]
        spread = mean(self.spread + 0.5 * jnp.sum(offset * offset, axis=0))
        channels = range(self.irradiance.shape[0])
        moments = [[self.areas * self.irradiance[c] * offset[axis] for axis in range(3)] for c in channels]
        if self.moments is not None:
            moments = [[moments[c][axis] + self.moments[c, axis] for axis in range(3)] for c in channels]
        moments = jnp.stack([jnp.stack([total(axis) for axis in each]) for each in moments])
        return Clusters(centers, areas, irradiance, spread, moments)


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
