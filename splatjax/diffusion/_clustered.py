"""The fast diffuser: neighbors instead of all splats, and clusters of splats for wide layers."""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax._chunking import jit_unless_traced, take_points
from splatjax._combination import DeviceMesh
from splatjax.scene import Splats

from ._clusters import POINTS_PER_BLOCK, SOURCES_PER_BLOCK, LayerSources
from ._diffuser import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    Sources,
    layer_values,
)
from ._gaussian_sums import SourceTable, gaussian_sums
from ._kernel import AbstractDiffusionKernel, TruncatedGaussian, resolved_fraction
from ._neighbors import Boxes, NeighborLists, find_neighbors

# Quantile of the areas of the splats: a layer is resolved as far as splats of that area resolve it.
FINE_QUANTILE = 0.01
_CELL = 0.6  # edge of the cells, in standard deviations, for an error of 2e-3; error ~ edge^3
_LAYERS = 2  # the number of layers is padded to a multiple of this, to share programs
_WORTHWHILE = 1.2  # least edge of a cell, in spacings, for which splats are merged


class ClusterDiffuser(AbstractDiffuser):
    r"""Sums over the splats near each splat; for layers wider than about 2.2 spacings, over
    clusters.

    **Attributes:** (static)

    - `error`: median error of a layer over its points, relative to the layer's root mean square,
      for light that varies within the layer's width; the 99th percentile is five times as large.
      Half of it is caused by truncating the Gaussians. With 0 no splats are merged, and only 4e-5
      of the power is cut off.
    - `margin`: factor on the planned variances within which a plan is valid.
    """

    error: float = eqx.field(static=True, default=2e-3)
    margin: float = eqx.field(static=True, default=1.25)

    def make_plan(
        self,
        splats: Splats,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        interval: Float[Array, "2"],
        devices: int = 1,
    ) -> "ClusterPlan":
        centers, normals, areas = map(np.asarray, (splats.centers, splats.normals, splats.areas))
        exists, spacing, fine = areas > 0, math.inf, math.inf
        if exists.any():
            spacing = math.sqrt(areas[exists].mean())
            fine = float(np.quantile(areas[exists], FINE_QUANTILE))
        gaussians, sizes, edges, supports = self.choose_layers(
            np.asarray(variances, np.float64), spacing, fine, kernel, interval
        )
        clusters = LayerSources.build(centers, normals, exists, edges.tolist())
        rows = (jnp.asarray(array) for array in (centers.T, normals.T, areas, areas[None]))
        layer_variances = jnp.asarray(sizes, variances.dtype)
        points, boxes, sinking = _enclose(
            clusters, Sources(*rows), layer_variances, self.margin, kernel
        )
        # Sources of a wider layer lie deeper than those of the boxes.
        sinking = math.sqrt(3) * np.asarray(sinking, np.float64)
        reaches = np.where(edges < np.inf, supports * np.sqrt(sizes * self.margin) + sinking, 0)
        lists = find_neighbors(points, boxes, clusters.layers, reaches.tolist(), devices)
        endless = jnp.asarray(np.where(reaches > 0, reaches, np.inf), variances.dtype)
        return ClusterPlan(
            gaussians=jnp.asarray(gaussians, jnp.int32),
            sources=clusters,
            kernels=kernel.truncated(supports),
            lists=lists,
            point_boxes=points,
            source_boxes=boxes,
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
        - `fine`: the `FINE_QUANTILE` quantile of the splats' areas, mm^2.

        **Returns:** for each layer its Gaussian, the variance (mm^2), the edge of its cells (mm; 0
        for single splats), and the support (standard deviations).
        """
        inputs = (jnp.asarray(value, interval.dtype) for value in (variances * self.margin, fine))
        shares = np.asarray(eqx.filter_jit(resolved_fraction)(*inputs, interval), np.float64)
        edges = _CELL * (self.error / 2e-3) ** (1 / 3) * np.sqrt(variances / self.margin)
        edges = np.where(edges > _WORTHWHILE * spacing, edges, 0.0)
        gaussians = np.flatnonzero(shares > 0)
        lacking = max(-(-len(gaussians) // _LAYERS), 1) * _LAYERS - len(gaussians)
        supports = [kernel.support(self.error, share) for share in shares[gaussians].tolist()]
        chosen = gaussians, variances[gaussians], edges[gaussians], np.array(supports, float)
        return tuple(
            np.pad(column, (0, lacking), constant_values=fill)
            for column, fill in zip(chosen, (len(variances), 1, np.inf, 1), strict=True)
        )


class ClusterPlan(AbstractDiffusionPlan):
    """The sources and the neighbors of one geometry.

    **Attributes:**

    - `sources`: the sources of every layer: splats, or clusters of splats.
    - `kernels`: the kernel of every layer.
    - `lists`: the blocks of sources within reach of every block of points.
    - `point_boxes`, `source_boxes`, `reaches`: the boxes of points and sources, and the reach of
      each layer (mm), for which `lists` is complete.
    - `variances`, `margin`: the plan is valid for variances (mm^2) that differ from these by at
      most the factor `margin`. Fewer variances are compared with the first of these.
    """

    sources: LayerSources
    kernels: TruncatedGaussian
    lists: NeighborLists
    point_boxes: Boxes
    source_boxes: Boxes
    reaches: Float[Array, " layers"]
    variances: Float[Array, " gaussians"]
    margin: Float[Array, ""]

    def shares(self):
        return tuple(jax.tree.leaves((self.lists, self.point_boxes)))

    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: DeviceMesh,
        at: Int[Array, " points"] | None = None,
    ) -> Diffused:
        # Every device gathers the sources of all, and evaluates the layers at its own splats.
        everywhere = combination.gather(sources, axis=-1).of_layers(self.gaussians)
        origin = jax.lax.stop_gradient(jnp.mean(everywhere.centers, axis=1))[:, None]
        centered = dataclasses.replace(everywhere, centers=everywhere.centers - origin)
        points = sources.centers - origin
        layer_variances = self.variances_of_layers(variances)
        depths = kernel.depths(layer_variances)

        # Sink the sources and merge them; sum over those near each block of points.
        below = self.sources.merged(centered, depths)
        sums = layer_sums(
            points.reshape(3, -1, POINTS_PER_BLOCK).swapaxes(0, 1),
            below,
            self.sources.layers,
            self.lists,
            layer_variances,
            self.kernels,
            at,
            forward_mode=self.forward_mode,
        )
        per_mm = units_per_mm(layer_variances)[:, None]
        seen = take_points(points, at)
        layers = jax.checkpoint(layer_values)(  # keeps the sums alone for the derivative
            sums.reshape(len(layer_variances), -1, 4, seen.shape[1]),
            per_mm[:, None] * seen[None],
            2 * per_mm,  # slopes are moments in mm over v, and moments are in units of sqrt(2 v)
            per_flat_mass(self.kernels, layer_variances, depths)[:, None],
        )

        # The needed over the planned capacity.
        moved = source_boxes(below).beyond(self.source_boxes)
        moved = jax.ops.segment_max(moved, self.sources.layers, len(self.reaches))
        points_moved = _target_boxes(points, sources.areas).beyond(self.point_boxes)
        moved = jnp.maximum(moved, 0) + jnp.max(points_moved, initial=0)
        largest = self.kernels.largest.astype(layer_variances.dtype)
        reaches = jnp.sqrt(2 * largest * jax.lax.stop_gradient(layer_variances))
        planned = self.variances[: len(variances)]
        varied = jnp.max(jnp.maximum(planned / variances, variances / planned), initial=0)
        varied = varied / (self.margin * (1 + 1e-6))
        missing = jnp.max((reaches + math.sqrt(3) * moved) / self.reaches)
        needed = jnp.maximum(varied, missing)
        return Diffused(layers, combination.largest([needed.astype(variances.dtype)]))


@jit_unless_traced
def layer_sums(
    points: Float[Array, "blocks 3 block"],
    below: Sources,
    layers: Int[Array, " source_blocks"],
    lists: NeighborLists,
    variances: Float[Array, " layers"],
    kernels: TruncatedGaussian,
    at: Int[Array, " targets"] | None = None,
    moments: bool = True,
    forward_mode: bool = False,
) -> Float[Array, "layers sums targets"]:
    """Sum the light in each channel and the mass of the sources of every layer around points, as
    `gaussian_sums`; each is followed by its first moments if requested.

    **Arguments:**

    - `points`: mm, from the origin of the sources.
    - `layers`: the layer of every block of sources.
    """
    per_mm = units_per_mm(variances)
    centers = below.centers.reshape(3, -1, SOURCES_PER_BLOCK) * per_mm[layers][None, :, None]
    light = below.areas[None] * jnp.pad(below.irradiance, ((0, 1), (0, 0)), constant_values=1)
    light = light.reshape(len(light), -1, SOURCES_PER_BLOCK)
    table = SourceTable(tuple(centers), tuple(light), moments)
    points = per_mm[:, None, None, None] * points[None]
    return gaussian_sums(points, table, lists, kernels, at, forward_mode)


def per_flat_mass(
    kernels: TruncatedGaussian, variances: Float[Array, " layers"], depths: Float[Array, " layers"]
) -> Float[Array, " layers"]:
    """Compute the factor that gives a flat sheet the mass 1."""
    return 1 / (2 * jnp.pi * variances * kernels.integral(0.5 * depths * depths / variances))


def units_per_mm(variances: Float[Array, " layers"]) -> Float[Array, " layers"]:
    """Compute the number of length units of `gaussian_sums`, `sqrt(2 v)`, per millimeter."""
    return jnp.sqrt(0.5 / variances)


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
    sinking = kernel.depths(variances * margin) - depths
    return _target_boxes(centers, splats.areas), source_boxes(below), sinking


@eqx.filter_jit
def source_boxes(below: Sources) -> Boxes:
    """Enclose the sources of layers below their splats. Not differentiated."""
    return Boxes.around(below.centers, below.areas > 0, SOURCES_PER_BLOCK)
