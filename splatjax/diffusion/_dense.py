"""The plain diffuser: every splat at every point, untruncated. It is the reference, and supports
every derivative.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._chunking import map_chunks, take_points
from splatjax._combination import DeviceMesh

from ._diffuser import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    LayerValues,
    Sources,
    layer_values,
)
from ._kernel import AbstractDiffusionKernel

_AT_ONCE = 64  # points evaluated together


class DenseDiffuser(AbstractDiffuser):
    """Sums over every splat at every splat. Slow."""

    def make_plan(self, splats, variances, kernel, interval, devices=1):
        return DensePlan(jnp.arange(len(variances), dtype=jnp.int32))


class DensePlan(AbstractDiffusionPlan):
    """The plan of the plain diffuser: the number of layers."""

    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: DeviceMesh,
        at: Int[Array, " points"] | None = None,
    ) -> Diffused:
        everywhere = combination.gather(sources, axis=-1).of_layers(self.gaussians)
        points = take_points(sources.centers, at)
        layers = dense_layers(everywhere, points, self.variances_of_layers(variances), kernel)
        return Diffused(layers, jnp.zeros((), sources.centers.dtype))


def dense_layers(
    sources: Sources,
    points: Float[Array, "3 points"],
    variances: Float[Array, " gaussians"],
    kernel: AbstractDiffusionKernel,
) -> LayerValues:
    """Evaluate layers at any points, untruncated."""

    def evaluate(layer):
        variance, depth, light = layer
        lit = sources if light is None else dataclasses.replace(sources, irradiance=light)
        return dense_layer(lit, points, variance, depth)

    lights = sources.irradiance.swapaxes(0, 1) if sources.irradiance.ndim == 3 else None
    return jax.lax.map(evaluate, (variances, kernel.depths(variances), lights))


def dense_layer(
    sources: Sources,
    points: Float[Array, "3 points"],
    variance: Float[Array, ""],
    depth: Float[Array, ""],
) -> LayerValues:
    """Evaluate one layer at any points, untruncated."""
    # Sink the sources below their splats.
    below = sources.centers - depth * sources.normals  # ty: ignore[unsupported-operator]

    def evaluate(points: Float[Array, "points 3"]):
        # Squared distances of all points from all sources.
        offset = below[:, None] - points.T[:, :, None]
        squared = jnp.sum(offset * offset, axis=0)
        # Weight the sources by A_j G(v, |x - q_j|), up to a factor per point, which the means
        # cancel: the exponent of the nearest source is zero.
        nearest = jax.lax.stop_gradient(jnp.min(squared, axis=1, keepdims=True))
        weight = sources.areas[None] * jnp.exp(-0.5 * (squared - nearest) / variance)
        # Sum light and mass, and their first moments about the point; divide them.
        light = jnp.concatenate([sources.irradiance, jnp.ones_like(sources.areas)[None]])
        moments = jnp.concatenate([jnp.ones_like(offset[:1]), offset])
        sums = jnp.einsum("cs,aps,ps->cap", light, moments, weight)
        # The mass of a flat sheet; far from all sources the factor underflows to 0.
        flat = jnp.exp(-0.5 * (nearest[:, 0] - depth * depth) / variance) / (2 * jnp.pi * variance)
        layer = layer_values(sums, jnp.zeros_like(points.T), 1 / variance[None], flat)
        return jax.tree.map(lambda rows: jnp.moveaxis(rows, -1, 0), layer)

    layer = map_chunks(evaluate, points.T, at_once=_AT_ONCE)
    return jax.tree.map(lambda rows: jnp.moveaxis(rows, 0, -1), layer)
