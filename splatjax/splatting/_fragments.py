"""The fragments of splats in the pixels of tiles: sums along a tile's list, and the cotangents of
the splats.

Fragments are computed relative to their tile, so that float32 suffices at any resolution.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from splatjax._chunking import divided

from ._bins import Bins
from ._grid import TILE_SIDE, TileGrid
from ._rasterizer import (
    PixelSums,
    fast_fragment_weight,
    fragment_weight_derivative,
    least_weight,
)
from ._views import AbstractView

# Fields of the footprints on which sums depend.
NUMBERS = ("x", "y", "slope_x", "slope_y", "a", "b", "c", "nearness", "opacity")
_EMPTY = (0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 1e12, 1.0, 0.0, 0.0)  # covers no pixel center


class Lanes(eqx.Module):
    """Tiles that are swept together.

    **Attributes:**

    - `tiles`: the tile of each lane; the number of tiles for an empty lane.
    - `blocks`: number of blocks of the longest list.
    - `x`, `y`: corners of the tiles, pixels.
    """

    tiles: Int[Array, " lanes"]
    blocks: Int[Array, ""]
    x: Float[Array, "lanes 1"]
    y: Float[Array, "lanes 1"]


class Sweep(eqx.Module):
    """The settings of a sweep, and its inner loops over the blocks of some lanes.

    **Attributes:**

    - `view_class`: fragments need the formulas of a view, not its position. Static.
    """

    view_class: type[AbstractView] = eqx.field(static=True)
    grid: TileGrid
    filter_radius: float = eqx.field(static=True)

    def within_picture(self, sums: PixelSums, tiles: Int[Array, " lanes"]) -> PixelSums:
        """Set pixels of a tile beyond the picture to zero."""
        if self.grid.width % TILE_SIDE == 0 and self.grid.height % TILE_SIDE == 0:
            return sums
        within = self.grid.within_picture(tiles)
        rows = jnp.where(within[:, None], sums.rows, 0.0)
        return PixelSums(rows, jnp.where(within, sums.weights, 0.0))

    def pixels(self, dtype) -> tuple[np.ndarray, np.ndarray]:
        """Pixel centers of a tile, from its corner. They are NumPy constants; the compiler would
        otherwise compute them per fragment.
        """
        side = np.arange(TILE_SIDE, dtype=dtype) + np.asarray(0.5, dtype)
        return np.tile(side, TILE_SIDE), np.repeat(side, TILE_SIDE)

    def lanes(self, bins: Bins, tiles: Int[Array, " lanes"], dtype) -> Lanes:
        """Look up some tiles."""
        blocks = self.grid.blocks(jnp.max(bins.counts[tiles]))
        down, across = divided(tiles, self.grid.across)
        x, y = ((index * TILE_SIDE).astype(dtype)[:, None] for index in (across, down))
        return Lanes(tiles, blocks, x, y)

    def ids(self, listed: "Listed", lanes: Lanes, block) -> Int[Array, "lanes slots"]:
        return listed.bins.block(lanes.tiles, block, self.grid.slots)

    def splats(self, listed: "Listed", ids: Int[Array, "lanes slots"], lanes: Lanes):
        """Read the numbers of splats, `[lanes, slots]` each, placed relative to their tile's
        corner.
        """
        rows = listed.numbers.at[ids].get(mode="promise_in_bounds")
        x, y, *fields = jnp.moveaxis(rows, 2, 0)
        return x - lanes.x, y - lanes.y, *fields

    def fragments(self, splats):
        """Compute nearness and quadric of a block's fragments, `[lanes, slots, pixels]`."""
        x, y, sx, sy, a, b, c, e = (p[:, :, None] for p in splats[:8])
        px, py = (jnp.asarray(p)[None, None] for p in self.pixels(x.dtype))
        dx, dy = px - x, py - y
        return e + sx * dx + sy * dy, dx * (a * dx + b * dy) + c * dy * dy

    def limits(self, listed: "Listed", lanes: Lanes):
        """Find per pixel the nearest shifted fragment: the far limit of the front."""

        def nearest(block, limit):
            splats = self.splats(listed, self.ids(listed, lanes, block), lanes)
            nearness, quadric = self.fragments(splats)
            shifted = self.view_class.shifted(nearness, splats[-1][:, :, None])
            return jnp.maximum(
                limit,
                jnp.max(
                    jnp.where(self.view_class.inside(nearness, quadric), shifted, -jnp.inf), axis=1
                ),
            )

        return lax.fori_loop(jnp.int32(0), lanes.blocks, nearest, self._no_limit(lanes))

    def limits_behind(self, listed: "Listed", lanes: Lanes, open_limit):
        """Find the far limits behind the front, for fragments of sufficient weight and for all. The
        far limit of the front is `open_limit` in open pixels; in others `open_limit` is -inf.
        """

        def nearest(block, limits):
            splats = self.splats(listed, self.ids(listed, lanes, block), lanes)
            nearness, quadric = self.fragments(splats)
            shifted = self.view_class.shifted(nearness, splats[-1][:, :, None])
            no_limit = jnp.full_like(open_limit, -jnp.inf)
            squared_radius = self.squared_radii(nearness, quadric, no_limit, open_limit)
            weight = splats[-2][:, :, None] * fast_fragment_weight(squared_radius)
            least = least_weight(self.view_class, *splats[4:8], self.filter_radius)
            chosen = weight > least[:, :, None], squared_radius < 1
            new = (jnp.max(jnp.where(is_chosen, shifted, -jnp.inf), axis=1) for is_chosen in chosen)
            return tuple(jnp.maximum(*pair) for pair in zip(limits, new, strict=True))

        return lax.fori_loop(
            jnp.int32(0), lanes.blocks, nearest, (self._no_limit(lanes), self._no_limit(lanes))
        )

    def _no_limit(self, lanes: Lanes):
        return jnp.full((lanes.tiles.shape[0], TILE_SIDE**2), -jnp.inf, lanes.x.dtype)

    def squared_radii(self, nearness, quadric, far_limit, near_limit):
        """Compute `rho^2`, below 1 for the fragments between two limits; 1, where the weight is 0,
        for all others.
        """
        between = (nearness > far_limit[:, None]) & (nearness <= near_limit[:, None])
        chosen = self.view_class.inside(nearness, quadric) & between
        return jnp.where(chosen, self.view_class.squared_radius(nearness, quadric), 1.0)

    def rows(self, listed: "Listed", ids, splats):
        """Return `[lanes, slots, rows]`: attributes, the plane of nearness over the tile (three
        rows) and 1.
        """
        x, y, sx, sy, _, _, _, e, _, _ = splats
        nearness = jnp.stack([e - sx * x - sy * y, sx, sy, jnp.ones_like(e)], axis=2)
        attributes = listed.attributes.at[ids].get(mode="fill", fill_value=0)
        return jnp.concatenate([attributes, nearness], axis=2)

    def sums(self, listed: "Listed", lanes: Lanes, far_limit, near_limit) -> PixelSums:
        """Sum over the fragments between two limits."""

        def add(block, sums):
            ids = self.ids(listed, lanes, block)
            splats = self.splats(listed, ids, lanes)
            squared_radius = self.squared_radii(*self.fragments(splats), far_limit, near_limit)
            weight = splats[-2][:, :, None] * fast_fragment_weight(squared_radius)
            rows = self.rows(listed, ids, splats)
            # The transpose in memory costs less than it saves in the product.
            rows = lax.optimization_barrier(jnp.swapaxes(rows, 1, 2))
            return sums + jnp.einsum("trs,tsp->trp", rows, weight)

        (places, pixels), rows = far_limit.shape, listed.attributes.shape[1]
        start = jnp.zeros((places, rows + 4, pixels), far_limit.dtype)
        sums = lax.fori_loop(jnp.int32(0), lanes.blocks, add, start)
        attributes, nearness = sums[:, :rows], sums[:, rows:]
        px, py = self.pixels(far_limit.dtype)
        plane = nearness[:, 0] + nearness[:, 1] * px[None] + nearness[:, 2] * py[None]
        return PixelSums(jnp.concatenate([attributes, plane[:, None]], axis=1), nearness[:, 3])

    def add_cotangents(
        self,
        listed: "Listed",
        lanes: Lanes,
        far_limit,
        near_limit,
        cotangent: PixelSums,
        gradients: Float[Array, "splats_and_one numbers_and_attributes"],
    ) -> Float[Array, "splats_and_one numbers_and_attributes"]:
        """Add the cotangents of splats for the fragments between two limits, from those of the
        sums.
        """
        px, py = self.pixels(far_limit.dtype)
        monomials = jnp.asarray(
            np.stack([np.ones_like(px), px, py, px * px, px * py, py * py], axis=1)
        )
        count, of_nearness = listed.attributes.shape[1], cotangent.rows[:, -1:]
        of_plane = [of_nearness * px[None, None], of_nearness * py[None, None]]
        of_weights = cotangent.weights[:, None]
        of_rows = jnp.concatenate([cotangent.rows, *of_plane, of_weights], axis=1)

        def add(block, gradients):
            ids = self.ids(listed, lanes, block)
            splats = self.splats(listed, ids, lanes)
            nearness, quadric = self.fragments(splats)
            squared_radius = self.squared_radii(nearness, quadric, far_limit, near_limit)
            weight = fast_fragment_weight(squared_radius)
            opacity, rows = splats[-2], self.rows(listed, ids, splats)
            # Cotangents of the summed rows, per slot, for a weight without opacity.
            d_rows = jnp.einsum("tsp,trp->tsr", weight, of_rows)
            d_opacity = jnp.sum(rows * d_rows, axis=2)
            # Cotangents of the weights, and through them of nearness and quadric.
            d_weight = opacity[:, :, None] * jnp.einsum("tsr,trp->tsp", rows, of_rows)
            d_squared = fragment_weight_derivative(squared_radius, weight) * d_weight
            nearness = jnp.where(squared_radius < 1, nearness, 1.0)
            d_nearness, d_quadric = self.view_class.squared_radius_vjp(
                nearness, squared_radius, d_squared
            )
            # Both are polynomials in the pixel: their moments over the tile suffice.
            quad = jnp.moveaxis(d_quadric @ monomials, 2, 0)
            near = jnp.moveaxis(d_nearness @ monomials[:, :3], 2, 0)
            d_rows = d_rows * opacity[:, :, None]
            near = near + jnp.moveaxis(d_rows[:, :, count : count + 3], 2, 0)
            d_numbers = jnp.stack([*_number_cotangents(splats, quad, near), d_opacity], axis=2)
            d_splats = jnp.concatenate([d_numbers, d_rows[:, :, :count]], axis=2)
            return gradients.at[ids].add(d_splats, mode="promise_in_bounds")

        return lax.fori_loop(jnp.int32(0), lanes.blocks, add, gradients)


