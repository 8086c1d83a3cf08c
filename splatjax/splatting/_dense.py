"""The plain rasterizer: every splat against every pixel, a row at a time. The reference; it has
every derivative.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats

from ._bins import TileGrid
from ._kernel import fragment_weight
from ._rasterizer import AbstractRasterizer, FragmentSums, SummedFragments, least_weight
from ._settings import SplattingSettings
from ._views import AbstractView


class DenseRasterizer(AbstractRasterizer):
    """Tries every splat at every pixel. Slow and plain; forward mode and second order work."""

    def planned(
        self, splats: Splats, views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "DenseRasterizer":
        return self

    def summed(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> SummedFragments:
        dtype, footprints = attributes.dtype, view.footprints(splats, settings)
        columns = jnp.arange(view.width, dtype=dtype) + 0.5
        conic = footprints.a, footprints.b, footprints.c, footprints.nearness
        least = stop_gradient(least_weight(type(view), *conic, settings.filter_radius))

        def picture_row(y: Float[Array, ""]):
            dx, dy = columns[:, None] - footprints.x[None], (y - footprints.y)[None]
            nearness = (
                footprints.nearness[None]
                + footprints.slope_x[None] * dx
                + footprints.slope_y[None] * dy
            )
            quadric = (
                dx * (footprints.a[None] * dx + footprints.b[None] * dy)
                + footprints.c[None] * dy * dy
            )
            inside = footprints.visible[None] & view.inside(nearness, quadric)
            squared_radius = jnp.where(
                inside, view.squared_radius(jnp.where(inside, nearness, 1.0), quadric), 1.0
            )
            weight = jnp.where(
                inside, footprints.opacity[None] * fragment_weight(squared_radius), 0.0
            )
            shifted = view.shifted(nearness, footprints.shift[None])

            limit = jnp.max(jnp.where(inside, shifted, -jnp.inf), axis=1)
            front = inside & (nearness > limit[:, None])

            def summed(chosen: Bool[Array, "columns splats"]) -> Float[Array, "rows columns"]:
                weights, hits = jnp.where(chosen, weight, 0.0), jnp.where(chosen, nearness, 0.0)
                last = jnp.stack([jnp.sum(weights * hits, axis=1), jnp.sum(weights, axis=1)])
                return jnp.concatenate([attributes @ weights.T, last])

            in_front = summed(front)
            open_pixel = stop_gradient(in_front[-1]) < settings.full_coverage
            rest = inside & ~front & open_pixel[:, None]
            weighty = jnp.max(jnp.where(rest & (weight > least[None]), shifted, -jnp.inf), axis=1)
            of_any = jnp.max(jnp.where(rest, shifted, -jnp.inf), axis=1)
            limit_behind = jnp.where(weighty > -jnp.inf, weighty, of_any)
            return in_front, summed(rest & (nearness > limit_behind[:, None]))

        grid = TileGrid(view.width, view.height)
        if splats.count == 0:
            empty = FragmentSums.nothing(grid.count, attributes.shape[0], dtype)
            return SummedFragments(empty, empty, jnp.zeros((), dtype))
        both = jax.lax.map(picture_row, jnp.arange(view.height, dtype=dtype) + 0.5)
        front, behind = (FragmentSums.of(grid.cut(each.transpose(1, 0, 2))) for each in both)
        return SummedFragments(front, behind, jnp.zeros((), dtype))
