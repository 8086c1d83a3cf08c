"""The fast rasterizer: tile by tile, only the splats that touch the tile, with a derivative that recomputes the weights.

from collections.abc import Sequence
It gives what `DenseRasterizer` gives. A chunk of tiles is swept twice: for the front's depth, then for the sums; chunks with a
pixel that the front leaves open are swept twice more for what lies behind. The backward sweep needs the fragments' limits
only. Fragments are computed relative to their tile, so that float32 suffices at any resolution.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ._bins import BinCapacity, Bins, TileGrid, TileRanges, bin_items, scatter_slots, slot_planes
from ._kernel import fragment_weight, fragment_weight_derivative
from ._rasterizer import AbstractRasterizer, SurfaceSums
from ._settings import SplattingSettings
from ._views import AbstractView, Footprints

_EMPTY = (0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 1e12, 1.0, 0.0)  # covers no pixel center
_GEOMETRY = len(_EMPTY)


class TileRasterizer(AbstractRasterizer):
    r"""Sorts splats into tiles and sweeps each tile's own list.

    **Attributes:** (all static)

    - `side`, `lanes`, `slots`: pixels along a tile, tiles swept together, and splats of each swept together.
    - `capacity`: set by `planned`; a picture that needs more is NaN.
    """

    side: int = eqx.field(static=True, default=8)
    lanes: int = eqx.field(static=True, default=64)
    slots: int = eqx.field(static=True, default=32)
    capacity: BinCapacity | None = eqx.field(default=None)

    def _grid(self, view: AbstractView) -> TileGrid:
        return TileGrid(view.width, view.height, self.side, self.lanes, self.slots)

    def planned(self, footprints: Sequence[Footprints], view: AbstractView) -> "TileRasterizer":
        grid = self._grid(view)
        ranges = [_ranges(each, grid) for each in footprints]
        return TileRasterizer(self.side, self.lanes, self.slots, BinCapacity.for_ranges(ranges, grid))

    def sums(
        self, footprints: Footprints, rows: Float[Array, "rows splats"], view: AbstractView, settings: SplattingSettings
    ) -> SurfaceSums:
        if self.capacity is None:
            raise ValueError("this TileRasterizer has no capacity yet; take one from a plan (splatjax.plan) or from `planned`")
        if rows.shape[1] == 0:
            empty = jnp.zeros((rows.shape[0], view.height, view.width), rows.dtype)
            return SurfaceSums(empty, empty, jnp.zeros((), rows.dtype))
        grid = self._grid(view)
        bins = bin_items(_ranges(footprints, grid), grid, self.capacity)
        f = footprints
        geometry = jnp.stack([f.x, f.y, f.slope_x, f.slope_y, f.a, f.b, f.c, f.nearness, f.shift])
        front, behind = _sweep_tiles(_Sweep(type(view), grid, settings.full_coverage), bins, geometry, rows)
        needed = bins.needed.astype(rows.dtype)
        fits = needed <= 1
        front, behind = (jnp.where(fits, grid.join(tiles), jnp.nan) for tiles in (front, behind))
        return SurfaceSums(front, behind, needed)


def _ranges(f: Footprints, grid: TileGrid) -> TileRanges:
    return TileRanges.of(f.left, f.right, f.top, f.bottom, f.visible, grid)


class _Sweep(eqx.Module):
    """What is static in a sweep."""

    view: type[AbstractView] = eqx.field(static=True)
    """The view's class: fragments need its formulas, not where it stands."""
    grid: TileGrid
    full_coverage: float = eqx.field(static=True)

    def pixels(self, dtype) -> tuple[Float[Array, " pixels"], Float[Array, " pixels"]]:
        """Pixel centers of a tile, from its corner."""
        side = jnp.arange(self.grid.side, dtype=dtype) + 0.5
        return jnp.tile(side, self.grid.side), jnp.repeat(side, self.grid.side)

    def corners(self, bins: Bins, chunk, dtype) -> tuple[Float[Array, "lanes 1"], Float[Array, "lanes 1"]]:
        tiles = lax.dynamic_slice(bins.order, (chunk * self.grid.lanes,), (self.grid.lanes,))
        x, y = tiles % self.grid.across, tiles // self.grid.across
        return (x * self.grid.side).astype(dtype)[:, None], (y * self.grid.side).astype(dtype)[:, None]

    def fragments(self, planes, block, corners):
        """Give nearness, quadric and shift of a block's fragments, `[lanes, slots, pixels]`, and the block's geometry."""
        x, y, sx, sy, a, b, c, e, shift = (lax.dynamic_index_in_dim(p, block, 0, keepdims=False) for p in planes)
        x, y = x - corners[0], y - corners[1]
        geometry = (x, y, sx, sy, a, b, c, e)
        px, py = (p[None, None] for p in self.pixels(x.dtype))
        x, y, sx, sy, a, b, c, e, shift = (p[:, :, None] for p in (*geometry, shift))
        dx, dy = px - x, py - y
        return e + sx * dx + sy * dy, dx * (a * dx + b * dy) + c * dy * dy, shift, geometry

    def limits(self, planes, blocks, corners, below, shape, dtype):
        """Find per pixel the nearest shifted fragment among those at most `below`: the back end of a surface."""

        def nearest(block, limit):
            nearness, quadric, shift, _ = self.fragments(planes, block, corners)
            candidate = self.view.inside(nearness, quadric)
            if below is not None:
                candidate &= nearness <= below[:, None]
            return jnp.maximum(limit, jnp.max(jnp.where(candidate, self.view.shifted(nearness, shift), -jnp.inf), axis=1))

        return lax.fori_loop(*blocks, nearest, jnp.full(shape, -jnp.inf, dtype))

    def weights(self, nearness, quadric, beyond, upto):
        """Give the weights of the fragments between two limits, and `rho^2` where they count."""
        chosen = self.view.inside(nearness, quadric) & (nearness > beyond[:, None])
        if upto is not None:
            chosen &= nearness <= upto[:, None]
        squared_radius = self.view.squared_radius(jnp.where(chosen, nearness, 1.0), quadric)
        squared_radius = jnp.where(chosen, squared_radius, 1.0)
        return jnp.where(chosen, fragment_weight(squared_radius), 0.0), squared_radius, chosen

    def sum_rows(self, planes, rows, blocks, corners, beyond, upto):
        def add(block, sums):
            nearness, quadric, _, _ = self.fragments(planes, block, corners)
            weight, _, _ = self.weights(nearness, quadric, beyond, upto)
            block_rows = jnp.stack([lax.dynamic_index_in_dim(row, block, 0, keepdims=False) for row in rows], axis=1)
            return sums + jnp.einsum("trs,tsp->trp", block_rows, weight)

        shape = (beyond.shape[0], len(rows), beyond.shape[1])
        return lax.fori_loop(*blocks, add, jnp.zeros(shape, beyond.dtype))


