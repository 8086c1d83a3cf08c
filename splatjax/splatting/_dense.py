"""The plain rasterizer: every splat at every pixel, a row at a time. It is the reference, and
supports every derivative.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax._combination import DeviceMesh
from splatjax.scene import Splats

from ._grid import TileGrid
from ._rasterizer import (
    AbstractRasterizer,
    AbstractRasterPlan,
    FragmentSums,
    PixelSums,
    fragment_weight,
    least_weight,
    may_show_behind,
)
from ._views import AbstractView, SplattingSettings


class DenseRasterizer(AbstractRasterizer):
    """Evaluates every splat at every pixel. Slow; supports forward mode and second order."""

    def make_plan(self, parts, views, settings):
        if len(parts) > 1:
            raise ValueError("a DenseRasterizer works on one device; give a TileRasterizer")
        return DenseRasterPlan()


class DenseRasterPlan(AbstractRasterPlan):
    """The plan of the plain rasterizer, which needs no capacity."""

    def sum_fragments(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
        combination: DeviceMesh,
    ) -> FragmentSums:
        dtype, grid = attributes.dtype, TileGrid(view.width, view.height)
        columns = jnp.arange(view.width, dtype=dtype)[:, None] + 0.5
        f = jax.tree.map(lambda row: row[None], view.footprints(splats, settings))
        # The least weight of a fragment that determines the surface behind the front.
        least = least_weight(type(view), f.a, f.b, f.c, f.nearness, settings.filter_radius)
        least = jax.lax.stop_gradient(least)

        def picture_row(y: Float[Array, ""]):
            # Intersect the ray of every pixel with the plane of every splat: nearness and rho^2 are
            # polynomials in the offset from the projected center.
            dx, dy = columns - f.x, y - f.y
            nearness = f.nearness + f.slope_x * dx + f.slope_y * dy
            quadric = dx * (f.a * dx + f.b * dy) + f.c * dy * dy
            # Weigh the fragments: hits within the rim (Eq. 1's w_i).
            inside = f.visible & view.inside(nearness, quadric)
            squared_radius = jnp.where(
                inside, view.squared_radius(jnp.where(inside, nearness, 1.0), quadric), 1.0
            )
            weight = jnp.where(inside, f.opacity * fragment_weight(squared_radius), 0.0)
            # Move every fragment away from the eye by epsilon (3.1).
            shifted = view.shifted(nearness, f.shift)

            def nearest(chosen: Bool[Array, "columns splats"]) -> Float[Array, " columns"]:
                return jnp.max(jnp.where(chosen, shifted, -jnp.inf), axis=1)

            def summed(chosen: Bool[Array, "columns splats"]) -> Float[Array, "rows columns"]:
                weights, hits = jnp.where(chosen, weight, 0.0), jnp.where(chosen, nearness, 0.0)
                last = jnp.stack([jnp.sum(weights * hits, axis=1), jnp.sum(weights, axis=1)])
                return jnp.concatenate([attributes @ weights.T, last])

            # The front: fragments nearer than the nearest shifted one.
            front = inside & (nearness > nearest(inside)[:, None])
            in_front = summed(front)
            # Behind it: the same among the remaining ones; the nearest of some weight decides.
            behind = inside & ~front
            weighty = nearest(behind & (weight > least))
            limit = jnp.where(weighty > -jnp.inf, weighty, nearest(behind))
            return in_front, summed(behind & (nearness > limit[:, None]))

        surfaces = jax.lax.map(picture_row, jnp.arange(view.height, dtype=dtype) + 0.5)
        front, behind = (grid.cut(surface.transpose(1, 0, 2)) for surface in surfaces)
        is_open = may_show_behind(front[:, -1], grid, settings.hidden_from)
        rows = jnp.concatenate([front, jnp.where(is_open[:, None], behind, 0.0)])
        tiles = jnp.tile(jnp.arange(grid.count, dtype=jnp.int32), 2)
        sums = PixelSums(rows[:, :-1], rows[:, -1])
        return FragmentSums(tiles, sums, jnp.zeros((), dtype), grid.count)
