"""Elliptical points: in every pixel the nearest splat wins."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.splatting import AbstractView

from ._kernels import AbstractSplatKernel, DiscKernel
from ._tiles import AbstractListRasterizer, TileLists


class NearestRasterizer(AbstractListRasterizer):
    """Gives every pixel the attributes of its nearest splat, and full coverage. The choice of the
    splat has no derivative.
    """

    kernel: AbstractSplatKernel = DiscKernel()

    def front(
        self, lists: TileLists, attributes: Float[Array, "attributes splats"], view: AbstractView
    ) -> Float[Array, "places rows pixels"]:
        def nearest(ids, footprints, dx, dy):
            fragments = self.kernel.fragments(footprints, view, dx, dy)
            nearness = jnp.where(fragments.is_inside, fragments.nearness, -jnp.inf)
            best = jnp.argmax(nearness, axis=1)
            return jnp.max(nearness, axis=1), jnp.take_along_axis(ids, best, axis=1)

        nearness, ids = jax.tree.map(stop_gradient, lists.map_blocks(nearest))
        nearest_of_all = lists.reduce_blocks(jax.ops.segment_max, nearness)
        wins = (nearness == nearest_of_all[lists.chunk]) & (nearness > -jnp.inf)
        winner = lists.reduce_blocks(jax.ops.segment_max, jnp.where(wins, ids, -1))
        winner = winner.reshape(-1, winner.shape[2])
        ids = jnp.maximum(winner, 0)
        footprint = jax.tree.map(lambda plane: plane[ids], lists.footprints)
        x, y = (
            pixel.astype(attributes.dtype) + 0.5
            for pixel in lists.grid.columns_and_rows(lists.bins.order)
        )
        fragments = self.kernel.fragments(footprint, view, x - footprint.x, y - footprint.y)
        totals = jnp.stack([fragments.nearness, jnp.ones_like(x)])
        rows = jnp.concatenate([attributes[:, ids], totals])
        return jnp.where((winner >= 0)[None], rows, 0.0).transpose(1, 0, 2)