def _forward(sweep: _Sweep, bins: Bins, geometry, rows):
    """Sweep all chunks: sums in lane order, and per pixel the limits of both surfaces."""
    planes = slot_planes(geometry, _EMPTY, bins)
    row_planes = slot_planes(rows, (0.0,) * rows.shape[0], bins)
    lanes, pixels, dtype = sweep.grid.lanes, sweep.grid.side**2, geometry.dtype
    tiles, count = sweep.grid.tiles, rows.shape[0]
    shape = (lanes, pixels)

    def chunk(i, out):
        corners = sweep.corners(bins, i, dtype)
        blocks = bins.first_block[i], bins.first_block[i + 1]
        limit = sweep.limits(planes, blocks, corners, None, shape, dtype)
        front = sweep.sum_rows(planes, row_planes, blocks, corners, limit, None)
        gaps = (front[:, -1] < sweep.full_coverage) & (limit > -jnp.inf)

        def look_behind():
            below = jnp.where(gaps, limit, -jnp.inf)
            second = sweep.limits(planes, blocks, corners, below, shape, dtype)
            second = jnp.where(gaps & (second > -jnp.inf), second, jnp.inf)
            return sweep.sum_rows(planes, row_planes, blocks, corners, second, limit), second

        def nothing():
            return jnp.zeros((lanes, count, pixels), dtype), jnp.full(shape, jnp.inf, dtype)

        behind, second = lax.cond(jnp.any(gaps), look_behind, nothing)
        place = i * lanes
        return tuple(
            lax.dynamic_update_slice(whole, part, (place,) + (0,) * (part.ndim - 1))
            for whole, part in zip(out, (front, behind, limit, second), strict=True)
        )

    sums, limits = jnp.zeros((tiles, count, pixels), dtype), jnp.full((tiles, pixels), jnp.inf, dtype)
    return lax.fori_loop(0, bins.chunks, chunk, (sums, sums, limits, limits))


