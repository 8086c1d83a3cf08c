"""Pass 4 with splats that come a part at a time: each part adds to what the pixels gather, and is
forgotten.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import BinCapacity

from ._clustered import ClusterDiffuser
from ._diffuser import Diffused, Kernels, Sources
from ._gathering import Gathering, MeansAndExits
from ._gaussian_sums import as_they_are
from ._handover import resolved_share
from ._pixels import Pixels
from ._tree import Clusters, ClusterTree


class StreamedLayer(eqx.Module):
    """How one layer is gathered."""

    variance: Float[Array, ""]
    depth: Float[Array, ""]
    edge: float = eqx.field(static=True)
    """Of its cells, mm; 0 for single splats."""
    support: float = eqx.field(static=True)
    carried: bool = eqx.field(static=True)


@dataclasses.dataclass(frozen=True)
class StreamedRoom:
    """What there is room for so far, so that one program serves nearly all parts. It only grows."""

    counts: tuple[int, ...] = ()
    """Cells of each level."""
    capacities: tuple[BinCapacity | None, ...] = ()
    """Of each layer's lists."""


class StreamedSums(eqx.Module):
    r"""What the pixels gather of every layer, part by part.

    The cells of a part are its own, so that one which two parts share counts as two: never coarser
    than the cells of all splats together. Every pixel gathers for itself. Nothing is kept of a part
    but the sums, which do not grow with the number of splats.
    """

    diffuser: ClusterDiffuser
    layers: tuple[StreamedLayer, ...]
    pixels: Pixels
    totals: tuple[Float[Array, "tiles _ points"] | None, ...]
    """`None` of a layer that is not carried, or not begun."""

    @classmethod
    def begin(
        cls,
        diffuser: ClusterDiffuser,
        kernels: Kernels,
        spacing: float,
        fine: Float[Array, ""],
        interval: Float[Array, "2"],
        pixels: Pixels,
    ) -> "StreamedSums":
        """Begin with nothing.

        **Arguments:**

        - `spacing`: root of the mean area of the splats, mm.
        - `fine`: the area (mm^2) that few splats are finer than.
        - `interval`: from `handover_interval`.
        """
        shares = np.asarray(resolved_share(kernels.variances * diffuser.margin, fine, interval))
        edges = diffuser.edges(
            np.asarray(kernels.variances, np.float64) / diffuser.margin, spacing, shares > 0
        )
        layers = tuple(
            StreamedLayer(
                variance, depth, float(edge), diffuser.support(float(share)), bool(share > 0)
            )
            for variance, depth, edge, share in zip(
                kernels.variances, kernels.depths, edges, shares, strict=True
            )
        )
        return cls(diffuser, layers, pixels, (None,) * len(layers))

    @property
    def cells(self) -> list[float]:
        """Give the edges of the cells of each level, mm."""
        return sorted({layer.edge for layer in self.layers if layer.edge > 0})

    @property
    def reach(self) -> float:
        """Give how far from its splats' centers the light of any layer reaches at most, mm."""
        found = [0.0]
        for layer in self.layers:
            depth = float(layer.depth)
            across = math.sqrt(3) * sum(
                cell for cell in self.cells if cell <= layer.edge
            )  # a cell holds cells, by their centers
            spread = (
                0.5 * (across + 2 * depth) ** 2 if layer.edge > 0 else 0.0
            )  # of splats that sink, each along its normal
            if layer.carried:
                found.append(depth + layer.support * math.sqrt(float(layer.variance) + spread))
        return max(found)

    def within_reach(self, splats: Splats) -> bool:
        """Say whether a part may bring anything to any pixel."""
        return bool(_within_reach(self.pixels, splats, self.reach))

    def plus(self, sources: Sources, room: StreamedRoom) -> tuple["StreamedSums", StreamedRoom]:
        """Add what a part of the splats brings; splats without area bring nothing."""
        cells = self.cells
        tree = ClusterTree.build(sources.centers.T, sources.normals.T, cells)
        held = room.counts or (0,) * len(tree.counts)
        counts = tuple(
            had if count <= had else _roomier(count)
            for count, had in zip(tree.counts, held, strict=True)
        )
        levels = _levels(tree.with_room(counts), sources, self.pixels.origin)
        bare = dataclasses.replace(self, totals=())
        capacities, totals = [], []
        for i, (layer, total) in enumerate(zip(self.layers, self.totals, strict=True)):
            if not layer.carried:
                capacities.append(None)
                totals.append(None)
                continue
            level = cells.index(layer.edge) + 1 if layer.edge > 0 else 0
            held = room.capacities[i] if room.capacities else None
            added, needed = (
                (None, 2.0) if held is None else _added(bare, layer, levels[level], held, total)
            )
            if needed > 1:
                found = self.diffuser.capacity_at(
                    self.pixels.origin,
                    levels[level],
                    None,
                    float(layer.variance),
                    layer.depth,
                    layer.support,
                    [self.pixels.atlas],
                )
                held = found.grown(held, self.pixels.chunks)
                added, _ = _added(bare, layer, levels[level], held, total)
            capacities.append(held)
            totals.append(added)
        return dataclasses.replace(self, totals=tuple(totals)), StreamedRoom(
            counts, tuple(capacities)
        )

    def found(self, channels: int) -> Diffused:
        """Give the diffusion integrals of all parts together."""
        carried = jnp.asarray([layer.carried for layer in self.layers], self.pixels.tiles.dtype)
        tiles, _, points = self.pixels.tiles.shape
        values = [
            jnp.zeros((tiles - 1, channels + 1, points), carried.dtype)
            if total is None
            else _finished(total, self.pixels.tiles, MeansAndExits(channels, layer.edge > 0))
            for layer, total in zip(self.layers, self.totals, strict=True)
        ]
        values = jnp.stack(values, axis=1)
        return Diffused(
            values[:, :, :channels], values[:, :, channels], carried, jnp.zeros((), carried.dtype)
        )


@eqx.filter_jit
def _within_reach(pixels: Pixels, splats: Splats, reach: float) -> Bool[Array, ""]:
    """Say whether the box around splats is within reach (mm) of the box around any tile's
    points.
    """
    there, tiles = (splats.areas > 0)[None], pixels.boxes
    centers = splats.centers.T - pixels.origin[:, None]
    low, high = (
        jnp.min(jnp.where(there, sign * centers, jnp.inf), axis=1, keepdims=True)
        for sign in (1, -1)
    )
    gaps = jnp.maximum(jnp.maximum(tiles.low + high, low - tiles.high), 0)
    return jnp.any(jnp.sum(gaps * gaps, axis=0) <= reach * reach)


def _roomier(count: int) -> int:
    return math.ceil(1.3 * count / 64) * 64


@eqx.filter_jit
def _levels(tree: ClusterTree, sources: Sources, origin: Float[Array, "3"]) -> list[Clusters]:
    return tree.levels(dataclasses.replace(sources, centers=sources.centers - origin[:, None]))


@eqx.filter_jit
def _added(
    sums: StreamedSums, layer: StreamedLayer, clusters: Clusters, capacity: BinCapacity, total
):
    gathering = Gathering.of(clusters, layer.variance, layer.depth)
    found, needed = sums.diffuser.at_pixels(
        gathering, layer.support, capacity, sums.pixels, as_they_are
    )
    return found if total is None else total + found, needed


@eqx.filter_jit
def _finished(total, tiles, finish: MeansAndExits):
    return jax.vmap(finish)(total, tiles)[:-1]
