"""The plain diffuser: every splat against every point, untruncated. The reference; it has every
derivative.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import Atlas

from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources


class DenseDiffuser(AbstractDiffuser):
    """Sums over every splat at every point, a tile of points at a time. Slow and plain."""

    def planned(
        self,
        splats: Splats,
        kernels: Kernels,
        interval: Float[Array, "2"],
        atlases: Sequence[Atlas],
    ) -> "DenseDiffuser":
        return self

    def diffuse(
        self,
        sources: Sources,
        kernels: Kernels,
        points: Float[Array, "tiles 3 points"],
        covered: Bool[Array, "tiles points"],
        atlas: Atlas,
    ) -> Diffused:
        def of_tile(tile):
            points, covered = tile

            def layer(kernel):
                variance, depth = kernel
                offset = points[:, :, None] - (sources.centers - depth * sources.normals)[:, None]
                squared = jnp.sum(offset * offset, axis=0)
                # The mean does not change when both sums are scaled: the nearest source's exponent
                # becomes zero.
                nearest = stop_gradient(jnp.min(squared, axis=1, keepdims=True))
                weight = sources.areas[None] * jnp.exp(-0.5 * (squared - nearest) / variance)
                gathered = jnp.sum(weight, axis=1)
                # What a flat sheet gathers is one exit; far from everything this underflows,
                # cleanly.
                scale = jnp.exp(-0.5 * (nearest[:, 0] - depth * depth) / variance) / (
                    2 * jnp.pi * variance
                )
                means = (sources.irradiance @ weight.T) / gathered[None]
                return jnp.concatenate([means, (gathered * scale)[None]])

            found = jax.lax.map(layer, (kernels.variances, kernels.depths))
            return jnp.where(covered[None, None], found, 0.0)

        channels, gaussians = sources.irradiance.shape[0], kernels.variances.shape[0]
        none, carried = jnp.zeros((), points.dtype), jnp.ones(gaussians, points.dtype)
        if sources.areas.shape[0] == 0:
            found = jnp.zeros(
                (covered.shape[0], gaussians, channels + 1, covered.shape[1]), points.dtype
            )
        else:
            found = jax.lax.map(of_tile, (points, covered))
        return Diffused(found[:, :, :channels], found[:, :, channels], carried, none)

    def in_forward_mode(self) -> "DenseDiffuser":
        return self
