"""The fast diffuser: neighbors instead of all splats, and clusters of splats for wide layers."""

import dataclasses
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from splatjax._chunking import zeros_after
from splatjax._combination import AbstractCombination
from splatjax.scene import Splats

from ._clusters import BLOCK, ClusterTree
from ._diffuser import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    LayerValues,
    Sources,
    layer_values,
    split_layer,
)
from ._gaussian_sums import SourceTable, gaussian_sums
from ._kernel import AbstractDiffusionKernel, TruncatedGaussian, resolved_fraction
from ._neighbors import SOURCES, Boxes, Lists, Neighbors, find_neighbors

FINEST = 0.01
"""Quantile of the areas of the splats: a layer counts as resolved as far as splats of that area
resolve it.
"""
_CELL = 0.6  # edge of the cells, in standard deviations, for an error of 2e-3; error ~ edge^3
_WORTHWHILE = 1.2  # edge of the cells, in spacings, from which on merging splats pays


class LayerPlan(eqx.Module):
    """How one layer is evaluated while its variance stays within a range.

    **Attributes:**

    - `level`: of the clusters that are its sources; 0 for the splats themselves. Static.
    - `support`: radius beyond which sources are left out, standard deviations. Static.
    - `smallest`, `largest`: variances, mm^2.
    - `neighbors`: `None` for a layer that no splat of note resolves at any variance of the range.
    """

    level: int = eqx.field(static=True)
    support: float = eqx.field(static=True)
    smallest: Float[Array, ""]
    largest: Float[Array, ""]
    neighbors: Neighbors | None


