"""The fast diffuser: neighbors instead of all splats, and clusters of splats for wide layers."""

import dataclasses
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from splatjax._chunking import zeros_after
from splatjax._combination import AbstractCombination
from splatjax.scene import Splats

from ._clusters import POINTS_PER_BLOCK, ClusterTree
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
from ._neighbors import SOURCES_PER_BLOCK, Boxes, Neighbors, find_neighbors

FINE_QUANTILE = 0.01
"""Quantile of the areas of the splats: a layer counts as resolved as far as splats of that area
resolve it.
"""
_CELL = 0.6  # edge of the cells, in standard deviations, for an error of 2e-3; error ~ edge^3
_WORTHWHILE = 1.2  # edge of the cells, in spacings, from which on merging splats pays


class LayerPlan(eqx.Module):
    """How one layer is evaluated while its variance stays within a range.

    **Attributes:**

    - `level`: of the clusters that are its sources; 0 for the splats themselves. Static.
    - `smallest`, `largest`: variances, mm^2.
    - `truncated`, `neighbors`: the kernel, and what it reaches; `None` for a layer that no splat of
      note resolves at any variance of the range.
    """

    level: int = eqx.field(static=True)
    smallest: Float[Array, ""]
    largest: Float[Array, ""]
    truncated: TruncatedGaussian | None
    neighbors: Neighbors | None

    def evaluate(
        self,
        levels: Sequence[Sources],
        points: Float[Array, "3 splats"],
        around: Boxes,
        variance: Float[Array, ""],
        depth: Float[Array, ""],
        at: Int[Array, " points"] | None,
    ) -> tuple[LayerValues | None, Float[Array, ""]]:
        """Evaluate the layer at all splats, or at some of them.

        **Arguments:**

        - `levels`: the clusters of every level.
        - `points`, `around`: the centers of the splats, and boxes around their blocks.
        - `depth`: how far below its splat a source lies, mm.

        **Returns:** the layer, and the capacity needed over planned.
        """
        smallest, largest = (each.astype(variance.dtype) for each in (self.smallest, self.largest))
        needed = jnp.maximum(smallest / variance, variance / largest) * (1 - 1e-6)
        if self.neighbors is None or self.truncated is None:
            return None, needed
        # Sink the sources, and sum over those near each block of points.
        below = levels[self.level].lowered(depth)
        table = layer_table(below, variance, depth, self.truncated)
        blocks = (
            (points * units_per_mm(variance)).reshape(3, -1, POINTS_PER_BLOCK).transpose(1, 0, 2)
        )
        lists = (
            self.neighbors.lists
            if at is None
            else self.neighbors.lists.only(at // POINTS_PER_BLOCK)
        )
        values = gaussian_sums(blocks, table, lists, self.truncated, divided)
        if at is None:
            rows = values.transpose(1, 0, 2).reshape(values.shape[1], -1)
        else:
            rows = _take_from_blocks(values, at)
        largest_exponent = self.truncated.largest.astype(variance.dtype)
        reach = self.neighbors.needed(
            around,
            source_boxes(below),
            stop_gradient(jnp.sqrt(2 * largest_exponent * variance)).astype(points.dtype),
        )
        # Slopes are moments in mm over v, and the moments are in units of sqrt(2 v).
        layer = split_layer(rows, 2 * units_per_mm(variance))
        return layer, jnp.maximum(needed, reach.astype(needed.dtype))


class ClusterDiffuser(AbstractDiffuser):
    r"""Sums over the splats near each splat; for layers wider than about 2.2 spacings, over
    clusters.

    **Attributes:** (static)

    - `error`: median error of a layer over its points, relative to the layer's root mean square,
      for light that varies within the layer's width; the 99th percentile is five times as large.
      Half of it is spent on truncation. With 0, nothing is merged and 4e-5 of the power is
      truncated.
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
        edges, supports = np.zeros(len(sizes)), np.zeros(len(sizes))
        if exists.any():
            spacing = math.sqrt(areas[exists].mean())
            fine = float(np.quantile(areas[exists], FINE_QUANTILE))
            edges, supports = self.choose_sources(sizes, spacing, fine, kernel, interval)
        cells = np.unique(edges[edges > 0]).tolist()
        levels = tuple(cells.index(edge) + 1 if edge > 0 else 0 for edge in edges.tolist())
        tree = ClusterTree.build(centers, normals, exists, cells)
        rows = (jnp.asarray(each) for each in (centers.T, normals.T, areas, areas[None]))
        points, boxes, sinking = _enclose(
            tree, Sources(*rows), variances, self.margin, kernel, levels
        )
        # Sources of a wider layer lie deeper than those of the boxes.
        sinking = math.sqrt(3) * np.asarray(sinking, np.float64)
        reaches = np.where(supports > 0, supports * np.sqrt(sizes * self.margin) + sinking, 0)

        # Search all layers in parallel. Only NumPy computes in the threads, since JAX's precision
        # may be set for one thread.
        with ThreadPoolExecutor() as pool:
            find = partial(find_neighbors, points, parts=len(parts))
            lists = [
                reach and pool.submit(find, sources, reach)
                for sources, reach in zip(boxes, reaches.tolist(), strict=True)
            ]
        neighbors = [
            Neighbors(each.result(), points, sources, reach) if each else None
            for each, sources, reach in zip(
                lists, boxes, jnp.asarray(reaches, variances.dtype), strict=True
            )
        ]
        smallest, largest = (
            list(jnp.asarray(bound, variances.dtype))
            for bound in (sizes / self.margin, sizes * self.margin)
        )
        kernels = [kernel.truncated(support) if support else None for support in supports.tolist()]
        each = zip(levels, smallest, largest, kernels, neighbors, strict=True)
        return ClusterPlan(tree, tuple(LayerPlan(*layer) for layer in each))

    def choose_sources(
        self,
        variances: Float[np.ndarray, " gaussians"],
        spacing: float,
        fine: float,
        kernel: AbstractDiffusionKernel,
        interval: Float[Array, "2"],
    ) -> tuple[Float[np.ndarray, " gaussians"], Float[np.ndarray, " gaussians"]]:
        """Choose for each layer the edge of its cells (mm; 0 for single splats), and its support
        (standard deviations; 0 where it is not resolved).

        **Arguments:**

        - `spacing`: root of the mean area of the splats, mm.
        - `fine`: area that only `FINE_QUANTILE` of the splats are finer than, mm^2.
        """
        given = (jnp.asarray(each, interval.dtype) for each in (variances * self.margin, fine))
        shares = np.asarray(eqx.filter_jit(resolved_fraction)(*given, interval), np.float64)
        edges = _CELL * (self.error / 2e-3) ** (1 / 3) * np.sqrt(variances / self.margin)
        edges = np.where((shares > 0) & (edges > _WORTHWHILE * spacing), edges, 0.0)
        supports = [
            kernel.support(self.error, share) if share > 0 else 0.0 for share in shares.tolist()
        ]
        return edges, np.array(supports)


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
        depths, around = kernel.depths(variances), _target_boxes(points, sources.areas)
        evaluated = [
            layer.evaluate(levels, points, around, variance, depth, at)
            for layer, variance, depth in zip(self.layers, variances, depths, strict=True)
        ]
        needed = jnp.stack([jnp.zeros((), variances.dtype), *(need for _, need in evaluated)])
        layers = tuple(layer for layer, _ in evaluated)
        return Diffused(layers, combination.largest([jnp.max(needed)]))


def _take_from_blocks(
    values: Float[Array, "blocks rows block"], at: Int[Array, " points"]
) -> Float[Array, "rows points"]:
    """Take points out of blocks; 0 for indices from the number of points on."""

    def index(values, at):
        return values.at[at // POINTS_PER_BLOCK, :, at % POINTS_PER_BLOCK]

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
    light, *first_moments = sums.reshape(4, -1, sums.shape[1])
    return layer_values(light, jnp.stack(first_moments, axis=1), points)


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
    return SourceTable.of(below.centers * units_per_mm(variance), light, SOURCES_PER_BLOCK, slopes)


def units_per_mm(variance: Float[Array, ""]) -> Float[Array, ""]:
    """Compute how many units of length of `gaussian_sums`, `sqrt(2 v)`, are in a millimeter."""
    return jnp.sqrt(0.5 / variance)


def _target_boxes(points: Float[Array, "3 points"], areas: Float[Array, " points"]) -> Boxes:
    """Enclose the blocks of points; a block of splats without area is empty."""
    exists = jnp.any((areas > 0).reshape(-1, POINTS_PER_BLOCK), axis=1)
    return Boxes.around(points, jnp.repeat(exists, POINTS_PER_BLOCK), POINTS_PER_BLOCK)


@eqx.filter_jit
def _enclose(
    tree: ClusterTree,
    sources: Sources,
    variances: Float[Array, " gaussians"],
    margin: float,
    kernel: AbstractDiffusionKernel,
    levels: tuple[int, ...],
) -> tuple[Boxes, list[Boxes], Float[Array, " gaussians"]]:
    """Enclose the blocks of points, and the blocks of sources of every layer; also compute how much
    deeper the sources of the widest layer lie for which a plan holds, mm.
    """
    centers = sources.centers - jnp.mean(sources.centers, axis=1)[:, None]
    clusters = tree.levels(dataclasses.replace(sources, centers=centers))
    depths = kernel.depths(variances)
    boxes = [
        source_boxes(clusters[level].lowered(depth))
        for level, depth in zip(levels, depths, strict=True)
    ]
    targets = _target_boxes(centers, sources.areas)
    return targets, boxes, kernel.depths(variances * margin) - depths


@eqx.filter_jit
def source_boxes(below: Sources) -> Boxes:
    """Enclose the sources of a layer, sunk below their splats. Not differentiated."""
    return Boxes.around(below.centers, below.areas > 0, SOURCES_PER_BLOCK)
