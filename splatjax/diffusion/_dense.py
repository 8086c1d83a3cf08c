"""The plain diffuser: every splat against every point, untruncated. The reference; it has every
derivative.
"""

import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from splatjax._chunking import map_chunks, take_points
from splatjax._combination import AbstractCombination

from ._diffuser import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    LayerValues,
    Sources,
    layer_values,
    split_layer,
)
from ._kernel import AbstractDiffusionKernel

_AT_ONCE = 64  # points


class DenseDiffuser(AbstractDiffuser):
    """Sums over every splat at every splat. Slow and plain."""

    def make_plan(self, parts, variances, kernel, interval):
        return DensePlan()


class DensePlan(AbstractDiffusionPlan):
    """What the plain diffuser needs to know: nothing."""

    def diffuse(
        self,
        sources: Sources,
        variances: Float[Array, " gaussians"],
        kernel: AbstractDiffusionKernel,
        combination: AbstractCombination,
        at: Int[Array, " points"] | None = None,
    ) -> Diffused:
        everywhere = combination.gather_last(sources)
        points = sources.centers if at is None else take_points(sources.centers, at)
        layers = tuple(
            dense_layer(everywhere, points, variance, depth)
            for variance, depth in zip(variances, kernel.depths(variances), strict=True)
        )
        return Diffused(layers, jnp.zeros((), sources.centers.dtype))


def dense_layer(
    sources: Sources,
    points: Float[Array, "3 points"],
    variance: Float[Array, ""],
    depth: Float[Array, ""],
) -> LayerValues:
    """Evaluate one layer at any points, untruncated."""
    # Sink the sources below their splats.
    below = sources.centers - depth * sources.normals

    def evaluate(points: Float[Array, "points 3"]) -> Float[Array, "points rows"]:
        # Squared distances of all points from all sources.
        offset = below[:, None] - points.T[:, :, None]
        squared = jnp.sum(offset * offset, axis=0)
        # Weigh the sources, A_j G(v, |x - q_j|), but for a factor per point, which the means do not
        # notice: the exponent of the nearest source is zero.
        nearest = stop_gradient(jnp.min(squared, axis=1, keepdims=True))
        weight = sources.areas[None] * jnp.exp(-0.5 * (squared - nearest) / variance)
        # Sum light and mass, and their first moments about the point; divide them.
        light = jnp.concatenate([sources.irradiance, jnp.ones_like(sources.areas)[None]])
        firsts = jnp.einsum("cs,aps,ps->cap", light, offset, weight)
        rows = layer_values(light @ weight.T, firsts, jnp.zeros_like(points.T))
        # Scale the mass and its slopes, so that a flat sheet has mass 1; far from all sources the
        # factor underflows to 0.
        flat = jnp.exp(-0.5 * (nearest[:, 0] - depth * depth) / variance) / (2 * jnp.pi * variance)
        of_mass = jnp.zeros((len(light), 4), bool).at[-1].set(True)
        of_mass = jnp.concatenate([of_mass[:, 0], of_mass[:, 1:].reshape(-1)])
        return (rows * jnp.where(of_mass[:, None], flat[None], 1.0)).T

    if sources.areas.shape[0] == 0 or points.shape[1] == 0:
        shape = 4 * (sources.irradiance.shape[0] + 1), points.shape[1]
        return split_layer(jnp.zeros(shape, points.dtype), 1 / variance)
    return split_layer(map_chunks(evaluate, points.T, at_once=_AT_ONCE).T, 1 / variance)