class ClusterDiffuser(AbstractDiffuser):
    r"""Sums over the splats near each splat; for layers wider than about 2.2 spacings, over
    clusters.

    **Attributes:** (static)

    - `error`: the error of half of the points of a layer, of the layer's root mean square, where
      light changes much within the layer's width; one point in a hundred errs five times as much.
      Half of it is the power beyond the support of a layer. 0 merges no splats and truncates 4e-5
      of the power.
    - `margin`: a plan holds while the variances stay within this factor of those it was made for.
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
        exists, sizes = areas > 0, np.asarray(variances, np.float64)
        edges, supports = [0.0] * len(sizes), [0.0] * len(sizes)
        if exists.any():
            spacing = math.sqrt(areas[exists].mean())
            fine = float(np.quantile(areas[exists], FINEST))
            edges, supports = self.choose_sources(sizes, spacing, fine, kernel, interval)
        cells = sorted({edge for edge in edges if edge > 0})
        tree = ClusterTree.build(centers, normals, exists, cells)
        rows = (jnp.asarray(each) for each in (centers.T, normals.T, areas, areas[None]))
        origin, clusters = _levels(tree, Sources(*rows))
        levels = [cells.index(edge) + 1 if edge > 0 else 0 for edge in edges]
        smallest, largest = (
            [jnp.asarray(size * factor, variances.dtype) for size in sizes]
            for factor in (1 / self.margin, self.margin)
        )
        # The search is NumPy's, and runs beside that for the other layers. (JAX's precision may
        # be that of one thread.)
        points = [_target_boxes(part.centers.T - origin[:, None]) for part in parts]
        sources = [
            _sources_in_reach(clusters[levels[i]], kernel, variances[i], largest[i], supports[i])
            for i in range(len(sizes))
        ]
        with ThreadPoolExecutor() as pool:
            lists = pool.map(lambda each: _find(points, each[0], np.asarray(each[1])), sources)
        whole = jax.tree.map(lambda *rows: jnp.concatenate(rows), *points)
        neighbors = [
            None if each is None else Neighbors(each, whole, boxes, reach)
            for each, (boxes, reach) in zip(lists, sources, strict=True)
        ]
        each = zip(levels, supports, smallest, largest, neighbors, strict=True)
        return ClusterPlan(tree, tuple(LayerPlan(*layer) for layer in each))

    def choose_sources(
        self,
        variances: Float[np.ndarray, " gaussians"],
        spacing: float,
        fine: float,
        kernel: AbstractDiffusionKernel,
        interval: Float[Array, "2"],
    ) -> tuple[list[float], list[float]]:
        """Choose for each layer the edge of its cells (mm; 0 for single splats), and its support
        (standard deviations; 0 where it is not resolved).

        **Arguments:**

        - `spacing`: root of the mean area of the splats, mm.
        - `fine`: area that only `FINEST` of the splats are finer than, mm^2.
        """
        widest, area = (
            jnp.asarray(each, interval.dtype) for each in (variances * self.margin, fine)
        )
        shares = np.asarray(resolved_fraction(widest, area, interval))
        edges = _CELL * (self.error / 2e-3) ** (1 / 3) * np.sqrt(variances / self.margin)
        edges = np.where((shares > 0) & (edges > _WORTHWHILE * spacing), edges, 0.0)
        supports = [
            kernel.support(self.error, float(share)) if share > 0 else 0.0 for share in shares
        ]
        return edges.tolist(), supports


class ClusterPlan(AbstractDiffusionPlan):
    """The clusters and the neighbors of one geometry.

    **Attributes:**

    - `tree`: the clusters of all splats.
    - `layers`: one plan per Gaussian.
    """

    tree: ClusterTree
    layers: tuple[LayerPlan, ...]

    def shares(self):
        found = [each.neighbors for each in self.layers if each.neighbors is not None]
        return tuple(jax.tree.leaves([(each.lists, each.points) for each in found]))

    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: AbstractCombination,
        at: Int[Array, " points"] | None = None,
    ) -> Diffused:
        if variances.shape[0] != len(self.layers):
            raise ValueError(
                f"the plan is for {len(self.layers)} Gaussians, and the material has "
                f"{variances.shape[0]}; make another plan"
            )
        # Every device gathers the sources of all, and evaluates the layers at its own splats.
        everywhere = combination.gather_last(sources)
        origin = stop_gradient(jnp.mean(everywhere.centers, axis=1))[:, None]
        levels: list[Sources] = []
        if any(layer.neighbors is not None for layer in self.layers):
            centered = dataclasses.replace(everywhere, centers=everywhere.centers - origin)
            levels = self.tree.levels(centered)
        points = sources.centers - origin
        values, needed = [], []
        for layer, variance, depth in zip(
            self.layers, variances, kernel.depths(variances), strict=True
        ):
            smallest, largest = (
                bound.astype(variance.dtype) for bound in (layer.smallest, layer.largest)
            )
            needed.append(jnp.maximum(smallest / variance, variance / largest) * (1 - 1e-6))
            if layer.neighbors is None:
                values.append(None)
                continue
            given = levels[layer.level], points, variance, depth
            found, missed = self._layer(*given, kernel, layer.support, layer.neighbors, at)
            values.append(found)
            needed.append(missed)
        largest_need = jnp.max(jnp.stack(needed)) if needed else jnp.zeros((), variances.dtype)
        return Diffused(tuple(values), combination.largest([largest_need]))

    def _layer(
        self, clusters, points, variance, depth, kernel, support, neighbors: Neighbors, at
    ) -> tuple[LayerValues, Array]:
        """Evaluate one layer at points; also return its need of reach over the planned one."""
        lists = neighbors.lists if at is None else neighbors.lists.only(at // BLOCK)
        below = clusters.lowered(depth)
        truncated = kernel.truncated(support)
        table = layer_table(below, variance, depth, truncated)
        blocks = (points * in_sums(variance)).reshape(3, -1, BLOCK).transpose(1, 0, 2)
        values = gaussian_sums(blocks, table, lists, truncated, divided)
        if at is None:
            found = values.transpose(1, 0, 2).reshape(values.shape[1], -1)
        else:
            found = _take_from_blocks(values, at)
        needed = neighbors.needed(
            _target_boxes(points),
            Boxes.around(below.centers, below.areas > 0, SOURCES),
            support * stop_gradient(jnp.sqrt(variance)),
        )
        return split_layer(found, 2 * in_sums(variance)), needed.astype(found.dtype)


def _take_from_blocks(
    values: Float[Array, "blocks rows block"], at: Int[Array, " points"]
) -> Float[Array, "rows points"]:
    """Take points out of blocks; 0 for indices from the number of points on."""

    def index(values, at):
        return values.at[at // BLOCK, :, at % BLOCK]

    def take(at, values):
        return index(values, at).get(mode="fill", fill_value=0).T

    # JAX's own transpose begins with constant zeros, which XLA allocates for all layers at once.
    def scatter(at, taken):
        return index(zeros_after(taken, values.shape, values.dtype), at).add(taken.T, mode="drop")

    return jax.custom_derivatives.linear_call(take, scatter, at, values)


def divided(
    sums: Float[Array, "rows points"], points: Float[Array, "3 points"]
) -> Float[Array, "values points"]:
    """Compute the rows of `layer_values` from the sums of a table with slopes."""
    moments = sums.reshape(-1, 4, sums.shape[1])
    return layer_values(moments[:, 0], moments[:, 1:], points)


def layer_table(
    below: Sources,
    variance: Float[Array, ""],
    depth: Float[Array, ""],
    truncated: TruncatedGaussian,
    slopes: bool = True,
) -> SourceTable:
    """Lay out the sources of one layer: light and mass, with their first moments if slopes are
    asked for.
    """
    # A flat sheet has mass 1.
    flat = 1 / (2 * jnp.pi * variance * truncated.integral(0.5 * depth * depth / variance))
    mass = (below.areas * flat)[None]
    light = jnp.concatenate([mass * below.irradiance, mass])
    return SourceTable.of(below.centers * in_sums(variance), light, SOURCES, slopes)


def in_sums(variance: Float[Array, ""]) -> Float[Array, ""]:
    """Compute the length of a millimeter in `gaussian_sums`, whose exponent is a squared length."""
    return jnp.sqrt(0.5 / variance)


def _target_boxes(points: Float[Array, "3 points"]) -> Boxes:
    return Boxes.around(points, jnp.ones(points.shape[1], bool), BLOCK)


@eqx.filter_jit
def _levels(tree: ClusterTree, sources: Sources) -> tuple[Float[Array, "3"], list[Sources]]:
    """Compute the mean of the centers, and the clusters of every level about it."""
    origin = jnp.mean(sources.centers, axis=1)
    centered = dataclasses.replace(sources, centers=sources.centers - origin[:, None])
    return origin, tree.levels(centered)


@eqx.filter_jit
def source_boxes(clusters: Sources, depth: Float[Array, ""]) -> Boxes:
    """Enclose the sources of a layer."""
    return Boxes.around(clusters.lowered(depth).centers, clusters.areas > 0, SOURCES)


def _sources_in_reach(
    clusters: Sources, kernel: AbstractDiffusionKernel, variance, largest, support: float
) -> tuple[Boxes, Float[Array, ""]]:
    """Enclose the sources of a layer, and compute how near they are, mm; 0 without support."""
    depths = kernel.depths(jnp.stack([variance, largest]))
    # Sources of a wider layer lie deeper than those of the boxes.
    sinking = math.sqrt(3) * float(depths[1] - depths[0])
    reach = support * math.sqrt(float(largest)) + sinking if support > 0 else 0.0
    return source_boxes(clusters, depths[0]), jnp.asarray(reach, largest.dtype)


def _find(points: Sequence[Boxes], sources: Boxes, reach: np.ndarray) -> Lists | None:
    """Find the neighbors of every part, with lists padded to one size; `None` for no reach."""
    if reach == 0:
        return None
    parts = [find_neighbors(each, sources, float(reach)) for each in points]
    most = max(len(each.rows) for each in parts)
    padded = [
        dataclasses.replace(
            each, rows=jnp.pad(each.rows, ((0, most - len(each.rows)), (0, 0)), mode="edge")
        )
        for each in parts
    ]
    return jax.tree.map(lambda *rows: jnp.concatenate(rows), *padded)
