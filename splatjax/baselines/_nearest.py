"""Elliptical points: in every pixel the nearest splat wins."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.splatting import AbstractView, BinCapacity, FragmentSums

from ._kernels import AbstractSplatKernel, DiscKernel
from ._tiles import AbstractListRasterizer, Lists


class NearestRasterizer(AbstractListRasterizer):
    """Gives every pixel the attributes of the nearest splat there, and covers it whole. Which one
    it is has no derivative.
    """

    kernel: AbstractSplatKernel = DiscKernel()
    capacity: BinCapacity | None = None

    def front(
        self, lists: Lists, attributes: Float[Array, "attributes splats"], view: AbstractView
    ) -> FragmentSums:
        def nearest(ids, footprints, dx, dy):
            fragments = self.kernel.fragments(footprints, view, dx, dy)
            nearness = jnp.where(fragments.is_inside, fragments.nearness, -jnp.inf)
            best = jnp.argmax(nearness, axis=1)
            return jnp.max(nearness, axis=1), jnp.take_along_axis(ids, best, axis=1)

        nearness, ids = jax.tree.map(stop_gradient, lists.map_blocks(nearest))
        nearest_of_all = lists.reduce_blocks(jax.ops.segment_max, nearness)
        wins = (nearness == nearest_of_all[lists.chunk]) & (nearness > -jnp.inf)
        winner = lists.reduce_blocks(jax.ops.segment_max, jnp.where(wins, ids, -1))
        # Beyond the picture tiles are 0, so the numbers of splats begin at 1.
        numbers = (jnp.maximum(winner, -1)[:, :, None] + 1).astype(attributes.dtype)
        winner = lists.tiles(numbers)[:, 0] - 1
        is_covered = winner >= 0
        ids = jnp.where(is_covered, winner, 0).astype(jnp.int32)
        footprint = jax.tree.map(lambda plane: plane[ids], lists.footprints)
        tiles = jnp.arange(lists.grid.count, dtype=jnp.int32)
        x, y = (
            pixel.astype(attributes.dtype) + 0.5 for pixel in lists.grid.columns_and_rows(tiles)
        )
        fragments = self.kernel.fragments(footprint, view, x - footprint.x, y - footprint.y)
        own = jnp.stack([fragments.nearness, jnp.ones_like(winner)])
        rows = jnp.concatenate([attributes[:, ids], own])
        rows = jnp.where(is_covered[None], rows, 0.0) + 0 * winner[None]  # NaN where none fits
        return FragmentSums.of(rows.transpose(1, 0, 2))