def _backward(sweep: _Sweep, bins: Bins, geometry, rows, limits, cotangents):
    """Sweep all chunks again: the cotangents of geometry and rows, per slot, then summed per splat."""
    planes = slot_planes(geometry, _EMPTY, bins)
    row_planes = slot_planes(rows, (0.0,) * rows.shape[0], bins)
    lanes, pixels, dtype = sweep.grid.lanes, sweep.grid.side**2, geometry.dtype
    px, py = sweep.pixels(dtype)
    monomials = jnp.stack([jnp.ones_like(px), px, py, px * px, px * py, py * py], axis=1)
    count = rows.shape[0]

    def add_surface(blocks, corners, beyond, upto, cotangent, gradients):
        def add(block, gradients):
            nearness, quadric, _, g = sweep.fragments(planes, block, corners)
            weight, squared_radius, chosen = sweep.weights(nearness, quadric, beyond, upto)
            block_rows = jnp.stack([lax.dynamic_index_in_dim(row, block, 0, keepdims=False) for row in row_planes], axis=1)
            d_rows = jnp.einsum("tsp,trp->trs", weight, cotangent)
            d_weight = jnp.einsum("trs,trp->tsp", block_rows, cotangent)
            d_squared = jnp.where(chosen, fragment_weight_derivative(squared_radius) * d_weight, 0.0)
            safe = jnp.where(chosen, nearness, 1.0)
            d_nearness, d_quadric = sweep.view.squared_radius_vjp(safe, squared_radius, d_squared)
            # Both are polynomials in the pixel: their moments over the tile are all that is needed.
            quad = jnp.einsum("tsp,pm->mts", d_quadric, monomials)
            near = jnp.einsum("tsp,pm->mts", d_nearness, monomials[:, :3])
            d_geometry = _geometry_cotangent(g, quad, near)
            parts = [*d_geometry, *(d_rows[:, r] for r in range(count))]
            return tuple(
                lax.dynamic_update_index_in_dim(whole, lax.dynamic_index_in_dim(whole, block, 0, keepdims=False) + part, block, 0)
                for whole, part in zip(gradients, parts, strict=True)
            )

        return lax.fori_loop(*blocks, add, gradients)

    def chunk(i, gradients):
        corners = sweep.corners(bins, i, dtype)
        blocks = bins.first_block[i], bins.first_block[i + 1]
        limit, second = (lax.dynamic_slice(each, (i * lanes, 0), (lanes, pixels)) for each in limits)
        front, behind = (lax.dynamic_slice(each, (i * lanes, 0, 0), (lanes, count, pixels)) for each in cotangents)
        gradients = add_surface(blocks, corners, limit, None, front, gradients)
        return lax.cond(
            jnp.any(second < jnp.inf),
            partial(add_surface, blocks, corners, second, limit, behind),
            lambda gradients: gradients,
            gradients,
        )

    start = tuple(jnp.zeros(bins.ids.shape, dtype) for _ in range(_GEOMETRY - 1 + count))
    slots = lax.fori_loop(0, bins.chunks, chunk, start)
    per_splat = [scatter_slots(plane, bins, geometry.shape[1]) for plane in slots]
    d_geometry = jnp.stack([*per_splat[: _GEOMETRY - 1], jnp.zeros_like(per_splat[0])])
    return d_geometry, jnp.stack(per_splat[_GEOMETRY - 1 :])


def _geometry_cotangent(geometry, quad, near):
    """Turn moments of the cotangents over the pixels into cotangents of a splat's numbers."""
    x, y, sx, sy, a, b, c, _ = geometry
    m, mx, my, mxx, mxy, myy = quad
    n, nx, ny = near
    dx, dy = mx - x * m, my - y * m
    dxx = mxx - 2 * x * mx + x * x * m
    dxy = mxy - x * my - y * mx + x * y * m
    dyy = myy - 2 * y * my + y * y * m
    return (
        -(2 * a * dx + b * dy + sx * n),
        -(b * dx + 2 * c * dy + sy * n),
        nx - x * n,
        ny - y * n,
        dxx,
        dxy,
        dyy,
        n,
    )


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _sweep_tiles(sweep: _Sweep, bins: Bins, geometry, rows):
    front, behind, _, _ = _forward(sweep, bins, geometry, rows)
    lanes = bins.inverse_order()
    return front[lanes], behind[lanes]


def _sweep_tiles_fwd(sweep: _Sweep, bins: Bins, geometry, rows):
    front, behind, limit, second = _forward(sweep, bins, geometry, rows)
    lanes = bins.inverse_order()
    return (front[lanes], behind[lanes]), (bins, geometry, rows, limit, second)


def _sweep_tiles_bwd(sweep: _Sweep, residuals, cotangents):
    bins, geometry, rows, limit, second = residuals
    in_lane_order = tuple(each[bins.order] for each in cotangents)
    d_geometry, d_rows = _backward(sweep, bins, geometry, rows, (limit, second), in_lane_order)
    return None, d_geometry, d_rows


_sweep_tiles.defvjp(_sweep_tiles_fwd, _sweep_tiles_bwd)