class Listed(eqx.Module):
    """The input of the sweeps: lists of splats, and the splats.

    **Attributes:**

    - `hidden_from`: the weight sum of a front from which on nothing is seen behind it.
    - `numbers`: `NUMBERS` and shift of every splat, and of the one that empty slots refer to.
    - `attributes`: of every splat.
    """

    bins: Bins
    hidden_from: Float[Array, ""]
    numbers: Float[Array, "splats_and_one numbers"]
    attributes: Float[Array, "splats attributes"]

    @classmethod
    def of(
        cls,
        hidden_from: Float[Array, ""],
        bins: Bins,
        shift: Float[Array, " splats"],
        numbers: tuple[Float[Array, " splats"], ...],
        attributes: Float[Array, "attributes splats"],
    ) -> "Listed":
        rows = jnp.stack([*numbers, shift], axis=1)
        empty = jnp.asarray([_EMPTY], rows.dtype)
        return cls(bins, hidden_from, jnp.concatenate([rows, empty]), attributes.T)


def _number_cotangents(splats, quad, near):
    """Convert moments of the cotangents over the pixels to cotangents of a splat's numbers."""
    x, y, sx, sy, a, b, c, _, _, _ = splats
    m, mx, my, mxx, mxy, myy = quad
    n, nx, ny = near
    dx, dy = mx - x * m, my - y * m
    dxx = mxx - 2 * x * mx + x * x * m
    dxy = mxy - x * my - y * mx + x * y * m
    dyy = myy - 2 * y * my + y * y * m
    d_x = -(2 * a * dx + b * dy + sx * n)
    d_y = -(b * dx + 2 * c * dy + sy * n)
    return d_x, d_y, nx - x * n, ny - y * n, dxx, dxy, dyy, n


def second_limits(
    weighty: Float[Array, "places pixels"], of_any: Float[Array, "places pixels"]
) -> Float[Array, "places pixels"]:
    """Choose the end of the surface behind from the two largest limits over all parts; inf without
    a surface.
    """
    limits = jnp.where(weighty > -jnp.inf, weighty, of_any)
    return jnp.where(limits > -jnp.inf, limits, jnp.inf)
