"""Sums of Gaussians around sources at points of a picture, tile by tile, with a derivative that recomputes the weights."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from splatjax.splatting import Bins, TileGrid, scatter_slots, slot_plane

_FAR = 1e6  # mm from anything, yet with a square that float32 holds


class _Sweep(eqx.Module):
    grid: TileGrid
    largest_exponent: float = eqx.field(static=True)

    def block(self, planes, block, points):
        """Give the weights of a block's sources, `[lanes, slots, points]`, with offsets and exponents."""
        x, y, z, rate = (lax.dynamic_index_in_dim(plane, block, 0, keepdims=False)[:, :, None] for plane in planes)
        dx, dy, dz = (points[:, axis, None] - center for axis, center in enumerate((x, y, z)))
        squared = dx * dx + dy * dy + dz * dz
        exponent = rate * squared
        weight = jnp.where(exponent < self.largest_exponent, jnp.exp(-exponent), 0.0)
        return weight, (dx, dy, dz), squared, rate

    def points(self, tiles, bins: Bins, chunk):
        """Give what belongs to the tiles of a chunk."""
        lanes = lax.dynamic_slice_in_dim(bins.order, chunk * self.grid.lanes, self.grid.lanes)
        return tiles[lanes]


def _planes(sources, rows, bins: Bins):
    fill = (_FAR, _FAR, _FAR, 1.0)
    return [slot_plane(*each, bins) for each in zip(sources, fill, strict=True)], [slot_plane(row, 0.0, bins) for row in rows]


def _forward(sweep: _Sweep, bins: Bins, tiles, sources, rows):
    planes, row_planes = _planes(sources, rows, bins)
    lanes, count = sweep.grid.lanes, rows.shape[0]

    def chunk(i, out):
        points = sweep.points(tiles, bins, i)

        def add(block, sums):
            weight, _, _, _ = sweep.block(planes, block, points)
            block_rows = jnp.stack([lax.dynamic_index_in_dim(row, block, 0, keepdims=False) for row in row_planes], axis=1)
            return sums + jnp.einsum("trs,tsp->trp", block_rows, weight)

        start = jnp.zeros((lanes, count, points.shape[2]), points.dtype)
        sums = lax.fori_loop(bins.first_block[i], bins.first_block[i + 1], add, start)
        return lax.dynamic_update_slice_in_dim(out, sums, i * lanes, 0)

    out = jnp.zeros((bins.places, count, tiles.shape[2]), tiles.dtype)
    return bins.by_tile(lax.fori_loop(jnp.int32(0), bins.chunks, chunk, out), 0.0)


def _derivative(sweep: _Sweep, bins: Bins, tiles, sources, rows, d_sources, d_rows):
    """Give the sums, and how they change with sources and rows; one look at each weight serves both."""
    planes, row_planes = _planes(sources, rows, bins)
    d_planes, d_row_planes = [slot_plane(each, 0.0, bins) for each in d_sources], [slot_plane(row, 0.0, bins) for row in d_rows]
    lanes, count = sweep.grid.lanes, rows.shape[0]

    def block_of(planes, block):
        return jnp.stack([lax.dynamic_index_in_dim(plane, block, 0, keepdims=False) for plane in planes], axis=1)

    def chunk(i, out):
        points = sweep.points(tiles, bins, i)

        def add(block, sums):
            weight, (dx, dy, dz), squared, rate = sweep.block(planes, block, points)
            moved_x, moved_y, moved_z, d_rate = (each[:, :, None] for each in jnp.unstack(block_of(d_planes, block), axis=1))
            nearer = dx * moved_x + dy * moved_y + dz * moved_z
            d_weight = weight * (2 * rate * nearer - d_rate * squared)
            block_rows, d_block_rows = block_of(row_planes, block), block_of(d_row_planes, block)
            both = jnp.einsum("trs,tsp->trp", jnp.concatenate([block_rows, d_block_rows], axis=1), weight)
            return sums + both.at[:, count:].add(jnp.einsum("trs,tsp->trp", block_rows, d_weight))

        start = jnp.zeros((lanes, 2 * count, points.shape[2]), points.dtype)
        sums = lax.fori_loop(bins.first_block[i], bins.first_block[i + 1], add, start)
        return lax.dynamic_update_slice_in_dim(out, sums, i * lanes, 0)

    out = jnp.zeros((bins.places, 2 * count, tiles.shape[2]), tiles.dtype)
    out = bins.by_tile(lax.fori_loop(jnp.int32(0), bins.chunks, chunk, out), 0.0)
    return out[:, :count], out[:, count:]


