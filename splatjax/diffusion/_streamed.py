"""Pass 4 with splats that come a part at a time, at the points that the pixels see: each part adds
to their sums, and is forgotten.
"""

import math
from collections.abc import Iterable, Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatjax._combination import PartByPart

from ._clustered import ClusterDiffuser, layer_table, source_boxes, units_per_mm
from ._clusters import POINTS_PER_BLOCK, ClusterTree, compact_order
from ._diffuser import Sources, divide_by_mass
from ._gaussian_sums import FAR, gaussian_sums, identity
from ._kernel import AbstractDiffusionKernel, TruncatedGaussian
from ._neighbors import Boxes, Lists, find_neighbors

_SPARE = 1.3  # times the clusters of a part, so that one program serves nearly all parts


class _Layer(eqx.Module):
    """How one layer is summed."""

    variance: Float[Array, ""]
    depth: Float[Array, ""]
    edge: float = eqx.field(static=True)
    truncated: TruncatedGaussian
    support: float = eqx.field(static=True)


class StreamedDiffusion:
    """Evaluates the layers at points, from sources that come in parts.

    The cells of a part are its own, so that one which two parts share counts as two: never coarser
    than the cells of all splats together. Only the sums are kept, which do not grow with the number
    of splats.
    """

    def __init__(
        self,
        diffuser: ClusterDiffuser,
        kernel: AbstractDiffusionKernel,
        variances: Float[Array, " gaussians"],
        spacing: float,
        fine: float,
        interval: Float[Array, "2"],
        points: Float[Array, "blocks 3 block"],
        exists: Bool[Array, "blocks block"],
    ):
        """Prepare for points in compact blocks; `spacing`, `fine` and `interval` as for
        `ClusterDiffuser.choose_sources`.
        """
        sizes = np.asarray(variances, np.float64)
        edges, supports = diffuser.choose_sources(sizes, spacing, fine, kernel, interval)
        each = zip(
            variances, kernel.depths(variances), edges.tolist(), supports.tolist(), strict=True
        )
        self.layers = [
            _Layer(variance, depth, edge, kernel.truncated(support), support) if support else None
            for variance, depth, edge, support in each
        ]
        self.cells = np.unique(edges[edges > 0]).tolist()
        self.points = jnp.where(exists[:, None], points, FAR)
        self.boxes = Boxes.around(
            jnp.moveaxis(self.points, 1, 0).reshape(3, -1), exists.reshape(-1), points.shape[2]
        )
        self.cluster_capacity, self.list_capacity = (0,) * len(self.cells), [0] * len(self.layers)

    def evaluate(
        self, parts: Iterable[Sources]
    ) -> tuple[Float[Array, "blocks values block"] | None, ...]:
        """Sum over all parts: means and mass of each layer; `None` for one that is not resolved.

        **Arguments:**

        - `parts`: of one size, with centers from the origin of the points; sources without area
          bring nothing.
        """
        sums = PartByPart().total(self._sums(parts))
        return tuple(
            None if each is None else eqx.filter_jit(divide_by_mass)(each) for each in sums
        )

    def _sums(self, parts: Iterable[Sources]) -> Iterator[list[Array | None]]:
        """Iterate over the sums of each part that brings anything, after zeros."""
        for i, sources in enumerate(parts):
            if i == 0:
                blocks, _, block = self.points.shape
                dark = jnp.zeros((blocks, len(sources.irradiance) + 1, block), self.points.dtype)
                yield [None if layer is None else dark for layer in self.layers]
            if self._in_reach(sources):
                yield self._sum_part(sources)

    def _in_reach(self, sources: Sources) -> bool:
        """Test whether a part may bring anything to any point, by boxes."""
        centers, exists = np.asarray(sources.centers), np.asarray(sources.areas) > 0
        if not exists.any():
            return False
        low, high = centers[:, exists].min(axis=1), centers[:, exists].max(axis=1)
        own_low, own_high = np.asarray(self.boxes.low), np.asarray(self.boxes.high)
        gaps = np.maximum(np.maximum(own_low - high, low - own_high), 0)
        # Sources lie below their splats.
        reaches = [
            each.support * math.sqrt(float(each.variance)) + float(each.depth)
            for each in self.layers
            if each is not None
        ]
        return bool(np.any(np.sum(gaps * gaps, axis=1) <= max(reaches, default=0.0) ** 2))

    def _sum_part(self, sources: Sources) -> list[Array | None]:
        order = compact_order(np.asarray(sources.centers.T))
        sources = jax.tree.map(lambda rows: rows[..., order], sources)
        arrays = (np.asarray(each.T) for each in (sources.centers, sources.normals))
        tree = ClusterTree.build(*arrays, np.asarray(sources.areas) > 0, self.cells)
        self.cluster_capacity = tuple(
            had if count <= had else math.ceil(_SPARE * count / POINTS_PER_BLOCK) * POINTS_PER_BLOCK
            for count, had in zip(tree.counts, self.cluster_capacity, strict=True)
        )
        levels = _levels(tree.with_capacity(self.cluster_capacity), sources)
        return [
            None if each is None else self._sum_layer(i, each, levels)
            for i, each in enumerate(self.layers)
        ]

    def _sum_layer(self, i: int, layer: _Layer, levels: list[Sources]) -> Array:
        clusters = levels[self.cells.index(layer.edge) + 1 if layer.edge else 0]
        reach = layer.support * math.sqrt(float(layer.variance))
        around = source_boxes(clusters.lowered(layer.depth))
        lists = find_neighbors(self.boxes, around, reach, least=self.list_capacity[i])
        self.list_capacity[i] = len(lists.rows)
        return _sum(self.points, clusters, layer, lists)


@eqx.filter_jit
def _levels(tree: ClusterTree, sources: Sources) -> list[Sources]:
    return tree.levels(sources)


@eqx.filter_jit
def _sum(points, clusters: Sources, layer: _Layer, lists: Lists) -> Array:
    below = clusters.lowered(layer.depth)
    table = layer_table(below, layer.variance, layer.depth, layer.truncated, slopes=False)
    blocks = points * units_per_mm(layer.variance)
    return gaussian_sums(blocks, table, lists, layer.truncated, identity)
