"""Elliptical points: in every pixel the nearest splat wins."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.splatting import AbstractView, BinCapacity, FragmentSums

from ._kernels import AbstractKernel, DiscKernel
from ._tiles import AbstractListRasterizer, Lists


class NearestRasterizer(AbstractListRasterizer):
    """Gives every pixel what the nearest splat there carries, and covers it whole. Which one it is
    has no derivative.
    """

    kernel: AbstractKernel = DiscKernel()
    capacity: BinCapacity | None = None

    def front(
        self, lists: Lists, attributes: Float[Array, "attributes splats"], view: AbstractView
    ) -> FragmentSums:
        def nearest(ids, footprints, dx, dy):
            found = self.kernel.fragments(footprints, view, dx, dy)
            near = jnp.where(found.there, found.nearness, -jnp.inf)
            best = jnp.argmax(near, axis=1)
            return jnp.max(near, axis=1), jnp.take_along_axis(ids, best, axis=1)

        near, ids = jax.tree.map(stop_gradient, lists.each(nearest))
        nearest_of_all = lists.over_blocks(jax.ops.segment_max, near)
        wins = (near == nearest_of_all[lists.chunk]) & (near > -jnp.inf)
        winner = lists.over_blocks(jax.ops.segment_max, jnp.where(wins, ids, -1))
        winner = (
            lists.tiles((jnp.maximum(winner, -1)[:, :, None] + 1).astype(attributes.dtype))[:, 0]
            - 1
        )
        return _of_winners(self.kernel, lists, view, attributes, winner)


def _of_winners(
    kernel: AbstractKernel,
    lists,
    view: AbstractView,
    attributes,
    winner: Float[Array, "tiles pixels"],
) -> FragmentSums:
    """Give what the splat carries that each pixel shows, by a weight of 1; 0 where it shows
    none.
    """
    there = winner >= 0
    ids = jnp.where(there, winner, 0).astype(jnp.int32)
    footprint = jax.tree.map(lambda plane: plane[ids], lists.footprints)
    grid = lists.grid
    x, y = (
        each.astype(attributes.dtype) + 0.5
        for each in grid.columns_and_rows(jnp.arange(grid.count, dtype=jnp.int32))
    )
    found = kernel.fragments(footprint, view, x - footprint.x, y - footprint.y)
    rows = jnp.concatenate([attributes[:, ids], found.nearness[None], jnp.ones_like(winner)[None]])
    return FragmentSums.of(
        (jnp.where(there[None], rows, 0.0) + 0 * winner[None]).transpose(1, 0, 2)
    )
