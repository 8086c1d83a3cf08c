"""Sweeps over the lists of tiles, with a derivative that recomputes the weights.

A chunk of tiles is swept twice: for the front's depth, then for the sums; tiles with a pixel that
the front leaves open are swept twice more for what lies behind. The backward sweep needs the
fragments' limits only. Fragments are computed relative to their tile, so that float32 suffices at
any resolution.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import zeros_after

from ._bins import SIDE, Bins, TileGrid, scatter_slots, slot_plane
from ._kernel import fast_fragment_weight, fragment_weight_derivative
from ._rasterizer import FragmentSums, least_weight
from ._views import AbstractView

PLANES = ("x", "y", "slope_x", "slope_y", "a", "b", "c", "nearness", "opacity")
"""Of the footprints, that sums depend on."""
_EMPTY = (0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 1e12, 1.0, 0.0)  # covers no pixel center


class _Lanes(eqx.Module):
    """Tiles that are swept together: where their lists begin in the slots, and their corners."""

    row: Int[Array, " lanes"]
    """Of the first block, in slots cut into rows of one lane each; the next block is `stride` rows
    on.
    """
    lengths: Int[Array, " lanes"]
    """Of each lane's list, in blocks: what follows is another chunk's."""
    blocks: Int[Array, ""]
    x: Float[Array, "lanes 1"]
    y: Float[Array, "lanes 1"]
    stride: int = eqx.field(static=True)

    def read(self, plane: Float[Array, "rows slots"], block) -> Float[Array, "lanes slots"]:
        return plane.at[self.row + block * self.stride].get(mode="promise_in_bounds")

    def add(
        self, plane: Float[Array, "rows slots"], block, part: Float[Array, "lanes slots"]
    ) -> Float[Array, "rows slots"]:
        return plane.at[self.row + block * self.stride].add(part, mode="promise_in_bounds")

    def until_end(
        self, beyond: Float[Array, "lanes pixels"], block
    ) -> Float[Array, "lanes pixels"]:
        """Give limits that nothing is nearer than, for lanes whose list has ended before a
        block.
        """
        return jnp.where((block < self.lengths)[:, None], beyond, jnp.inf)


class _ChunkLanes(_Lanes):
    """The tiles of one chunk: their rows follow one another."""

    def read(self, plane: Float[Array, "rows slots"], block) -> Float[Array, "lanes slots"]:
        return lax.dynamic_slice_in_dim(plane, self.row[0] + block * self.stride, self.stride)

    def add(
        self, plane: Float[Array, "rows slots"], block, part: Float[Array, "lanes slots"]
    ) -> Float[Array, "rows slots"]:
        return lax.dynamic_update_slice_in_dim(
            plane, self.read(plane, block) + part, self.row[0] + block * self.stride, 0
        )

    def until_end(
        self, beyond: Float[Array, "lanes pixels"], block
    ) -> Float[Array, "lanes pixels"]:
        return beyond


class Sweep(eqx.Module):
    """What is static in a sweep."""

    view: type[AbstractView] = eqx.field(static=True)
    """The view's class: fragments need its formulas, not where it stands."""
    grid: TileGrid
    full_coverage: float = eqx.field(static=True)
    filter_radius: float = eqx.field(static=True)

    def pixels(self, dtype) -> tuple[np.ndarray, np.ndarray]:
        """Pixel centers of a tile, from its corner. Constants: made by NumPy, or the compiler
        computes them per fragment.
        """
        side = np.arange(SIDE, dtype=dtype) + np.asarray(0.5, dtype)
        return np.tile(side, SIDE), np.repeat(side, SIDE)

    def _lanes(self, kind: type[_Lanes], bins: Bins, places, dtype) -> _Lanes:
        lanes, across = self.grid.lanes, self.grid.across
        tiles, chunk = bins.order[places], places // lanes
        row = bins.first_block[chunk] * lanes + places % lanes
        lengths = bins.first_block[chunk + 1] - bins.first_block[chunk]
        x, y = ((each * SIDE).astype(dtype)[:, None] for each in (tiles % across, tiles // across))
        return kind(row, lengths, jnp.max(lengths), x, y, lanes)

    def chunk(self, bins: Bins, i, dtype) -> _Lanes:
        """Give the tiles of a chunk."""
        places = i * self.grid.lanes + jnp.arange(self.grid.lanes, dtype=jnp.int32)
        return self._lanes(_ChunkLanes, bins, places, dtype)

    def picked(self, bins: Bins, places: Int[Array, " lanes"], dtype) -> _Lanes:
        """Give tiles by their places in the order; places beyond the last are the last one's, with
        nothing in them.
        """
        return self._lanes(_Lanes, bins, places, dtype)

    def splats(self, planes, block, lanes: _Lanes):
        """Read a block's splats, `[lanes, slots]` each, placed relative to their tile's corner."""
        x, y, *rest = (lanes.read(plane, block) for plane in planes)
        return x - lanes.x, y - lanes.y, *rest

    def fragments(self, splats):
        """Give nearness and quadric of a block's fragments, `[lanes, slots, pixels]`."""
        x, y, sx, sy, a, b, c, e = (p[:, :, None] for p in splats[:8])
        px, py = (jnp.asarray(p)[None, None] for p in self.pixels(x.dtype))
        dx, dy = px - x, py - y
        return e + sx * dx + sy * dy, dx * (a * dx + b * dy) + c * dy * dy

    def limits(self, slots: "Slots", lanes: _Lanes):
        """Find per pixel the nearest shifted fragment: the back end of the front."""

        def nearest(block, limit):
            nearness, quadric = self.fragments(self.splats(slots.planes, block, lanes))
            shifted = self.view.shifted(nearness, lanes.read(slots.shift, block)[:, :, None])
            return jnp.maximum(
                limit,
                jnp.max(jnp.where(self.view.inside(nearness, quadric), shifted, -jnp.inf), axis=1),
            )

        return lax.fori_loop(jnp.int32(0), lanes.blocks, nearest, self._nothing(lanes))

    def limits_behind(self, slots: "Slots", lanes: _Lanes, front):
        """Find the same for what lies behind the front's limits: of the fragments that weigh
        something, and of any.
        """

        def nearest(block, limits):
            splats = self.splats(slots.planes, block, lanes)
            nearness, quadric = self.fragments(splats)
            shifted = self.view.shifted(nearness, lanes.read(slots.shift, block)[:, :, None])
            beyond = lanes.until_end(jnp.full_like(front, -jnp.inf), block)
            squared_radius = self.squared_radii(nearness, quadric, beyond, front)
            weight = splats[-1][:, :, None] * fast_fragment_weight(squared_radius)
            least = least_weight(self.view, *splats[4:8], self.filter_radius)
            each = weight > least[:, :, None], squared_radius < 1
            found = (jnp.max(jnp.where(candidate, shifted, -jnp.inf), axis=1) for candidate in each)
            return tuple(jnp.maximum(limit, new) for limit, new in zip(limits, found, strict=True))

        return lax.fori_loop(
            jnp.int32(0), lanes.blocks, nearest, (self._nothing(lanes), self._nothing(lanes))
        )

    def _nothing(self, lanes: _Lanes):
        return jnp.full((lanes.row.shape[0], SIDE**2), -jnp.inf, lanes.x.dtype)

    def squared_radii(self, nearness, quadric, beyond, upto):
        """Give `rho^2`, below 1 for the fragments between two limits; 1, where the weight is 0, for
        all others.
        """
        chosen = self.view.inside(nearness, quadric) & (nearness > beyond[:, None])
        if upto is not None:
            chosen &= nearness <= upto[:, None]
        return jnp.where(chosen, self.view.squared_radius(nearness, quadric), 1.0)

    def rows(self, splats, attributes, block, lanes: _Lanes):
        """Give what is summed, `[lanes, slots]` each: attributes, the plane of nearness (three
        numbers), and 1.
        """
        x, y, sx, sy, _, _, _, e, _ = splats
        return [
            *(lanes.read(row, block) for row in attributes),
            e - sx * x - sy * y,
            sx,
            sy,
            jnp.ones_like(e),
        ]

    def sums(self, slots: "Slots", lanes: _Lanes, beyond, upto):
        """Sum attributes and nearness over the fragments between two limits, `[lanes, rows,
        pixels]`; the weights last.
        """

        def add(block, sums):
            splats = self.splats(slots.planes, block, lanes)
            squared_radius = self.squared_radii(
                *self.fragments(splats), lanes.until_end(beyond, block), upto
            )
            weight = splats[-1][:, :, None] * fast_fragment_weight(squared_radius)
            rows = jnp.stack(self.rows(splats, slots.attributes, block, lanes), axis=1)
            return sums + jnp.einsum("trs,tsp->trp", rows, weight)

        start = jnp.zeros(
            (beyond.shape[0], len(slots.attributes) + 4, beyond.shape[1]), beyond.dtype
        )
        sums = lax.fori_loop(jnp.int32(0), lanes.blocks, add, start)
        px, py = self.pixels(beyond.dtype)
        nearness = sums[:, -4] + sums[:, -3] * px[None] + sums[:, -2] * py[None]
        return jnp.concatenate([sums[:, :-4], nearness[:, None], sums[:, -1:]], axis=1)

    def add_cotangents(self, slots: "Slots", lanes: _Lanes, beyond, upto, cotangent, gradients):
        """Add the cotangents of planes and attributes, per slot, for the fragments between two
        limits, from those of the sums.
        """
        px, py = self.pixels(beyond.dtype)
        monomials = jnp.asarray(
            np.stack([np.ones_like(px), px, py, px * px, px * py, py * py], axis=1)
        )
        nearness = cotangent[:, -2]
        plane = jnp.stack([nearness, nearness * px[None], nearness * py[None]], axis=1)
        cotangent = jnp.concatenate([cotangent[:, :-2], plane, cotangent[:, -1:]], axis=1)

        def add(block, gradients):
            splats = self.splats(slots.planes, block, lanes)
            nearness, quadric = self.fragments(splats)
            squared_radius = self.squared_radii(
                nearness, quadric, lanes.until_end(beyond, block), upto
            )
            weight = fast_fragment_weight(squared_radius)
            rows, opacity = self.rows(splats, slots.attributes, block, lanes), splats[-1]
            d_rows = jnp.moveaxis(jnp.einsum("trp,tsp->trs", cotangent, weight), 1, 0)
            d_weight = opacity[:, :, None] * jnp.einsum(
                "tsr,trp->tsp", jnp.stack(rows, axis=2), cotangent
            )
            d_squared = fragment_weight_derivative(squared_radius, weight) * d_weight
            nearness = jnp.where(squared_radius < 1, nearness, 1.0)
            d_nearness, d_quadric = self.view.squared_radius_vjp(
                nearness, squared_radius, d_squared
            )
            # Both are polynomials in the pixel: their moments over the tile are all that is needed.
            quad = jnp.moveaxis(d_quadric @ monomials, 2, 0)
            near = jnp.moveaxis(d_nearness @ monomials[:, :3], 2, 0)
            d_opacity = sum(row * d_row for row, d_row in zip(rows, d_rows, strict=True))
            d_rows = d_rows * opacity[None]
            d_planes = _plane_cotangents(splats, quad, near + d_rows[-4:-1])
            parts = [*d_planes, d_opacity, *d_rows[:-4]]
            return tuple(
                lanes.add(whole, block, part) for whole, part in zip(gradients, parts, strict=True)
            )

        return lax.fori_loop(jnp.int32(0), lanes.blocks, add, gradients)


class Slots(eqx.Module):
    """What the sweeps read, gathered into slots; rows of one lane each."""

    planes: list[Float[Array, "rows slots"]]
    shift: Float[Array, "rows slots"]
    attributes: list[Float[Array, "rows slots"]]

    @classmethod
    def gathered(cls, shift, planes, attributes, bins: Bins) -> "Slots":
        def slots(plane, fill):
            return slot_plane(plane, fill, bins).reshape(-1, bins.ids.shape[2])

        filled = zip(planes, _EMPTY, strict=True)
        return cls(
            [slots(*each) for each in filled],
            slots(shift, 0.0),
            [slots(row, 0.0) for row in attributes],
        )


def picked(is_open: Bool[Array, " tiles"], lanes: int):
    """Find the places of open tiles, a lane each, and in how many rounds; the rest of the last
    round is empty.
    """
    places = jnp.nonzero(is_open, size=is_open.shape[0] + lanes, fill_value=is_open.shape[0])[
        0
    ].astype(jnp.int32)
    count = jnp.sum(is_open, dtype=jnp.int32)

    def pick(i):
        picked = lax.dynamic_slice_in_dim(places, i * lanes, lanes)
        real = picked < is_open.shape[0]
        return jnp.where(real, picked, is_open.shape[0] - 1), real[:, None]

    return pick, -(-count // lanes)


def second_limits(
    weighty: Float[Array, "tiles pixels"], of_any: Float[Array, "tiles pixels"]
) -> Float[Array, "tiles pixels"]:
    """Give where what lies behind ends, from the largest of both in all parts; inf where that is
    nothing.
    """
    found = jnp.where(weighty > -jnp.inf, weighty, of_any)
    return jnp.where(found > -jnp.inf, found, jnp.inf)


def _forward(sweep: Sweep, bins: Bins, shift, planes, attributes):
    """Sweep all chunks: both surfaces, tile by tile, and per pixel where they end, in lane
    order.
    """
    slots, grid = Slots.gathered(shift, planes, attributes, bins), sweep.grid
    dtype, within = planes[0].dtype, grid.within_picture()
    poison = bins.poison(dtype)

    def seen(sums, tiles):
        """What of a tile lies beyond the picture shows nothing."""
        if within is None:
            return sums
        return jnp.where(
            jnp.asarray(within)[jnp.minimum(tiles, grid.count - 1)][:, None], sums, 0.0
        )

    def chunk(i, out):
        tiles = sweep.chunk(bins, i, dtype)
        limit = sweep.limits(slots, tiles)
        sums = seen(
            sweep.sums(slots, tiles, limit, None),
            lax.dynamic_slice_in_dim(bins.order, i * grid.lanes, grid.lanes),
        )
        parts = FragmentSums.of(sums), limit
        return jax.tree.map(
            lambda whole, part: lax.dynamic_update_slice_in_dim(whole, part, i * grid.lanes, 0),
            out,
            parts,
        )

    empty = zeros_after(slots.shift, (bins.places, len(attributes) + 2, SIDE**2), dtype)
    never = jnp.inf + empty[:, 0]
    front, limits = lax.fori_loop(jnp.int32(0), bins.chunks, chunk, (FragmentSums.of(empty), never))
    gaps = (front.weights < sweep.full_coverage) & (limits > -jnp.inf) & (limits < jnp.inf)
    pick, rounds = picked(jnp.any(gaps, axis=1), grid.lanes)

    def look_behind(i, out):
        behind, seconds = out
        places, real = pick(i)
        lanes, limit, tiles = sweep.picked(bins, places, dtype), limits[places], bins.order[places]
        second = second_limits(
            *sweep.limits_behind(slots, lanes, jnp.where(gaps[places] & real, limit, -jnp.inf))
        )
        found = FragmentSums.of(seen(sweep.sums(slots, lanes, second, limit), tiles))
        return jax.tree.map(
            lambda whole, part: whole.at[tiles].add(part), behind, found
        ), seconds.at[places].min(second)

    nothing = FragmentSums.of(
        poison + zeros_after(rounds, (grid.count, len(attributes) + 2, SIDE**2), dtype)
    )
    behind, seconds = lax.fori_loop(jnp.int32(0), rounds, look_behind, (nothing, never))
    return (
        jax.tree.map(lambda each: bins.by_tile(each, grid.count) + poison, front),
        behind,
        (limits, seconds),
    )


def backward(sweep: Sweep, bins: Bins, shift, planes, attributes, limits, cotangents):
    """Sweep all chunks again: the cotangents of planes and attributes, per slot, then summed per
    splat.
    """
    slots, grid = Slots.gathered(shift, planes, attributes, bins), sweep.grid
    dtype, count = planes[0].dtype, len(planes) + len(attributes)
    (limits, seconds), (d_front, d_behind) = limits, cotangents

    def of_tiles(cotangent: FragmentSums, tiles):
        return jax.tree.map(
            lambda whole: whole.at[tiles].get(mode="fill", fill_value=0), cotangent
        ).rows()

    def chunk(i, gradients):
        limit, tiles = (
            lax.dynamic_slice_in_dim(each, i * grid.lanes, grid.lanes)
            for each in (limits, bins.order)
        )
        return sweep.add_cotangents(
            slots, sweep.chunk(bins, i, dtype), limit, None, of_tiles(d_front, tiles), gradients
        )

    start = tuple(zeros_after(d_front.weights, slots.shift.shape, dtype) for _ in range(count))
    gradients = lax.fori_loop(jnp.int32(0), bins.chunks, chunk, start)
    pick, rounds = picked(jnp.any(seconds < jnp.inf, axis=1), grid.lanes)

    def look_behind(i, gradients):
        places, real = pick(i)
        cotangent, beyond = (
            of_tiles(d_behind, bins.order[places]),
            jnp.where(real, seconds[places], jnp.inf),
        )
        return sweep.add_cotangents(
            slots, sweep.picked(bins, places, dtype), beyond, limits[places], cotangent, gradients
        )

    gradients = lax.fori_loop(jnp.int32(0), rounds, look_behind, gradients)
    per_splat = tuple(scatter_slots(plane, bins, planes[0].shape[0]) for plane in gradients)
    return per_splat[: len(planes)], per_splat[len(planes) :]


def _plane_cotangents(splats, quad, near):
    """Turn moments of the cotangents over the pixels into cotangents of a splat's numbers."""
    x, y, sx, sy, a, b, c, _, _ = splats
    m, mx, my, mxx, mxy, myy = quad
    n, nx, ny = near
    dx, dy = mx - x * m, my - y * m
    dxx = mxx - 2 * x * mx + x * x * m
    dxy = mxy - x * my - y * mx + x * y * m
    dyy = myy - 2 * y * my + y * y * m
    d_x = -(2 * a * dx + b * dy + sx * n)
    d_y = -(b * dx + 2 * c * dy + sy * n)
    return d_x, d_y, nx - x * n, ny - y * n, dxx, dxy, dyy, n


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def sweep_tiles(
    sweep: Sweep,
    bins: Bins,
    shift: Float[Array, " splats"],
    planes: tuple[Float[Array, " splats"], ...],
    attributes: tuple[Float[Array, " splats"], ...],
):
    """Sum attributes over the splats of every tile: the front surface and the one behind it."""
    front, behind, _ = _forward(sweep, bins, shift, planes, attributes)
    return front, behind


def sweep_tiles_fwd(sweep: Sweep, bins: Bins, shift, planes, attributes):
    front, behind, limits = _forward(sweep, bins, shift, planes, attributes)
    return (front, behind), (bins, shift, planes, attributes, limits)


def sweep_tiles_bwd(sweep: Sweep, residuals, cotangents):
    return (None, None, *backward(sweep, *residuals, cotangents))


sweep_tiles.defvjp(sweep_tiles_fwd, sweep_tiles_bwd)
