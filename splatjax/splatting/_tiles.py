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
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ._bins import BinCapacity, Bins, TileGrid, TileRanges, bin_items, scatter_slots, slot_planes
from ._kernel import fast_fragment_weight, fragment_weight_derivative
from ._rasterizer import AbstractRasterizer, SurfaceSums
from ._settings import SplattingSettings
from ._views import AbstractView, Footprints

_EMPTY = (0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 1e12, 1.0, 0.0)  # covers no pixel center
_GEOMETRY = len(_EMPTY)
_PICKED = 16  # open tiles swept together


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


class _Lanes(eqx.Module):
    """Tiles that are swept together: where their lists begin in the slots, and their corners."""

    row: Int[Array, " lanes"]
    """Of the first block, in slots cut into rows of one lane each; the next block is `stride` rows on."""
    blocks: Int[Array, ""]
    x: Float[Array, "lanes 1"]
    y: Float[Array, "lanes 1"]
    stride: int = eqx.field(static=True)

    def read(self, plane: Float[Array, "rows slots"], block) -> Float[Array, "lanes slots"]:
        return plane.at[self.row + block * self.stride].get(mode="promise_in_bounds")

    def add(self, plane: Float[Array, "rows slots"], block, part: Float[Array, "lanes slots"]) -> Float[Array, "rows slots"]:
        return plane.at[self.row + block * self.stride].add(part, mode="promise_in_bounds")


class _ChunkLanes(_Lanes):
    """The tiles of one chunk: their rows follow one another."""

    def read(self, plane: Float[Array, "rows slots"], block) -> Float[Array, "lanes slots"]:
        return lax.dynamic_slice_in_dim(plane, self.row[0] + block * self.stride, self.stride)

    def add(self, plane: Float[Array, "rows slots"], block, part: Float[Array, "lanes slots"]) -> Float[Array, "rows slots"]:
        return lax.dynamic_update_slice_in_dim(plane, self.read(plane, block) + part, self.row[0] + block * self.stride, 0)