def _backward(sweep: _Sweep, bins: Bins, tiles, sources, rows, cotangents):
    planes, row_planes = _planes(sources, rows, bins)
    lanes, count = sweep.grid.lanes, rows.shape[0]

    def chunk(i, carry):
        points, cotangent = sweep.points(tiles, bins, i), sweep.points(cotangents, bins, i)

        def add(block, carry):
            d_points, gradients = carry
            weight, offsets, squared, rate = sweep.block(planes, block, points)
            block_rows = jnp.stack([lax.dynamic_index_in_dim(row, block, 0, keepdims=False) for row in row_planes], axis=1)
            d_rows = jnp.einsum("tsp,trp->trs", weight, cotangent)
            d_exponent = -weight * jnp.einsum("trs,trp->tsp", block_rows, cotangent)
            d_rate = jnp.sum(d_exponent * squared, axis=2)
            pull = 2 * rate * d_exponent
            along = [pull * offset for offset in offsets]
            d_points = d_points + jnp.stack([jnp.sum(each, axis=1) for each in along], axis=1)
            parts = [*(-jnp.sum(each, axis=2) for each in along), d_rate, *(d_rows[:, r] for r in range(count))]
            gradients = tuple(
                lax.dynamic_update_index_in_dim(whole, part, block, 0) for whole, part in zip(gradients, parts, strict=True)
            )
            return d_points, gradients

        d_tiles, gradients = carry
        start = jnp.zeros_like(points), gradients
        d_points, gradients = lax.fori_loop(bins.first_block[i], bins.first_block[i + 1], add, start)
        return lax.dynamic_update_slice_in_dim(d_tiles, d_points, i * lanes, 0), gradients

    slots = tuple(jnp.zeros(bins.ids.shape, tiles.dtype) for _ in range(4 + count))
    d_tiles = jnp.zeros((bins.places, *tiles.shape[1:]), tiles.dtype)
    d_tiles, slots = lax.fori_loop(jnp.int32(0), bins.chunks, chunk, (d_tiles, slots))
    per_source = [scatter_slots(plane, bins, sources.shape[1]) for plane in slots]
    return bins.by_tile(d_tiles, 0.0), jnp.stack(per_source[:4]), jnp.stack(per_source[4:])


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _sweep_tiles(sweep: _Sweep, bins: Bins, tiles, sources, rows):
    return _forward(sweep, bins, tiles, sources, rows)


def _sweep_tiles_fwd(sweep: _Sweep, bins: Bins, tiles, sources, rows):
    return _forward(sweep, bins, tiles, sources, rows), (bins, tiles, sources, rows)


def _sweep_tiles_bwd(sweep: _Sweep, residuals, cotangents):
    return (None, *_backward(sweep, *residuals, cotangents))


_sweep_tiles.defvjp(_sweep_tiles_fwd, _sweep_tiles_bwd)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _sweep_tiles_forward(sweep: _Sweep, bins: Bins, tiles, sources, rows):
    return _forward(sweep, bins, tiles, sources, rows)


@_sweep_tiles_forward.defjvp
def _sweep_tiles_jvp(sweep: _Sweep, primals, tangents):
    _, _, d_sources, d_rows = tangents
    return _derivative(sweep, *primals, d_sources, d_rows)


def gaussian_sums(
    points: Float[Array, "3 height width"],
    centers: Float[Array, "3 sources"],
    rates: Float[Array, " sources"],
    rows: Float[Array, "rows sources"],
    bins: Bins,
    grid: TileGrid,
    support: float,
) -> Float[Array, "rows height width"]:
    r"""Give `sum_j rows_j exp(-rate_j |x - p_j|^2)` at every point, over the sources listed for its tile.

    **Arguments:**

    - `points`: `x`, mm; points that do not count may lie far away. Differentiable.
    - `centers`, `rates`, `rows`: `p_j` (mm), `1 / 2 v_j` (1/mm^2) and what is summed. Differentiable.
    - `support`: terms farther than this many standard deviations are left out, whatever the lists hold. Not differentiated.
    """
    sweep = _Sweep(grid, 0.5 * support * support)
    return grid.join(_sweep_tiles(sweep, bins, grid.cut(points, -_FAR), jnp.concatenate([centers, rates[None]]), rows))


def gaussian_sums_forward(
    points: Float[Array, "3 height width"],
    centers: Float[Array, "3 sources"],
    rates: Float[Array, " sources"],
    rows: Float[Array, "rows sources"],
    bins: Bins,
    grid: TileGrid,
    support: float,
) -> Float[Array, "rows height width"]:
    """Give what `gaussian_sums` gives, with forward mode in the sources and not reverse mode; the points are constants."""
    sweep = _Sweep(grid, 0.5 * support * support)
    tiles = grid.cut(lax.stop_gradient(points), -_FAR)
    return grid.join(_sweep_tiles_forward(sweep, bins, tiles, jnp.concatenate([centers, rates[None]]), rows))
