"""The plain diffuser: every splat against every point, untruncated. The reference; it has every derivative."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats
from splatjax.splatting import AbstractView

from ._diffuser import AbstractDiffuser, Diffused, Sources


class DenseDiffuser(AbstractDiffuser):
    """Sums over every splat at every point, a row of points at a time. Slow and plain."""

    def planned(
        self, splats: Splats, variances: Float[Array, " gaussians"], interval: Float[Array, "2"], views: Sequence[AbstractView]
    ) -> "DenseDiffuser":
        return self

    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        points: Float[Array, "surfaces 3 height width"],
        covered: Bool[Array, "surfaces height width"],
        view: AbstractView,
    ) -> Diffused:
        def picture_row(row):
            points, covered = row
            offset = points[:, :, None] - sources.centers[:, None]
            squared = jnp.sum(offset * offset, axis=0)
            # The ratio does not change when both sums are scaled: the nearest splat's exponent becomes zero.
            nearest = stop_gradient(jnp.min(squared, axis=1, keepdims=True))

            def layer(variance):
                weight = sources.areas[None] * jnp.exp(-0.5 * (squared - nearest) / variance)
                return (sources.irradiance @ weight.T) / jnp.sum(weight, axis=1)[None]

            return jnp.where(covered[None, None], jax.lax.map(layer, variances), 0.0)

        surfaces, height, width = covered.shape
        channels = sources.irradiance.shape[0]
        none, carried = jnp.zeros((), points.dtype), jnp.ones(variances.shape, points.dtype)
        if sources.areas.shape[0] == 0:
            return Diffused(jnp.zeros((variances.shape[0], surfaces, channels, height, width), points.dtype), carried, none)
        rows = points.transpose(0, 2, 1, 3).reshape(surfaces * height, 3, width), covered.reshape(surfaces * height, width)
        layers = jax.lax.map(picture_row, rows)
        layers = layers.reshape(surfaces, height, *layers.shape[1:])
        return Diffused(layers.transpose(2, 0, 3, 1, 4), carried, none)