class _Sweep(eqx.Module):
    """What is static in a sweep."""

    view: type[AbstractView] = eqx.field(static=True)
    """The view's class: fragments need its formulas, not where it stands."""
    grid: TileGrid
    full_coverage: float = eqx.field(static=True)

    def pixels(self, dtype) -> tuple[np.ndarray, np.ndarray]:
        """Pixel centers of a tile, from its corner. Constants: made by NumPy, or the compiler computes them per fragment."""
        side = np.arange(self.grid.side, dtype=dtype) + np.asarray(0.5, dtype)
        return np.tile(side, self.grid.side), np.repeat(side, self.grid.side)

    def _lanes(self, kind: type[_Lanes], bins: Bins, places, blocks, dtype) -> _Lanes:
        lanes, grid = self.grid.lanes, self.grid
        tiles = bins.order[places]
        row = bins.first_block[places // lanes] * lanes + places % lanes
        x, y = ((each * grid.side).astype(dtype)[:, None] for each in (tiles % grid.across, tiles // grid.across))
        return kind(row, blocks, x, y, lanes)

    def chunk(self, bins: Bins, i, dtype) -> _Lanes:
        """Give the tiles of a chunk."""
        places = i * self.grid.lanes + jnp.arange(self.grid.lanes, dtype=jnp.int32)
        return self._lanes(_ChunkLanes, bins, places, bins.first_block[i + 1] - bins.first_block[i], dtype)

    def picked(self, bins: Bins, places: Int[Array, " lanes"], dtype) -> _Lanes:
        """Give tiles by their places in the order; places beyond the last are the last one's, with nothing in them."""
        chunk = places // self.grid.lanes
        return self._lanes(_Lanes, bins, places, jnp.max(bins.first_block[chunk + 1] - bins.first_block[chunk]), dtype)

    def fragments(self, planes, block, lanes: _Lanes):
        """Give nearness, quadric and shift of a block's fragments, `[lanes, slots, pixels]`, and the block's geometry."""
        x, y, sx, sy, a, b, c, e, shift = (lanes.read(plane, block) for plane in planes)
        x, y = x - lanes.x, y - lanes.y
        geometry = (x, y, sx, sy, a, b, c, e)
        px, py = (jnp.asarray(p)[None, None] for p in self.pixels(x.dtype))
        x, y, sx, sy, a, b, c, e, shift = (p[:, :, None] for p in (*geometry, shift))
        dx, dy = px - x, py - y
        return e + sx * dx + sy * dy, dx * (a * dx + b * dy) + c * dy * dy, shift, geometry

    def limits(self, planes, lanes: _Lanes, below):
        """Find per pixel the nearest shifted fragment among those at most `below`: the back end of a surface."""

        def nearest(block, limit):
            nearness, quadric, shift, _ = self.fragments(planes, block, lanes)
            candidate = self.view.inside(nearness, quadric)
            if below is not None:
                candidate &= nearness <= below[:, None]
            return jnp.maximum(limit, jnp.max(jnp.where(candidate, self.view.shifted(nearness, shift), -jnp.inf), axis=1))

        start = jnp.full((lanes.row.shape[0], self.grid.side**2), -jnp.inf, lanes.x.dtype)
        return lax.fori_loop(jnp.int32(0), lanes.blocks, nearest, start)

    def weights(self, nearness, quadric, beyond, upto):
        """Give the weights of the fragments between two limits, `rho^2`, and which fragments count."""
        chosen = self.view.inside(nearness, quadric) & (nearness > beyond[:, None])
        if upto is not None:
            chosen &= nearness <= upto[:, None]
        squared_radius = self.view.squared_radius(nearness, quadric)
        return jnp.where(chosen, fast_fragment_weight(squared_radius), 0.0), squared_radius, chosen

    def sum_rows(self, planes, rows, lanes: _Lanes, beyond, upto):
        """Sum weighted rows over the fragments between two limits."""

        def add(block, sums):
            nearness, quadric, _, _ = self.fragments(planes, block, lanes)
            weight, _, _ = self.weights(nearness, quadric, beyond, upto)
            block_rows = jnp.stack([lanes.read(row, block) for row in rows], axis=1)
            return sums + jnp.einsum("trs,tsp->trp", block_rows, weight)

        start = jnp.zeros((beyond.shape[0], len(rows), beyond.shape[1]), beyond.dtype)
        return lax.fori_loop(jnp.int32(0), lanes.blocks, add, start)

    def add_cotangents(self, planes, rows, lanes: _Lanes, beyond, upto, cotangent, gradients):
        """Add the cotangents of geometry and rows, per slot, for the fragments between two limits."""
        px, py = self.pixels(beyond.dtype)
        monomials = jnp.asarray(np.stack([np.ones_like(px), px, py, px * px, px * py, py * py], axis=1))

        def add(block, gradients):
            nearness, quadric, _, geometry = self.fragments(planes, block, lanes)
            weight, squared_radius, chosen = self.weights(nearness, quadric, beyond, upto)
            block_rows = jnp.stack([lanes.read(row, block) for row in rows], axis=1)
            d_rows = jnp.einsum("tsp,trp->trs", weight, cotangent)
            d_weight = jnp.einsum("trs,trp->tsp", block_rows, cotangent)
            squared_radius = jnp.where(chosen, squared_radius, 1.0)
            d_squared = fragment_weight_derivative(squared_radius, weight) * d_weight
            nearness = jnp.where(chosen, nearness, 1.0)
            d_nearness, d_quadric = self.view.squared_radius_vjp(nearness, squared_radius, d_squared)
            # Both are polynomials in the pixel: their moments over the tile are all that is needed.
            quad, near = d_quadric @ monomials, d_nearness @ monomials[:, :3]
            d_geometry = _geometry_cotangent(geometry, jnp.moveaxis(quad, 2, 0), jnp.moveaxis(near, 2, 0))
            parts = [*d_geometry, *(d_rows[:, r] for r in range(len(rows)))]
            return tuple(lanes.add(whole, block, part) for whole, part in zip(gradients, parts, strict=True))

        return lax.fori_loop(jnp.int32(0), lanes.blocks, add, gradients)


def _rows_of_lanes(planes: list[Float[Array, "blocks lanes slots"]]) -> list[Float[Array, "rows slots"]]:
    return [plane.reshape(-1, plane.shape[2]) for plane in planes]


def _planes(geometry, rows, bins: Bins):
    row_planes = slot_planes(rows, (0.0,) * rows.shape[0], bins)
    return _rows_of_lanes(slot_planes(geometry, _EMPTY, bins)), _rows_of_lanes(row_planes)


def _open_tiles(sweep: _Sweep, front, limit):
    """Find the tiles with pixels that the front leaves open: their places first, and how many there are."""
    gaps = (front[:, -1] < sweep.full_coverage) & (limit > -jnp.inf) & (limit < jnp.inf)
    is_open = jnp.any(gaps, axis=1)
    places = jnp.nonzero(is_open, size=is_open.shape[0] + _PICKED, fill_value=0)[0].astype(jnp.int32)
    return gaps, places, jnp.sum(is_open, dtype=jnp.int32)


def _forward(sweep: _Sweep, bins: Bins, geometry, rows):
    """Sweep all chunks: sums in lane order, and per pixel the limits of both surfaces."""
    planes, row_planes = _planes(geometry, rows, bins)
    lanes, dtype = sweep.grid.lanes, geometry.dtype

    def chunk(i, out):
        tiles = sweep.chunk(bins, i, dtype)
        limit = sweep.limits(planes, tiles, None)
        sums = sweep.sum_rows(planes, row_planes, tiles, limit, None)
        front, limits = out
        return lax.dynamic_update_slice_in_dim(front, sums, i * lanes, 0), lax.dynamic_update_slice_in_dim(
            limits, limit, i * lanes, 0
        )

    empty = jnp.zeros((sweep.grid.tiles, rows.shape[0], sweep.grid.side**2), dtype)
    never = jnp.full(empty.shape[::2], jnp.inf, dtype)
    front, limits = lax.fori_loop(jnp.int32(0), bins.chunks, chunk, (empty, never))
    gaps, places, count = _open_tiles(sweep, front, limits)

    def look_behind(i, out):
        picked = lax.dynamic_slice_in_dim(places, i * _PICKED, _PICKED)
        real = (i * _PICKED + jnp.arange(_PICKED, dtype=jnp.int32) < count)[:, None]
        tiles = sweep.picked(bins, picked, dtype)
        limit = limits[picked]
        below = jnp.where(gaps[picked] & real, limit, -jnp.inf)
        second = sweep.limits(planes, tiles, below)
        second = jnp.where(second > -jnp.inf, second, jnp.inf)
        sums = sweep.sum_rows(planes, row_planes, tiles, second, limit)
        behind, seconds = out
        return behind.at[picked].add(sums), seconds.at[picked].min(second)

    behind, seconds = lax.fori_loop(jnp.int32(0), -(-count // _PICKED), look_behind, (empty, never))
    return front, behind, limits, seconds


def _backward(sweep: _Sweep, bins: Bins, geometry, rows, limits, cotangents):
    """Sweep all chunks again: the cotangents of geometry and rows, per slot, then summed per splat."""
    planes, row_planes = _planes(geometry, rows, bins)
    lanes, dtype, count = sweep.grid.lanes, geometry.dtype, rows.shape[0]
    limits, seconds = limits
    d_front, d_behind = cotangents

    def chunk(i, gradients):
        limit = lax.dynamic_slice_in_dim(limits, i * lanes, lanes)
        cotangent = lax.dynamic_slice_in_dim(d_front, i * lanes, lanes)
        tiles = sweep.chunk(bins, i, dtype)
        return sweep.add_cotangents(planes, row_planes, tiles, limit, None, cotangent, gradients)

    start = tuple(jnp.zeros(planes[0].shape, dtype) for _ in range(_GEOMETRY - 1 + count))
    slots = lax.fori_loop(jnp.int32(0), bins.chunks, chunk, start)

    is_open = jnp.any(seconds < jnp.inf, axis=1)
    places = jnp.nonzero(is_open, size=is_open.shape[0] + _PICKED, fill_value=0)[0].astype(jnp.int32)
    open_count = jnp.sum(is_open, dtype=jnp.int32)

    def behind(i, gradients):
        picked = lax.dynamic_slice_in_dim(places, i * _PICKED, _PICKED)
        real = (i * _PICKED + jnp.arange(_PICKED, dtype=jnp.int32) < open_count)[:, None]
        beyond = jnp.where(real, seconds[picked], jnp.inf)
        tiles = sweep.picked(bins, picked, dtype)
        return sweep.add_cotangents(planes, row_planes, tiles, beyond, limits[picked], d_behind[picked], gradients)

    slots = lax.fori_loop(jnp.int32(0), -(-open_count // _PICKED), behind, slots)
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
