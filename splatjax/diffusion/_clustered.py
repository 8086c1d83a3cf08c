"""The fast diffuser: clusters instead of splats, and for wide layers some points of the body
instead of every pixel.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import Atlas, BinCapacity, Bins

from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources
from ._gathering import Gathering, blended_nodes, nodes_table
from ._gaussian_sums import Steps, as_they_are, faded, gaussian_sums, gaussian_sums_forward, tapered
from ._handover import resolved_share
from ._neighbors import Boxes, Neighbors
from ._order import BLOCK
from ._pixels import FAR, Pixels, block_ranges, tile_grid
from ._tree import Clusters, ClusterTree

FINEST = 0.01
"""Share of the splats that may be finer than those that tell how much of a layer is carried."""
_LEAST_LEFT_OUT, _MOST_LEFT_OUT = (
    4e-5,
    0.1,
)  # share of a layer's power beyond its support: 4.5 and 2.1 standard deviations
_LEAST_SHARE = 1e-3  # of the diffusion integral in a layer that counts at all
_LANES = 32
_SOURCES = 16  # of a block that gathers into points, and how many blocks a step holds
_SOURCE_SLOTS = 4
_NODES = 8  # the same of nodes that are blended into pixels
_NODE_SLOTS = 8
# edge of the cells, in standard deviations, for an error of 2e-3, which grows with its third power
_CELL = 0.6
_WORTHWHILE = 2.0  # edge of the cells, in spacings, from which on clusters are so few that they pay
_SMOOTHING = 0.5  # standard deviation of the blend of nodes, in edges of their cells, at least
_BLENDED = 3.0  # support of the blend, standard deviations


class NodePlan(eqx.Module):
    """Points of the body at which a layer is evaluated, to be blended into the pixels: the clusters
    themselves.
    """

    neighbors: Neighbors
    deviations: Float[Array, " nodes"]
    """Of the blend, mm: within `_BLENDED` of them of some node there is every pixel."""

    def blocks(self, rows: Float[Array, "rows nodes"]) -> Float[Array, "blocks rows _"]:
        """Cut what belongs to the nodes into the blocks that are swept, and some that are far from
        everything.
        """
        steps = self.neighbors.steps
        blocks = rows.reshape(rows.shape[0], -1, BLOCK).transpose(1, 0, 2)
        return jnp.pad(
            blocks,
            ((0, steps.order.shape[0] - blocks.shape[0]), (0, 0), (0, 0)),
            constant_values=FAR,
        )

    def in_row(
        self, blocks: Float[Array, "blocks rows _"], nodes: int
    ) -> Float[Array, "rows nodes"]:
        """Undo `blocks`."""
        return blocks[: nodes // BLOCK].transpose(1, 0, 2).reshape(blocks.shape[1], nodes)

    def asked(self, bins: Bins, nodes: int) -> Steps:
        """Leave out the sweeps none of whose nodes any tile lists."""
        steps, blocks = self.neighbors.steps, nodes // BLOCK
        lanes, sweeps = steps.ids.shape[1], steps.begins.shape[0]
        listed = jnp.zeros(2 * nodes // _NODES + 1, bool).at[bins.ids.reshape(-1)].set(True)[:-1]
        asked = jnp.any(listed.reshape(2, blocks, -1), axis=(0, 2))
        asked = jnp.any(jnp.pad(asked, (0, sweeps * lanes - blocks)).reshape(sweeps, lanes), axis=1)
        return Steps(
            steps.ids, steps.begins, jnp.where(asked, steps.ends, steps.begins), steps.order
        )


class LayerPlan(eqx.Module):
    """How one layer is evaluated. It holds while the variance stays within the range."""

    level: int = eqx.field(static=True)
    support: float = eqx.field(static=True)
    """Sources farther away, in standard deviations of the layer, are left out."""
    smallest: Float[Array, ""]
    largest: Float[Array, ""]
    capacity: BinCapacity | None
    """Of the tiles' lists; None for a layer that is handed over to the surface at every variance of
    the range.
    """
    nodes: NodePlan | None
    """None for a layer that every pixel gathers for itself."""


class ClusterDiffuser(AbstractDiffuser):
    r"""Sums over clusters of splats, at points of the body close enough to be blended, or at every
    pixel.

    **Attributes:** (static)

    - `error`: what half of the pixels of a layer may be off, of the layer's root mean square, where
      light changes much within its width; one pixel in a hundred is off by five times as much. Half
      of it is the power beyond the support of a layer, less its share that is handed over. 0 merges
      no splats, and every pixel gathers for itself; beyond the support there is 4e-5 then.
    - `margin`: a plan holds while the variances stay within this factor of those that it was made
      for.
    - `sums`: `gaussian_sums`, which has reverse mode, or `gaussian_sums_forward`.
    """

    error: float = eqx.field(static=True, default=2e-3)
    margin: float = eqx.field(static=True, default=1.25)
    sums: Callable[..., Array] = eqx.field(static=True, default=gaussian_sums)
    tree: ClusterTree | None = None
    layers: tuple[LayerPlan, ...] | None = None

    def planned(
        self,
        splats: Splats,
        kernels: Kernels,
        interval: Float[Array, "2"],
        atlases: Sequence[Atlas],
    ) -> "ClusterDiffuser":
        values = np.asarray(kernels.variances, np.float64)
        areas = np.asarray(splats.areas, np.float64)
        if areas.size == 0:
            layers = tuple(
                LayerPlan(0, 0.0, jnp.zeros(()), jnp.full((), jnp.inf), None, None) for _ in values
            )
            none = ClusterTree(jnp.zeros(0, jnp.int32), (), ())
            return eqx.tree_at(_parts, self, (none, layers), is_leaf=_is_none)
        spacing = math.sqrt(areas.mean())
        radii = np.asarray(splats.radii)
        begin, fine = (
            float(interval[0]) ** 2,
            jnp.asarray(np.quantile(areas, FINEST), kernels.variances.dtype),
        )
        shares = np.asarray(resolved_share(kernels.variances * self.margin, fine, interval))
        carried = shares > 0
        edges = self.edges(values / self.margin, spacing, carried)
        cells = sorted({float(edge) for edge in edges if edge > 0})
        tree = ClusterTree.build(splats.centers, splats.normals, cells)
        origin, levels = _levels(tree, splats)
        layers = []
        for v, depth, edge, share in zip(values, kernels.depths, edges, shares, strict=True):
            support = self.support(float(share))
            level = cells.index(edge) + 1 if edge > 0 else 0
            nodes = capacity = None
            if share > 0:
                largest = v * self.margin
                if edge > 0 and self._in_pixels(float(edge), atlases, splats) > 1:
                    carriers = np.where(areas * begin < largest, radii, np.zeros_like(radii))
                    farthest = tree.largest(carriers, level)
                    nodes = self._plan_nodes(
                        levels[level], largest, depth, float(edge), support, farthest
                    )
                capacity = self.capacity_at(
                    origin, levels[level], nodes, largest, depth, support, atlases
                )
            smallest, largest = (
                jnp.asarray(edge, depth.dtype) for edge in (v / self.margin, v * self.margin)
            )
            layers.append(LayerPlan(level, support, smallest, largest, capacity, nodes))
        return eqx.tree_at(_parts, self, (tree, tuple(layers)), is_leaf=_is_none)

    def edges(
        self,
        variances: Float[np.ndarray, " gaussians"],
        spacing: float,
        carried: Bool[np.ndarray, " gaussians"],
    ) -> Float[np.ndarray, " gaussians"]:
        """Give the edge (mm) of the cells of each layer; 0 where single splats are as few."""
        edges = _CELL * (self.error / 2e-3) ** (1 / 3) * np.sqrt(variances)
        return np.where(carried & (edges > _WORTHWHILE * spacing), edges, 0.0)

    def support(self, share: float) -> float:
        """Give the support of a layer, standard deviations, of which the diffusion integral is a
        share.

        In eighths, so that plans that are nearly alike are the same to the compiler.
        """
        left_out = max(0.5 * self.error / max(share, _LEAST_SHARE), _LEAST_LEFT_OUT)
        return round(8 * math.sqrt(2 * math.log(1 / min(left_out, _MOST_LEFT_OUT)))) / 8

    def _in_pixels(self, edge: float, atlases: Sequence[Atlas], splats: Splats) -> float:
        """Give the length of an edge amid the splats, in pixels of the closest view."""
        views = [atlas.view for atlas in atlases]
        depths = (view.project(jnp.mean(splats.centers, axis=0)[:, None])[2] for view in views)
        return max(
            edge * float(view.pixels_per_mm(depth)[0])
            for view, depth in zip(views, depths, strict=True)
        )

    def _plan_nodes(
        self, clusters: Clusters, variance: float, depth, edge: float, support: float, radii
    ) -> NodePlan:
        """Find what nodes gather from. Pixels are within a radius of a splat's center, and that
        within 0.87 edges of a node.
        """
        # Sources of a wider layer lie deeper, where clusters may be wider too.
        boxes, sources, spread = _boxes(clusters, depth, depth * math.sqrt(self.margin))
        sinking = math.sqrt(3) * float(depth) * (math.sqrt(self.margin) - 1)
        reach = support * math.sqrt(variance + float(spread)) + sinking
        neighbors = Neighbors.find(
            boxes, sources, reach, min(_LANES, boxes.low.shape[1]), _SOURCE_SLOTS
        )
        return NodePlan(
            neighbors,
            jnp.asarray(
                np.maximum(_SMOOTHING * edge, (radii + 0.87 * edge) / _BLENDED), depth.dtype
            ),
        )

    def capacity_at(
        self,
        origin,
        clusters: Clusters,
        nodes: NodePlan | None,
        variance: float,
        depth,
        support: float,
        atlases: Sequence[Atlas],
    ) -> BinCapacity:
        """Find how much the lists of tiles must hold: sources, or nodes."""
        if nodes is None:
            clusters, reach = _reaching(
                clusters, depth, jnp.asarray(variance, depth.dtype), support
            )
            size = _SOURCES, _SOURCE_SLOTS
        else:
            reach = _BLENDED * nodes.deviations
            size = _NODES, _NODE_SLOTS
        counts = [_demand(clusters, origin, reach, *size, atlas) for atlas in atlases]
        return BinCapacity.for_counts(
            counts, tile_grid(atlases[0].view.width, atlases[0].view.height, size[1])
        )

    def in_forward_mode(self) -> "ClusterDiffuser":
        return dataclasses.replace(self, sums=gaussian_sums_forward)

    def diffuse(
        self,
        sources: Sources,
        kernels: Kernels,
        points: Float[Array, "tiles 3 points"],
        covered: Bool[Array, "tiles points"],
        atlas: Atlas,
    ) -> Diffused:
        tree, _ = self.plans(kernels)

        def within() -> tuple[list[Clusters], Pixels]:
            origin = stop_gradient(jnp.mean(sources.centers, axis=1))
            levels = tree.levels(
                dataclasses.replace(sources, centers=sources.centers - origin[:, None])
            )
            return levels, Pixels.of(points, covered, origin, atlas)

        return self.spread(within, kernels, sources.irradiance.shape[0], covered, self.at_pixels)

    def plans(self, kernels: Kernels) -> tuple[ClusterTree, tuple[LayerPlan, ...]]:
        """Give the tree, and the plans of the layers.

        **Raises:** `ValueError` where there are none, or not as many as kernels.
        """
        if self.tree is None or self.layers is None:
            raise ValueError(
                "this ClusterDiffuser has no clusters yet; take one from a plan (splatjax.plan) or "
                "from `planned`"
            )
        if kernels.variances.shape[0] != len(self.layers):
            raise ValueError(
                f"this plan is for {len(self.layers)} Gaussians, not {kernels.variances.shape[0]}; "
                "make it anew"
            )
        return self.tree, self.layers

    def spread(
        self,
        within: Callable[[], tuple[Sequence[Clusters], Pixels]],
        kernels: Kernels,
        channels: int,
        covered: Bool[Array, "tiles points"],
        single: Callable,
    ) -> Diffused:
        """Evaluate every layer at the covered points, from the clusters of its level.

        **Arguments:**

        - `within`: gives the clusters of every level, and the points; not asked where no layer is
          carried.
        - `single`: how a layer of single splats is gathered, like `at_pixels`.
        """
        dtype, (_, plans) = kernels.variances.dtype, self.plans(kernels)
        carried = jnp.asarray([layer.capacity is not None for layer in plans], dtype)
        empty = jnp.zeros((covered.shape[0], channels + 1, covered.shape[1]), dtype)
        layers, needed, known = [], [], None
        plans = jax.tree.map(
            lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, plans
        )
        for variance, depth, layer in zip(kernels.variances, kernels.depths, plans, strict=True):
            if layer.capacity is None:
                layers.append(empty)
            else:
                levels, pixels = within() if known is None else known
                known = levels, pixels
                gathering = Gathering.of(levels[layer.level], variance, depth)
                if layer.nodes is None:
                    gather = single if layer.level == 0 else self.at_pixels
                    values, need = gather(gathering, layer.support, layer.capacity, pixels)
                else:
                    rest = layer.nodes, layer.support, layer.capacity, pixels
                    values, need = self._through_nodes(levels[layer.level], gathering, *rest)
                layers.append(jnp.where(covered[:, None], values[:-1], 0.0))
                needed.append(need.astype(dtype))
            needed.append(
                jnp.maximum(layer.smallest / variance, variance / layer.largest) * (1 - 1e-6)
            )
        needed = stop_gradient(jnp.max(jnp.stack(needed))) if needed else jnp.zeros((), dtype)
        found = jnp.stack(layers, axis=1) if layers else empty[:, None][:, :0]
        return Diffused(found[:, :, :channels], found[:, :, channels], carried, needed)

    def at_pixels(
        self,
        gathering: Gathering,
        support: float,
        capacity: BinCapacity,
        pixels: Pixels,
        finish: Callable | None = None,
    ):
        """Let every pixel gather for itself; what it gathers means what `finish` says, or the
        gathering.
        """
        clusters = gathering.clusters
        reach = support * jnp.sqrt(gathering.wide)
        bins = pixels.bins(
            clusters.centers, clusters.areas > 0, reach, _SOURCES, _SOURCE_SLOTS, capacity
        )
        table = gathering.table(_SOURCES, slopes=False)
        finish = gathering.finish if finish is None else finish
        values = self.sums(
            pixels.tiles, table, pixels.steps(bins, table.shape[0] - 1), faded(support), finish
        )
        return values, bins.needed

    def _through_nodes(
        self,
        nodes: Clusters,
        gathering: Gathering,
        plan: NodePlan,
        support: float,
        capacity: BinCapacity,
        pixels: Pixels,
    ):
        """Let the nodes gather, and blend them into the pixels."""
        there, count = nodes.areas > 0, nodes.areas.shape[0]
        bins = pixels.bins(
            nodes.centers, there, _BLENDED * plan.deviations, _NODES, _NODE_SLOTS, capacity
        )
        blocks = plan.blocks(jnp.where(there, nodes.centers, FAR))
        sums = self.sums(
            blocks,
            gathering.table(_SOURCES, slopes=True),
            plan.asked(bins, count),
            faded(support),
            as_they_are,
        )
        at = jnp.where(there, nodes.centers, 0.0)
        values, slopes = gathering.values_and_slopes(plan.in_row(sums, count), at)
        table = nodes_table(at, nodes.areas, values, slopes, 0.5 / plan.deviations**2, _NODES)
        found = self.sums(
            pixels.tiles,
            table,
            pixels.steps(bins, table.shape[0] - 1),
            tapered(_BLENDED),
            blended_nodes,
        )
        moved = plan.neighbors.needed(
            Boxes.around(nodes.centers, there, BLOCK),
            Boxes.around(gathering.clusters.centers, there, _SOURCES),
            support * jnp.sqrt(jnp.max(stop_gradient(gathering.wide))),
        )
        return found, jnp.maximum(bins.needed.astype(moved.dtype), moved)


def _parts(diffuser: ClusterDiffuser):
    return diffuser.tree, diffuser.layers


def _is_none(leaf) -> bool:
    return leaf is None


@eqx.filter_jit
def _levels(tree: ClusterTree, splats: Splats) -> tuple[Float[Array, "3"], list[Clusters]]:
    """Give the middle of the splats, and the clusters of every level about it."""
    origin = jnp.mean(splats.centers, axis=0)
    sources = Sources(
        splats.centers.T - origin[:, None], splats.normals.T, splats.areas, splats.areas[None]
    )
    return origin, tree.levels(sources)


@eqx.filter_jit
def _boxes(clusters: Clusters, depth: Float[Array, ""], deeper: Float[Array, ""]):
    """Give boxes around nodes and around sources, and the greatest spread of these at both
    depths.
    """
    below, there = clusters.lowered(depth), clusters.areas > 0
    spread = jnp.maximum(jnp.max(below.spread), jnp.max(clusters.lowered(deeper).spread))
    return (
        Boxes.around(clusters.centers, there, BLOCK),
        Boxes.around(below.centers, there, _SOURCES),
        spread,
    )


@eqx.filter_jit
def _reaching(
    clusters: Clusters, depth: Float[Array, ""], variance: Float[Array, ""], support: float
):
    """Give the sources of a layer, and how far each of them reaches, mm."""
    below = clusters.lowered(depth)
    return below, support * jnp.sqrt(variance + below.spread)


@eqx.filter_jit
def _demand(clusters: Clusters, origin, reach, block: int, slots: int, atlas: Atlas):
    """Count what every tile lists."""
    grid = tile_grid(atlas.view.width, atlas.view.height, slots)
    centers, there = clusters.centers + origin[:, None], clusters.areas > 0
    return block_ranges(centers, there, reach, block, atlas.view, atlas.farthest).per_tile(grid)
