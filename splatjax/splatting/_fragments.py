"""The fragments of splats in the pixels of tiles: sums along a tile's list, and the cotangents of
the splats.

Fragments are computed relative to their tile, so that float32 suffices at any resolution.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, Shaped

from ._bins import TILE_SIDE, Bins, TileGrid
from ._rasterizer import (
    PixelSums,
    fast_fragment_weight,
    fragment_weight_derivative,
    least_weight,
)
from ._views import AbstractView, SplattingSettings

# Fields of the footprints on which sums depend.
PLANES = ("x", "y", "slope_x", "slope_y", "a", "b", "c", "nearness", "opacity")
_EMPTY = (0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 1e12, 1.0, 0.0)  # covers no pixel center


class Lanes(eqx.Module):
    """Tiles that are swept together: the starts of their lists in the slots, and their corners.

    **Attributes:**

    - `row`: of the lane's first block in the slots, whose arrays are `[blocks * lanes, slots]`;
      block b is at `row + b * stride`.
    - `lengths`: of the lane's chunk, in blocks; the blocks after it belong to the next chunk.
    - `blocks`: the largest of the lengths.
    - `x`, `y`: corners, pixels.
    """

    row: Int[Array, " lanes"]
    lengths: Int[Array, " lanes"]
    blocks: Int[Array, ""]
    x: Float[Array, "lanes 1"]
    y: Float[Array, "lanes 1"]
    stride: int = eqx.field(static=True)

    def read(self, plane: Shaped[Array, "rows slots"], block) -> Shaped[Array, "lanes slots"]:
        return plane.at[self.row + block * self.stride].get(mode="promise_in_bounds")


class Sweep(eqx.Module):
    """Splats in the lists of the tiles, and loops over their fragments in some lanes. The splats
    may be one of several parts: those of another part may be in front.

    **Attributes:**

    - `view_class`: fragments need the formulas of a view, not its position. Static.
    - `ids`, `planes`, `shift`: of the splats, gathered into slots, in rows of one lane each.
    - `attributes`: of the splats; they are too many for slots.
    """

    view_class: type[AbstractView] = eqx.field(static=True)
    grid: TileGrid
    settings: SplattingSettings
    bins: Bins
    ids: Int[Array, "rows slots"]
    planes: list[Float[Array, "rows slots"]]
    shift: Float[Array, "rows slots"]
    attributes: Float[Array, "splats attributes"]

    @classmethod
    def of(
        cls,
        view_class: type[AbstractView],
        grid: TileGrid,
        settings: SplattingSettings,
        bins: Bins,
        shift: Float[Array, " splats"],
        planes: tuple[Float[Array, " splats"], ...],
        attributes: Float[Array, "splats attributes"],
    ) -> "Sweep":
        """Gather splats into the slots of the bins."""
        ids = bins.ids.reshape(-1, grid.slots)
        own_shift, *own = (
            plane.at[ids].get(mode="fill", fill_value=fill)
            for plane, fill in zip((shift, *planes), (0.0, *_EMPTY), strict=True)
        )
        return cls(view_class, grid, settings, bins, ids, own, own_shift, attributes)

    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Pixel centers of a tile, from its corner. They are NumPy constants; the compiler would
        otherwise compute them per fragment.
        """
        side = np.arange(TILE_SIDE, dtype=self.shift.dtype) + np.asarray(0.5, self.shift.dtype)
        return np.tile(side, TILE_SIDE), np.repeat(side, TILE_SIDE)

    def lanes(self, lane_numbers: Int[Array, " lanes"]) -> Lanes:
        """Look up lanes by their number in `bins.order`; those from `bins.planned_lanes` on are
        empty and have length 0.
        """
        bins, lanes, across = self.bins, self.grid.lanes, self.grid.across
        exist = lane_numbers < bins.planned_lanes
        lane_numbers = jnp.minimum(lane_numbers, bins.planned_lanes - 1)
        tiles, chunk = bins.order[lane_numbers], lane_numbers // lanes
        row = bins.first_block[chunk] * lanes + lane_numbers % lanes
        lengths = jnp.where(exist, bins.first_block[chunk + 1] - bins.first_block[chunk], 0)
        x, y = (
            (index * TILE_SIDE).astype(self.shift.dtype)[:, None]
            for index in (tiles % across, tiles // across)
        )
        return Lanes(row, lengths, jnp.max(lengths), x, y, lanes)

    def splats(self, lanes: Lanes, block):
        """Read a block's splats, `[lanes, slots]` each, placed relative to their tile's corner."""
        x, y, *rest = (lanes.read(plane, block) for plane in self.planes)
        return x - lanes.x, y - lanes.y, *rest

    def fragments(self, splats):
        """Compute nearness and quadric of a block's fragments, `[lanes, slots, pixels]`."""
        x, y, sx, sy, a, b, c, e = (p[:, :, None] for p in splats[:8])
        px, py = (jnp.asarray(p)[None, None] for p in self.pixels())
        dx, dy = px - x, py - y
        return e + sx * dx + sy * dy, dx * (a * dx + b * dy) + c * dy * dy

    def weigh(self, lanes: Lanes, block, far_limit, near_limit):
        """Weigh the fragments of a block between two limits, `far_limit < nearness <= near_limit`.

        **Returns:** the splats, nearness and quadric, and `rho^2` and the weight without opacity;
        of all other fragments these are 1 and 0.
        """
        splats = self.splats(lanes, block)
        nearness, quadric = self.fragments(splats)
        # Without those of lanes whose list has ended.
        far_limit = jnp.where((block < lanes.lengths)[:, None], far_limit, jnp.inf)
        between = (nearness > far_limit[:, None]) & (nearness <= near_limit[:, None])
        chosen = self.view_class.inside(nearness, quadric) & between
        squared_radius = self.view_class.squared_radius(nearness, quadric)
        squared_radius = jnp.where(chosen, squared_radius, 1.0)
        return splats, nearness, quadric, squared_radius, fast_fragment_weight(squared_radius)

    def _nearest(self, lanes: Lanes, block, nearness, chosen, limit):
        """Move a limit to the nearest shifted one of the chosen fragments of a block."""
        shifted = self.view_class.shifted(nearness, lanes.read(self.shift, block)[:, :, None])
        return jnp.maximum(limit, jnp.max(jnp.where(chosen, shifted, -jnp.inf), axis=1))

    def limits(self, lanes: Lanes):
        """Find per pixel the nearest shifted fragment: the far limit of the front, -inf without
        one. The lanes are one chunk: their lists have equal length.
        """

        def step(block, limit):
            nearness, quadric = self.fragments(self.splats(lanes, block))
            inside = self.view_class.inside(nearness, quadric)
            return self._nearest(lanes, block, nearness, inside, limit)

        none = jnp.full((len(lanes.row), TILE_SIDE**2), -jnp.inf, self.shift.dtype)
        return lax.fori_loop(jnp.int32(0), lanes.blocks, step, none)

    def limits_behind(self, lanes: Lanes, open_limit):
        """Find the same behind the front, whose far limit is `open_limit` in open pixels and -inf
        in others: for the fragments of sufficient weight, and for all.
        """
        none = jnp.full_like(open_limit, -jnp.inf)

        def step(block, limits):
            splats, nearness, _, squared_radius, weight = self.weigh(lanes, block, none, open_limit)
            least = least_weight(self.view_class, *splats[4:8], self.settings.filter_radius)
            is_weighty = splats[-1][:, :, None] * weight > least[:, :, None]
            return tuple(
                self._nearest(lanes, block, nearness, chosen, limit)
                for chosen, limit in zip((is_weighty, squared_radius < 1), limits, strict=True)
            )

        return lax.fori_loop(jnp.int32(0), lanes.blocks, step, (none, none))

    def rows(self, ids, splats):
        """Return `[lanes, slots, rows]`: attributes, the plane of nearness over the tile (three
        rows) and 1.
        """
        attributes = self.attributes.at[ids].get(mode="fill", fill_value=0)
        nearness, _ = _polynomials(*splats[:-1])
        return jnp.concatenate([attributes, nearness, jnp.ones_like(nearness[:, :, :1])], axis=2)

    def sums(self, lanes: Lanes, far_limit, near_limit) -> PixelSums:
        """Sum over the fragments between two limits."""

        def add(block, sums):
            splats, *_, weight = self.weigh(lanes, block, far_limit, near_limit)
            rows = self.rows(lanes.read(self.ids, block), splats)
            # The transpose in memory costs less than it saves in the product.
            rows = lax.optimization_barrier(jnp.swapaxes(rows, 1, 2))
            return sums + jnp.einsum("trs,tsp->trp", rows, splats[-1][:, :, None] * weight)

        (places, pixels), rows = far_limit.shape, self.attributes.shape[1]
        start = jnp.zeros((places, rows + 4, pixels), far_limit.dtype)
        sums = lax.fori_loop(jnp.int32(0), lanes.blocks, add, start)
        attributes, nearness = sums[:, :rows], sums[:, rows:]
        px, py = self.pixels()
        plane = nearness[:, 0] + nearness[:, 1] * px[None] + nearness[:, 2] * py[None]
        return PixelSums(jnp.concatenate([attributes, plane[:, None]], axis=1), nearness[:, 3])

    def add_cotangents(self, lanes: Lanes, far_limit, near_limit, cotangent: PixelSums, gradients):
        """Add the cotangents of planes, per slot, and of attributes, per splat, for the fragments
        between two limits, from those of the sums.
        """
        px, py = self.pixels()
        monomials = jnp.asarray(
            np.stack([np.ones_like(px), px, py, px * px, px * py, py * py], axis=1)
        )
        count, of_nearness = self.attributes.shape[1], cotangent.rows[:, -1:]
        of_plane = [of_nearness * px[None, None], of_nearness * py[None, None]]
        of_weights = cotangent.weights[:, None]
        of_rows = jnp.concatenate([cotangent.rows, *of_plane, of_weights], axis=1)

        def add(block, gradients):
            splats, nearness, quadric, squared_radius, weight = self.weigh(
                lanes, block, far_limit, near_limit
            )
            ids, opacity = lanes.read(self.ids, block), splats[-1]
            rows = self.rows(ids, splats)
            # Cotangents of the summed rows, per slot, for a weight without opacity.
            d_rows = jnp.einsum("tsp,trp->tsr", weight, of_rows)
            d_opacity = jnp.sum(rows * d_rows, axis=2)
            # Cotangents of the weights, and through them of nearness and quadric.
            d_weight = opacity[:, :, None] * jnp.einsum("tsr,trp->tsp", rows, of_rows)
            d_squared = fragment_weight_derivative(squared_radius, weight) * d_weight
            nearness = jnp.where(squared_radius < 1, nearness, 1.0)
            _, pull = jax.vjp(self.view_class.squared_radius, nearness, quadric)
            d_nearness, d_quadric = pull(d_squared)
            # Both are polynomials in the pixel: their moments over the tile suffice.
            d_rows = d_rows * opacity[:, :, None]
            moments = d_nearness @ monomials[:, :3] + d_rows[:, :, count : count + 3]
            _, pull = jax.vjp(_polynomials, *splats[:-1])
            d_planes = *pull((moments, d_quadric @ monomials)), d_opacity
            of_planes, of_attributes = gradients
            at = lanes.row + block * lanes.stride
            of_planes = tuple(
                total.at[at].add(new, mode="promise_in_bounds")
                for total, new in zip(of_planes, d_planes, strict=True)
            )
            return of_planes, of_attributes.at[ids].add(d_rows[:, :, :count], mode="drop")

        return lax.fori_loop(jnp.int32(0), lanes.blocks, add, gradients)


def _polynomials(x, y, sx, sy, a, b, c, e):
    """Compute the coefficients of nearness and quadric as polynomials in the pixel: of 1, x, y,
    and of 1, x, y, x^2, x y, y^2.
    """
    nearness = e - sx * x - sy * y, sx, sy
    constant = a * x * x + b * x * y + c * y * y
    quadric = constant, -(2 * a * x + b * y), -(b * x + 2 * c * y), a, b, c
    return jnp.stack(nearness, axis=2), jnp.stack(quadric, axis=2)
