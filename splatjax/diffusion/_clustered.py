"""The fast diffuser: neighbors instead of all splats, and clusters of splats for wide layers. All
splats are given, or read part by part.
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import take_points
from splatjax._combination import AbstractCombination, PartByPart
from splatjax._precision import full_precision
from splatjax.scene import Splats

from ._clusters import (
    POINTS_PER_BLOCK,
    SOURCES_PER_BLOCK,
    LayerSources,
    SunkSources,
    compact_order,
)
from ._diffuser import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    Sources,
    divide_by_mass,
    layer_values,
)
from ._gaussian_sums import FAR, Targets, gaussian_sums, in_units, source_table, units_per_mm
from ._kernel import AbstractDiffusionKernel, TruncatedGaussian, resolved_fraction
from ._neighbors import Boxes, Lists, find_neighbors, pairs_in_reach

# Quantile of the areas of the splats: a layer is resolved as far as splats of that area resolve it.
FINE_QUANTILE = 0.01
_CELL = 0.6  # edge of the cells, in standard deviations, for an error of 2e-3; error ~ edge^3
_LAYERS = 2  # to a multiple of which they are filled up, so that materials share a program
_WORTHWHILE = 1.2  # edge of the cells, in spacings, from which on merging splats pays


class ClusterDiffuser(AbstractDiffuser):
    r"""Sums over the splats near each splat; for layers wider than about 2.2 spacings, over
    clusters.

    **Attributes:** (static)

    - `error`: median error of a layer over its points, relative to the layer's root mean square,
      for light that varies within the layer's width; the 99th percentile is five times as large.
      Half of it is spent on truncation. With 0, nothing is merged and 4e-5 of the power is
      truncated.
    - `margin`: factor on the planned variances within which a plan is valid.
    """

    error: float = eqx.field(static=True, default=2e-3)
    margin: float = eqx.field(static=True, default=1.25)

    def make_plan(
        self,
        parts: Sequence[Splats],
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        interval: Float[Array, "2"],
    ) -> "ClusterPlan":
        centers, normals, areas = (
            np.concatenate([np.asarray(getattr(part, name)) for part in parts])
            for name in ("centers", "normals", "areas")
        )
        exists, spacing, fine = areas > 0, math.inf, math.inf
        if exists.any():
            spacing = math.sqrt(areas[exists].mean())
            fine = float(np.quantile(areas[exists], FINE_QUANTILE))
        gaussians, sizes, edges, supports = self.choose_layers(
            np.asarray(variances, np.float64), spacing, fine, kernel, interval
        )
        clusters = LayerSources.build(centers, normals, exists, edges.tolist())
        splats = Sources(*map(jnp.asarray, (centers.T, normals.T, areas, areas[None])))
        own = jnp.asarray(sizes, variances.dtype)
        points, boxes, sinking = _enclose(clusters, splats, own, self.margin, kernel)
        # Sources of a wider layer lie deeper than those of the boxes.
        sinking = math.sqrt(3) * np.asarray(sinking, np.float64)
        reaches = np.where(edges < np.inf, supports * np.sqrt(sizes * self.margin) + sinking, 0)
        lists = find_neighbors(points, boxes, clusters.layers, reaches.tolist(), parts=len(parts))
        endless = jnp.asarray(np.where(reaches > 0, reaches, np.inf), variances.dtype)
        return ClusterPlan(
            gaussians=jnp.asarray(gaussians, jnp.int32),
            sources=clusters,
            kernels=kernel.truncated(supports),
            lists=lists,
            boxes=(points, boxes),
            reaches=endless,
            variances=variances,
            margin=jnp.asarray(self.margin, variances.dtype),
        )

    def choose_layers(
        self,
        variances: Float[np.ndarray, " gaussians"],
        spacing: float,
        fine: float,
        kernel: AbstractDiffusionKernel,
        interval: Float[Array, "2"],
    ) -> tuple[np.ndarray, ...]:
        """Choose the layers that are evaluated, padded by layers without sources.

        **Arguments:**

        - `spacing`: root of the mean area of the splats, mm.
        - `fine`: area that only `FINE_QUANTILE` of the splats are finer than, mm^2.

        **Returns:** of each its Gaussian, the variance (mm^2), the edge of its cells (mm; 0 for
        single splats), and the support (standard deviations).
        """
        given = (jnp.asarray(each, interval.dtype) for each in (variances * self.margin, fine))
        shares = np.asarray(eqx.filter_jit(resolved_fraction)(*given, interval), np.float64)
        edges = _CELL * (self.error / 2e-3) ** (1 / 3) * np.sqrt(variances / self.margin)
        edges = np.where(edges > _WORTHWHILE * spacing, edges, 0.0)
        gaussians = np.flatnonzero(shares > 0)
        lacking = max(-(-len(gaussians) // _LAYERS), 1) * _LAYERS - len(gaussians)
        supports = [kernel.support(self.error, share) for share in shares[gaussians].tolist()]
        chosen = gaussians, variances[gaussians], edges[gaussians], np.array(supports, float)
        return tuple(
            np.pad(each, (0, lacking), constant_values=fill)
            for each, fill in zip(chosen, (len(variances), 1, np.inf, 1), strict=True)
        )


class ClusterPlan(AbstractDiffusionPlan):
    """The sources of one geometry and their neighbors, and the assumptions of their search.

    **Attributes:**

    - `sources`: of every layer: splats, or clusters of them.
    - `kernels`: of every layer.
    - `lists`: the blocks of sources within reach of every block of points.
    - `boxes`: around the blocks of points, and the blocks of sources of all layers.
    - `reaches`: of the layers, mm.
    - `variances`, `margin`: the plan is valid for variances within this factor of these, mm^2, or
      of the first of them.
    """

    sources: LayerSources
    kernels: TruncatedGaussian
    lists: Lists
    boxes: tuple[Boxes, Boxes]
    reaches: Float[Array, " layers"]
    variances: Float[Array, " gaussians"]
    margin: Float[Array, ""]

    def shares(self):
        return tuple(jax.tree.leaves((self.lists, self.boxes[0])))

    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: AbstractCombination,
        at: Int[Array, " points"] | None = None,
    ) -> Diffused:
        # Every device gathers the sources of all, and evaluates the layers at its own splats.
        everywhere = combination.gather(sources, axis=-1).of_layers(self.gaussians)
        origin = jax.lax.stop_gradient(jnp.mean(everywhere.centers, axis=1))[:, None]
        centered = dataclasses.replace(everywhere, centers=everywhere.centers - origin)
        points = sources.centers - origin
        own = self.variances_of_layers(variances)
        depths = kernel.depths(own)

        # Sink the sources and merge them; sum over those near each block of points.
        below = self.sources.merged(centered, depths)
        targets = Targets.of(at, points.shape[1] // POINTS_PER_BLOCK, POINTS_PER_BLOCK)
        lists = self.lists
        if at is not None:
            lists = lists.only(jnp.any(targets.ranks < targets.count, axis=1))
        sums = gaussian_sums(
            in_units(points.reshape(3, -1, POINTS_PER_BLOCK).swapaxes(0, 1), own),
            source_table(below, own, self.sources.layers),
            lists,
            self.kernels,
            targets,
            self.forward_mode,
        )
        per_mm = units_per_mm(own)[:, None]
        seen = points if at is None else take_points(points, at)
        layers = jax.checkpoint(layer_values)(  # keeps the sums alone for the derivative
            sums.reshape(len(own), -1, 4, targets.count),
            per_mm[:, None] * seen[None],
            2 * per_mm,  # slopes are moments in mm over v, and moments are in units of sqrt(2 v)
            per_flat_mass(self.kernels, own, depths)[:, None],
        )

        # The needed over the planned capacity.
        around = _target_boxes(points, sources.areas), source_boxes(below)
        moved = [now.beyond(then) for now, then in zip(around, self.boxes, strict=True)]
        moved_sources = jax.ops.segment_max(moved[1], self.sources.layers, len(own))
        moved = jnp.maximum(moved_sources, 0) + jnp.max(moved[0], initial=0)
        largest = self.kernels.largest.astype(own.dtype)
        reaches = jnp.sqrt(2 * largest * jax.lax.stop_gradient(own))
        planned = self.variances[: len(variances)]
        factors = jnp.maximum(planned / variances, variances / planned)
        varied = jnp.max(factors, initial=0) / (self.margin * (1 + 1e-6))
        needed = jnp.maximum(varied, jnp.max((reaches + math.sqrt(3) * moved) / self.reaches))
        return Diffused(layers, combination.largest([needed.astype(variances.dtype)]))


def per_flat_mass(
    kernels: TruncatedGaussian, variances: Float[Array, " layers"], depths: Float[Array, " layers"]
) -> Float[Array, " layers"]:
    """Compute the factor that gives a flat sheet the mass 1."""
    return 1 / (2 * jnp.pi * variances * kernels.integral(0.5 * depths * depths / variances))


def _target_boxes(points: Float[Array, "3 points"], areas: Float[Array, " points"]) -> Boxes:
    """Enclose the blocks of points; a block of splats without area is empty."""
    exists = jnp.any((areas > 0).reshape(-1, POINTS_PER_BLOCK), axis=1)
    return Boxes.around(points, jnp.repeat(exists, POINTS_PER_BLOCK), POINTS_PER_BLOCK)


@eqx.filter_jit
def _enclose(
    clusters: LayerSources,
    splats: Sources,
    variances: Float[Array, " layers"],
    margin: float,
    kernel: AbstractDiffusionKernel,
) -> tuple[Boxes, Boxes, Float[Array, " layers"]]:
    """Enclose the blocks of points, and the blocks of sources of all layers; also compute the
    additional depth of the sources of the widest layer for which a plan is valid, mm.
    """
    centers = splats.centers - jnp.mean(splats.centers, axis=1)[:, None]
    depths = kernel.depths(variances)
    below = clusters.merged(dataclasses.replace(splats, centers=centers), depths)
    boxes = _target_boxes(centers, splats.areas), source_boxes(below)
    return *boxes, kernel.depths(variances * margin) - depths


@eqx.filter_jit
def source_boxes(below: SunkSources) -> Boxes:
    """Enclose the sources of layers below their splats. Not differentiated."""
    return Boxes.around(below.centers, below.areas > 0, SOURCES_PER_BLOCK)


class StreamedDiffusion:
    """Evaluates the layers at points, from sources in parts.

    Each part has its own cells, so a cell that two parts share counts as two, and cells are never
    coarser than those of all splats together. Only the sums are kept, which do not grow with the
    number of splats.
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
        `ClusterDiffuser.choose_layers`.
        """
        gaussians, sizes, edges, supports = diffuser.choose_layers(
            np.asarray(variances, np.float64), spacing, fine, kernel, interval
        )
        self.gaussians = jnp.asarray(gaussians, jnp.int32)
        self.variances, self.edges = jnp.asarray(sizes, variances.dtype), edges.tolist()
        self.depths, self.kernels = kernel.depths(self.variances), kernel.truncated(supports)
        self.reaches = np.where(edges < np.inf, supports * np.sqrt(sizes), 0).tolist()
        self.points = jnp.where(exists[:, None], points, FAR)
        self.boxes = Boxes.around(
            jnp.moveaxis(self.points, 1, 0).reshape(3, -1), exists.reshape(-1), points.shape[2]
        )
        self.source_capacity, self.list_capacity = 0, 0

    def evaluate(
        self, parts: Iterable[Sources], channels: int
    ) -> Float[Array, "blocks layers values block"]:
        """Sum over all parts: means and mass of each layer, in the order of `gaussians`.

        **Arguments:**

        - `parts`: of one size, with centers from the origin of the points; sources without area do
          not count.
        - `channels`: of their irradiance.
        """

        count = self.points.shape[0] * self.points.shape[2]
        zeros = jnp.zeros((len(self.edges), channels + 1, count), self.points.dtype)
        sums = PartByPart().fold(self._add_part, zeros, parts)
        return _finished(sums, self.variances, self.depths, self.kernels, self.points)

    def _add_part(self, sums: Float[Array, "layers values points"], sources: Sources):
        # Test by boxes whether any point is in reach; sources are below their splats.
        around = Boxes.around(sources.centers, sources.areas > 0, len(sources.areas))
        reach = np.max(self.reaches + np.asarray(self.depths, np.float64))
        if not pairs_in_reach(self.boxes.corners, around.corners, reach)[0].size:
            return sums
        order = compact_order(np.asarray(sources.centers.T))
        sources = jax.tree.map(lambda rows: rows[..., order], sources.of_layers(self.gaussians))
        arrays = (np.asarray(each.T) for each in (sources.centers, sources.normals))
        exists = np.asarray(sources.areas) > 0
        clusters = LayerSources.build(*arrays, exists, self.edges, self.source_capacity)
        below = clusters.merged(sources, self.depths)
        given = self.boxes, source_boxes(below), clusters.layers, self.reaches
        lists = find_neighbors(*given, least=self.list_capacity)
        self.source_capacity, self.list_capacity = clusters.count, len(lists.rows)
        return sums + _sum(self.points, below, clusters, self.variances, self.kernels, lists)


@full_precision
@eqx.filter_jit
def _sum(points, below: SunkSources, clusters: LayerSources, variances, kernels, lists: Lists):
    table = source_table(below, variances, clusters.layers, moments=False)
    targets = Targets.of(None, points.shape[0], points.shape[2])
    return gaussian_sums(in_units(points, variances), table, lists, kernels, targets)


@eqx.filter_jit
def _finished(sums, variances, depths, kernels: TruncatedGaussian, points):
    rows = divide_by_mass(sums)
    rows = rows.at[:, -1].multiply(per_flat_mass(kernels, variances, depths)[:, None])
    return jnp.moveaxis(rows.reshape(*rows.shape[:2], points.shape[0], points.shape[2]), 2, 0)
