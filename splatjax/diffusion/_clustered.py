"""The fast diffuser: clusters instead of splats, a coarse grid of points instead of pixels, for wide layers."""

import dataclasses
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import AbstractView, BinCapacity, TileGrid, TileRanges, bin_items

from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources
from ._gauss_tiles import gaussian_sums, gaussian_sums_forward
from ._resample import Samples, block_samples, resample
from ._tree import Clusters, ClusterTree

_FAR = -1e6
_FINEST = 0.01  # share of the splats that may be fine enough for a layer that is handed over everywhere


class LayerPlan(eqx.Module):
    """How one layer is evaluated. Static; it holds while the variance stays within the range."""

    level: int = eqx.field(static=True)
    stride: int = eqx.field(static=True)
    smallest: float = eqx.field(static=True)
    largest: float = eqx.field(static=True)
    capacity: BinCapacity | None
    """None for a layer that is handed over to the surface at every variance of the range."""


class ClusterDiffuser(AbstractDiffuser):
    r"""Sums over clusters of splats, at a coarse grid of surface points, and resamples to the pixels.

    A setting of 0 switches an approximation off; what is left of the error then is the support's.

    **Attributes:** (static; lengths in standard deviations of the layer)

    - `support`: sources farther away are left out. 4.5 leaves out 4e-5 of a Gaussian's power.
    - `cluster_size`: the edge of the cells in which splats are merged is at most this; 0 merges none.
    - `pixel_size`: the distance between the points of the coarse grid is at most this; 0 evaluates every pixel.
    - `sums`: `gaussian_sums`, which has reverse mode, or `gaussian_sums_forward`.
    - `margin`: a plan holds while the variances stay within this factor of those that it was made for.
    """

    support: float = eqx.field(static=True, default=4.5)
    cluster_size: float = eqx.field(static=True, default=1.0)
    pixel_size: float = eqx.field(static=True, default=0.35)
    margin: float = eqx.field(static=True, default=1.25)
    lanes: int = eqx.field(static=True, default=32)
    slots: int = eqx.field(static=True, default=32)
    sums: Callable[..., Array] = eqx.field(static=True, default=gaussian_sums)
    tree: ClusterTree | None = None
    layers: tuple[LayerPlan, ...] | None = None

    def planned(
        self,
        splats: Splats,
        kernels: Kernels,
        interval: Float[Array, "2"],
        views: Sequence[AbstractView],
    ) -> "ClusterDiffuser":
        values = np.asarray(kernels.variances, np.float64)
        areas = np.asarray(splats.areas, np.float64)
        if areas.size == 0:
            layers = tuple(LayerPlan(0, 1, 0.0, math.inf, None) for _ in values)
            return eqx.tree_at(_parts, self, (ClusterTree((), (), ()), layers), is_leaf=_is_none)
        spacing = math.sqrt(areas.mean())
        narrowest = float(interval[0]) ** 2 * np.quantile(areas, _FINEST)
        edges = [self._cell(math.sqrt(v / self.margin), spacing) for v in values]
        cells = sorted({edge for edge, v in zip(edges, values, strict=True) if edge > 0 and v * self.margin > narrowest})
        tree = ClusterTree.build(splats.centers, cells)
        levels = tree.levels(Sources(splats.centers.T, splats.normals.T, splats.areas, splats.areas[None]))
        centers = splats.centers.T
        layers = []
        for v, depth, edge in zip(values, kernels.depths, edges, strict=True):
            level = cells.index(edge) + 1 if edge in cells else 0
            stride = min(self._stride(math.sqrt(v / self.margin), view, centers) for view in views)
            capacity = None
            if v * self.margin > narrowest:
                largest = jnp.asarray(v * self.margin, splats.areas.dtype)
                sources = levels[level].lowered(jnp.asarray(depth, largest.dtype))
                counts = [_demand(self, splats, sources, largest, stride, view) for view in views]
                capacity = BinCapacity.for_counts(counts, self._grid(views[0].width, views[0].height, stride))
            layers.append(LayerPlan(level, stride, float(v) / self.margin, float(v) * self.margin, capacity))
        return eqx.tree_at(_parts, self, (tree, tuple(layers)), is_leaf=_is_none)

    def _cell(self, deviation: float, spacing: float) -> float:
        """The largest power of two that is small enough; 0 where cells would hold a splat or two."""
        largest = self.cluster_size * deviation
        return 2.0 ** math.floor(math.log2(largest)) if largest > 1.5 * spacing else 0.0

    def _stride(self, deviation: float, view: AbstractView, centers: Float[Array, "3 splats"]) -> int:
        depth = view.project(centers)[2]
        pixels = deviation * float(view.pixels_per_mm(jnp.max(depth))) * self.pixel_size
        return 2 ** min(max(math.floor(math.log2(pixels)), 0), 5) if pixels > 1 else 1

    def _grid(self, width: int, height: int, stride: int) -> TileGrid:
        return TileGrid(-(-width // stride), -(-height // stride), 8, self.lanes, self.slots)

    def in_forward_mode(self) -> "ClusterDiffuser":
        return dataclasses.replace(self, sums=gaussian_sums_forward)

    def diffuse(
        self,
        sources: Sources,
        kernels: Kernels,
        points: Float[Array, "surfaces 3 height width"],
        covered: Bool[Array, "surfaces height width"],
        view: AbstractView,
    ) -> Diffused:
        if self.tree is None or self.layers is None:
            raise ValueError("this ClusterDiffuser has no clusters yet; take one from a plan (splatjax.plan) or from `planned`")
        if kernels.variances.shape[0] != len(self.layers):
            raise ValueError(f"this plan is for {len(self.layers)} Gaussians, not {kernels.variances.shape[0]}; make it anew")
        channels = sources.irradiance.shape[0]
        levels = self.tree.levels(sources)
        layers, needed = [], []
        for variance, depth, layer in zip(kernels.variances, kernels.depths, self.layers, strict=True):
            if layer.capacity is None:
                layers.append(jnp.zeros((2, channels + 1, *covered.shape[1:]), points.dtype))
            else:
                clusters = levels[layer.level].lowered(depth)
                values, need = self._layer(clusters, variance, depth, layer, points, covered, view)
                layers.append(values)
                needed.append(need)
            needed.append(jnp.maximum(layer.smallest / variance, variance / layer.largest) * (1 - 1e-6))
        needed = stop_gradient(jnp.max(jnp.stack(needed))) if needed else jnp.zeros((), points.dtype)
        carried = jnp.asarray([layer.capacity is not None for layer in self.layers], points.dtype)
        found = jnp.stack(layers) if layers else jnp.zeros((0, 2, channels + 1, *covered.shape[1:]), points.dtype)
        return Diffused(found[:, :, :channels], found[:, :, channels], carried, needed)

    def _layer(self, clusters: Clusters, variance, depth, layer: LayerPlan, points, covered, view: AbstractView):
        """Evaluate one layer, and last its exits, at the samples of both surfaces and resample them to the pixels of both."""
        grid = self._grid(view.width, view.height, layer.stride)
        if layer.stride == 1:
            each = [
                self._integrals(clusters, variance, depth, layer, *surface, grid, view, 0)
                for surface in zip(points, covered, strict=True)
            ]
            return jnp.stack([values for values, _, _ in each]), jnp.max(jnp.stack([need for _, _, need in each]))
        where, there = block_samples(points[0], covered[0], layer.stride, stop_gradient(variance))
        values, slopes, need = self._integrals(clusters, variance, depth, layer, where, there, grid, view, 1)
        samples = Samples(where, there, values, slopes)
        pixels = [resample(samples, surface, variance, layer.stride) for surface in points]
        return jnp.where(covered[:, None], jnp.stack(pixels), 0.0), need

    def _integrals(self, clusters: Clusters, variance, depth, layer: LayerPlan, points, there, grid: TileGrid, view, order: int):
        """Give the means and the exits at points, and for `order` 1 their slopes in space."""
        assert layer.capacity is not None
        # A cluster is as wide as its splats are spread.
        wide = variance + clusters.spread
        flat = jnp.exp(0.5 * depth * depth / wide) / (2 * jnp.pi * wide)  # what makes a flat sheet one exit
        mass = clusters.areas * flat
        middle = stop_gradient(jnp.mean(clusters.centers, axis=1))[:, None]
        centers = clusters.centers - middle
        rows = [mass[None] * clusters.irradiance, mass[None]]
        count = clusters.irradiance.shape[0] + 1
        if clusters.moments is not None:
            # Energy off the center, to first order: G(x - p - o) = G(x - p) (1 + o (x - p) / v).
            moments = clusters.moments * (flat / wide)[None, None]
            rows[0] = rows[0] - jnp.sum(moments * centers[None], axis=1)
            rows.append(moments.reshape(-1, mass.shape[0]))
        if order:
            plain = jnp.concatenate([mass[None] * clusters.irradiance, mass[None]])
            rows += [plain * axis[None] for axis in centers]
        rows = jnp.concatenate(rows)
        x, y, away = (stop_gradient(each).reshape(-1) for each in view.project(points))
        away = jnp.where(there.reshape(-1), away, -jnp.inf)
        far = _farthest(x / layer.stride, y / layer.stride, away, grid)
        ranges = _ranges(clusters, stop_gradient(variance), self.support, view, grid, layer.stride, far)
        bins = bin_items(ranges, grid, layer.capacity)
        where = jnp.where(there[None], points, _FAR)
        sums = self.sums(where, clusters.centers, 0.5 / wide, rows, bins, grid, self.support)
        energy, sums = _energy_and_rest(sums, count, points - middle[:, :, None], clusters.moments is not None)
        reached = there & (sums[0] > 0)
        inverse = 1 / jnp.where(reached, sums[0], 1.0)
        means = energy * inverse[None]
        values = jnp.where(reached[None], jnp.concatenate([means, sums[:1]]), 0.0)
        slopes = None
        if order:
            # grad N = sum w (q - x) / v, so grad (N / D) = (mean of E q - mean of E times mean of q) / v.
            moments = sums[1:].reshape(3, count, *there.shape)
            of_means = (moments[:, :-1] - means[None] * moments[:, -1:]) * inverse[None, None]
            of_exits = moments[:, -1] - (points - middle[:, :, None]) * sums[:1]
            slopes = jnp.concatenate([of_means, of_exits[:, None]], axis=1) / variance
            slopes = jnp.where(reached[None, None], slopes, 0.0)
        return values, slopes, bins.needed.astype(points.dtype)


def _energy_and_rest(sums, count: int, points, has_moments: bool):
    """Split the sums: the energy, with its first moments put in, and the area with what follows."""
    energy, rest = sums[: count - 1], sums[count - 1 :]
    if not has_moments:
        return energy, rest
    moments = rest[1 : 1 + 3 * (count - 1)].reshape(count - 1, 3, *sums.shape[1:])
    energy = energy + jnp.sum(moments * points[None], axis=1)
    return energy, jnp.concatenate([rest[:1], rest[1 + 3 * (count - 1) :]])


def _parts(diffuser: ClusterDiffuser):
    return diffuser.tree, diffuser.layers


def _is_none(leaf) -> bool:
    return leaf is None


@eqx.filter_jit
def _demand(diffuser: ClusterDiffuser, splats: Splats, clusters: Clusters, variance, stride: int, view: AbstractView):
    """Count the clusters that every tile needs, for a surface as far away as the splats that face the eye."""
    grid = diffuser._grid(view.width, view.height, stride)
    x, y, depth = view.project(splats.centers.T)
    _, _, facing = view.slant(x, y, depth, splats.normals.T)
    depth = jnp.where(facing > 0, depth + 2 * splats.radii, -jnp.inf)
    far = _farthest(x / stride, y / stride, depth, grid)
    return _ranges(clusters, variance, diffuser.support, view, grid, stride, far).per_tile(grid)


def _farthest(x, y, depth, grid: TileGrid) -> Float[Array, "down across"]:
    """Give the farthest depth that is seen in every tile: clusters well behind it are not needed there."""
    tiles_x = jnp.clip(jnp.floor(x / grid.side), 0, grid.across - 1).astype(jnp.int32)
    tiles_y = jnp.clip(jnp.floor(y / grid.side), 0, grid.down - 1).astype(jnp.int32)
    return jnp.full((grid.down, grid.across), -jnp.inf, depth.dtype).at[tiles_y, tiles_x].max(depth)


def _ranges(clusters: Clusters, variance, support: float, view: AbstractView, grid: TileGrid, stride: int, far) -> TileRanges:
    """Find the tiles within the support of each cluster. Not differentiated."""
    clusters = stop_gradient(clusters)
    reach = support * jnp.sqrt(variance + clusters.spread)
    left, right, top, bottom, depth = (
        edge / scale
        for edge, scale in zip(view.sphere_box(clusters.centers, reach), (stride, stride, stride, stride, 1), strict=True)
    )
    wanted = clusters.areas > 0
    ranges = TileRanges.of(left, right, top, bottom, wanted, grid)
    # The farthest depth seen anywhere in the rectangle, by a pyramid of maxima two tiles apart per level.
    seen = _farthest_in(ranges, far)
    keep = depth - reach <= seen
    return TileRanges(ranges.left, ranges.top, ranges.across, jnp.where(keep, ranges.down, 0))


def _farthest_in(ranges: TileRanges, far: Float[Array, "down across"]):
    """Give the maximum over each rectangle: the smallest power of two that spans it, four overlapping looks at that level."""
    span = jnp.maximum(ranges.across, ranges.down)
    pyramid, size = [far], 1
    while size < max(far.shape):
        last = pyramid[-1]
        shifted = jnp.pad(last, ((0, size), (0, size)), constant_values=-jnp.inf)
        h, w = last.shape
        pyramid.append(
            jnp.maximum(
                jnp.maximum(last, shifted[size : size + h, :w]), jnp.maximum(shifted[:h, size : size + w], shifted[size:, size:])
            )
        )
        size *= 2
    stack = jnp.stack(pyramid)  # level l: maximum over the 2^l tiles right of and below each
    level = jnp.clip(jnp.ceil(jnp.log2(jnp.maximum(span, 1).astype(jnp.float32))).astype(jnp.int32), 0, stack.shape[0] - 1)
    return stack[level, jnp.minimum(ranges.top, far.shape[0] - 1), jnp.minimum(ranges.left, far.shape[1] - 1)]
