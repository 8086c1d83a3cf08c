"""The plain diffuser: every splat against every point, untruncated. The reference; it has every derivative."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import AbstractView

from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources


class DenseDiffuser(AbstractDiffuser):
    """Sums over every splat at every point, a row of points at a time. Slow and plain."""

    def planned(
        self, splats: Splats, kernels: Kernels, interval: Float[Array, "2"], views: Sequence[AbstractView]
    ) -> "DenseDiffuser":
        return self

    def diffuse(
        self,
        sources: Sources,
        kernels: Kernels,
        points: Float[Array, "surfaces 3 height width"],
        covered: Bool[Array, "surfaces height width"],
        view: AbstractView,
    ) -> Diffused:
        def picture_row(row):
            points, covered = row

            def layer(kernel):
                variance, depth = kernel
                offset = points[:, :, None] - (sources.centers - depth * sources.normals)[:, None]
                squared = jnp.sum(offset * offset, axis=0)
                # The mean does not change when both sums are scaled: the nearest source's exponent becomes zero.
                nearest = stop_gradient(jnp.min(squared, axis=1, keepdims=True))
                weight = sources.areas[None] * jnp.exp(-0.5 * (squared - nearest) / variance)
                gathered = jnp.sum(weight, axis=1)
                # What a flat sheet gathers is one exit; far from everything this underflows, cleanly.
                scale = jnp.exp(-0.5 * (nearest[:, 0] - depth * depth) / variance) / (2 * jnp.pi * variance)
                means = (sources.irradiance @ weight.T) / gathered[None]
                return jnp.concatenate([means, (gathered * scale)[None]])

            found = jax.lax.map(layer, (kernels.variances, kernels.depths))
            return jnp.where(covered[None, None], found, 0.0)

        surfaces, height, width = covered.shape
        channels = sources.irradiance.shape[0]
        none, carried = jnp.zeros((), points.dtype), jnp.ones(kernels.variances.shape, points.dtype)
        if sources.areas.shape[0] == 0:
            nothing = jnp.zeros((kernels.variances.shape[0], surfaces, channels + 1, height, width), points.dtype)
            return Diffused(nothing[:, :, :channels], nothing[:, :, channels], carried, none)
        rows = points.transpose(0, 2, 1, 3).reshape(surfaces * height, 3, width), covered.reshape(surfaces * height, width)
        layers = jax.lax.map(picture_row, rows)
        layers = layers.reshape(surfaces, height, *layers.shape[1:])
        layers = layers.transpose(2, 0, 3, 1, 4)
        return Diffused(layers[:, :, :channels], layers[:, :, channels], carried, none)

    def in_forward_mode(self) -> "DenseDiffuser":
        return self
