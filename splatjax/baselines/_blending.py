"""Splats blended by any kernel: normalized attributes of the front fragments (Eq. 1)."""

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.splatting import AbstractView, blend_fragments

from ._kernels import AbstractSplatKernel
from ._tiles import AbstractListRasterizer, TileLists


class BlendingRasterizer(AbstractListRasterizer):
    r"""Blends the fragments within epsilon of the nearest one.

    A pixel with a fragment is fully covered, and one without is not covered: silhouettes are hard,
    and holes stay open. The choice of fragments and coverage have no derivative.

    **Attributes:**

    - `kernel`: the contribution of a splat to a pixel.
    """

    kernel: AbstractSplatKernel

    def front(
        self, lists: TileLists, attributes: Float[Array, "attributes splats"], view: AbstractView
    ) -> Float[Array, "places rows pixels"]:
        def nearest(ids, footprints, dx, dy):
            fragments = self.kernel.fragments(footprints, view, dx, dy)
            shifted = view.shifted(fragments.nearness, footprints.shift)
            return jnp.max(jnp.where(fragments.is_inside, shifted, -jnp.inf), axis=1)

        limits = stop_gradient(lists.reduce_blocks(jax.ops.segment_max, lists.map_blocks(nearest)))

        def blend(ids, footprints, dx, dy, limit):
            fragments = self.kernel.fragments(footprints, view, dx, dy)
            in_front = fragments.is_inside & (fragments.nearness > limit[:, None])
            weight = jnp.where(in_front, fragments.weight, 0.0)
            rows = attributes.at[:, ids].get(mode="fill", fill_value=0)
            sums = jnp.einsum("rts,tsp->trp", rows, weight)
            totals = jnp.stack(
                [jnp.sum(weight * fragments.nearness, axis=1), jnp.sum(weight, axis=1)], axis=1
            )
            return jnp.concatenate([sums, totals], axis=1)

        sums = lists.reduce_blocks(jax.ops.segment_sum, lists.map_blocks(blend, limits))
        sums = sums.reshape(-1, *sums.shape[2:])
        weights = sums[:, -1:]
        is_covered = (weights > 0).astype(sums.dtype)
        return jnp.concatenate([blend_fragments(sums[:, :-1], weights), is_covered], axis=1)
