"""The fragments of splats in the pixels of tiles: sums along a tile's list, and the cotangents of
the splats.

Fragments are computed relative to their tile, so that float32 suffices at any resolution.
"""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax
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


SweepSettings: TypeAlias = tuple[type[AbstractView], TileGrid, float]
"""The formulas of a view, without its position; its tiles; and the radius of the screen filter."""


class PartSweep(eqx.Module):
    """A part of the splats, listed by tile, and the inner loops over the lists of some tiles.

    The splats of another part may be in front. The *lanes* of a loop are the tiles that are swept
    together; an empty lane holds the number of tiles.

    **Attributes:**

    - `view_class`, `grid`, `filter_radius`: the `SweepSettings`.
    - `hidden_from`: the weight sum of a front from which on nothing is seen behind it.
    - `numbers`: `NUMBERS` and shift of every splat, and of the one that empty slots refer to.
    - `attributes`: of every splat.
    """

    view_class: type[AbstractView] = eqx.field(static=True)
    grid: TileGrid
    filter_radius: float = eqx.field(static=True)
    hidden_from: Float[Array, ""]
    bins: Bins
    numbers: Float[Array, "splats_and_one numbers"]
    attributes: Float[Array, "splats attributes"]

    @classmethod
    def of(
        cls,
        settings: SweepSettings,
        hidden_from: Float[Array, ""],
        bins: Bins,
        shift: Float[Array, " splats"],
        numbers: tuple[Float[Array, " splats"], ...],
        attributes: Float[Array, "attributes splats"],
    ) -> "PartSweep":
        rows = jnp.stack([*numbers, shift], axis=1)
        rows = jnp.concatenate([rows, jnp.asarray([_EMPTY], rows.dtype)])
        return cls(*settings, hidden_from, bins, rows, attributes.T)

    def fold(self, lanes: Int[Array, " lanes"], add: Callable, start):
        """Fold `add(ids, splats, so_far)` over the blocks of the lanes' lists.

        **Arguments:**

        - `add`: of the ids of a block's splats, and of their numbers, placed relative to the corner
          of their tile; `[lanes, slots]` each.
        """
        down, across = divided(lanes, self.grid.across)
        corners = [(i * TILE_SIDE).astype(self.numbers.dtype)[:, None] for i in (across, down)]

        def add_block(block, so_far):
            ids = self.bins.block(lanes, block, self.grid.slots)
            rows = self.numbers.at[ids].get(mode="promise_in_bounds")
            x, y, *fields = jnp.moveaxis(rows, 2, 0)
            return add(ids, (x - corners[0], y - corners[1], *fields), so_far)

        blocks = self.grid.blocks(jnp.max(self.bins.counts[lanes]))
        return lax.fori_loop(jnp.int32(0), blocks, add_block, start)

    def fragments(self, splats):
        """Compute nearness and quadric of a block's fragments, `[lanes, slots, pixels]`."""
        x, y, sx, sy, a, b, c, e = (p[:, :, None] for p in splats[:8])
        px, py = (jnp.asarray(p)[None, None] for p in _pixels(x.dtype))
        dx, dy = px - x, py - y
        return e + sx * dx + sy * dy, dx * (a * dx + b * dy) + c * dy * dy

    def squared_radii(self, nearness, quadric, far_limit, near_limit):
        """Compute `rho^2`, below 1 for the fragments between two limits; 1, where the weight is 0,
        for all others.
        """
        between = (nearness > far_limit[:, None]) & (nearness <= near_limit[:, None])
        chosen = self.view_class.inside(nearness, quadric) & between
        return jnp.where(chosen, self.view_class.squared_radius(nearness, quadric), 1.0)

    def ends(self, lanes: Int[Array, " lanes"], choose: Callable, surfaces: int):
        """Find the far limits of some surfaces in each pixel: the largest nearness of the chosen
        fragments, when all are moved away from the eye by epsilon; -inf without fragments.

        **Arguments:**

        - `choose`: returns for each surface which fragments are chosen, from the splats of a block
          and their fragments.
        """

        def nearest(_, splats, limits):
            nearness, quadric = self.fragments(splats)
            shifted = self.view_class.shifted(nearness, splats[-1][:, :, None])
            chosen = choose(splats, nearness, quadric)
            new = (jnp.max(jnp.where(is_chosen, shifted, -jnp.inf), axis=1) for is_chosen in chosen)
            return tuple(jnp.maximum(*pair) for pair in zip(limits, new, strict=True))

        no_limit = jnp.full((len(lanes), TILE_SIDE**2), -jnp.inf, self.numbers.dtype)
        return self.fold(lanes, nearest, (no_limit,) * surfaces)

    def front_limits(self, lanes: Int[Array, " lanes"]) -> Float[Array, "lanes pixels"]:
        """Find the far limit of the front."""

        def choose(_, nearness, quadric):
            return (self.view_class.inside(nearness, quadric),)

        return self.ends(lanes, choose, 1)[0]

    def limits_behind(self, lanes: Int[Array, " lanes"], near_limit: Float[Array, "lanes pixels"]):
        """Find the far limits behind the front, for fragments of sufficient weight and for all.

        **Arguments:**

        - `near_limit`: the far limit of the front in pixels that it leaves open; -inf in others.
        """
        no_limit = jnp.full_like(near_limit, -jnp.inf)

        def choose(splats, nearness, quadric):
            squared_radius = self.squared_radii(nearness, quadric, no_limit, near_limit)
            weight = splats[-2][:, :, None] * fast_fragment_weight(squared_radius)
            least = least_weight(self.view_class, *splats[4:8], self.filter_radius)
            return weight > least[:, :, None], squared_radius < 1

        return self.ends(lanes, choose, 2)

    def rows(self, ids, splats):
        """Return `[lanes, slots, rows]`: attributes, the plane of nearness over the tile (three
        rows) and 1.
        """
        _, plane = _polynomials(*splats[:8])
        nearness = jnp.stack([*plane, jnp.ones_like(plane[0])], axis=2)
        attributes = self.attributes.at[ids].get(mode="fill", fill_value=0)
        return jnp.concatenate([attributes, nearness], axis=2)

    def sums(self, lanes: Int[Array, " lanes"], far_limit, near_limit) -> PixelSums:
        """Sum over the fragments between two limits."""

        def add(ids, splats, sums):
            squared_radius = self.squared_radii(*self.fragments(splats), far_limit, near_limit)
            weight = splats[-2][:, :, None] * fast_fragment_weight(squared_radius)
            # The transpose in memory costs less than it saves in the product.
            rows = lax.optimization_barrier(jnp.swapaxes(self.rows(ids, splats), 1, 2))
            return sums + jnp.einsum("trs,tsp->trp", rows, weight)

        (places, pixels), rows = far_limit.shape, self.attributes.shape[1]
        sums = self.fold(lanes, add, jnp.zeros((places, rows + 4, pixels), far_limit.dtype))
        attributes, nearness = sums[:, :rows], sums[:, rows:]
        px, py = _pixels(far_limit.dtype)
        plane = nearness[:, 0] + nearness[:, 1] * px[None] + nearness[:, 2] * py[None]
        return PixelSums(jnp.concatenate([attributes, plane[:, None]], axis=1), nearness[:, 3])

    def add_cotangents(
        self,
        lanes: Int[Array, " lanes"],
        far_limit,
        near_limit,
        cotangent: PixelSums,
        gradients: Float[Array, "splats_and_one numbers_and_attributes"],
    ) -> Float[Array, "splats_and_one numbers_and_attributes"]:
        """Add the cotangents of splats for the fragments between two limits, from those of the
        sums.
        """
        px, py = _pixels(far_limit.dtype)
        monomials = jnp.asarray(
            np.stack([np.ones_like(px), px, py, px * px, px * py, py * py], axis=1)
        )
        count, of_nearness = self.attributes.shape[1], cotangent.rows[:, -1:]
        of_plane = [of_nearness * px[None, None], of_nearness * py[None, None]]
        of_weights = cotangent.weights[:, None]
        of_rows = jnp.concatenate([cotangent.rows, *of_plane, of_weights], axis=1)

        def add(ids, splats, gradients):
            nearness, quadric = self.fragments(splats)
            squared_radius = self.squared_radii(nearness, quadric, far_limit, near_limit)
            weight = fast_fragment_weight(squared_radius)
            opacity, rows = splats[-2], self.rows(ids, splats)
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
            d_rows = d_rows * opacity[:, :, None]
            near = d_nearness @ monomials[:, :3] + d_rows[:, :, count : count + 3]
            moments = tuple(tuple(jnp.moveaxis(x, 2, 0)) for x in (d_quadric @ monomials, near))
            _, pull = jax.vjp(_polynomials, *splats[:8])
            d_numbers = jnp.stack([*pull(moments), d_opacity], axis=2)
            d_splats = jnp.concatenate([d_numbers, d_rows[:, :, :count]], axis=2)
            return gradients.at[ids].add(d_splats, mode="promise_in_bounds")

        return self.fold(lanes, add, gradients)


def _pixels(dtype) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixel centers of a tile, from its corner. They are NumPy constants; the compiler
    would otherwise compute them per fragment.
    """
    side = np.arange(TILE_SIDE, dtype=dtype) + np.asarray(0.5, dtype)
    return np.tile(side, TILE_SIDE), np.repeat(side, TILE_SIDE)


def _polynomials(x, y, sx, sy, a, b, c, e):
    """Expand the quadric of splats in 1, x, y, x^2, xy, y^2 of a pixel, and nearness in 1, x, y."""
    constant = a * x * x + b * x * y + c * y * y
    quadric = constant, -2 * a * x - b * y, -b * x - 2 * c * y, a, b, c
    return quadric, (e - sx * x - sy * y, sx, sy)
