"""Pass 4: splat-based diffusion (section 4.2), one layer per Gaussian."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.scene import Material
from splatjax.splatting import AbstractView, Surface

from ._diffuser import AbstractDiffuser, Kernels, Sources
from ._handover import resolved_share
from ._normalization import AbstractNormalization


class DiffusionLayers(eqx.Module):
    """The layers `L_k` of one surface, and how much of each is the diffusion integral, not the surface's own irradiance."""

    layers: Float[Array, "gaussians channels height width"]
    resolved: Float[Array, "gaussians height width"]


class SeenSurface(eqx.Module):
    """A surface as the pixels see it, with what pass 3 blended for the layers that the splats are too far apart to carry."""

    surface: Surface
    irradiance: Float[Array, "channels height width"]
    area: Float[Array, "height width"]
    """Of a splat, mm^2."""
    albedo: Float[Array, "channels height width"]
    """What colors the surface, besides the Gaussians' weights."""


def pixel_points(view: AbstractView, depth: Float[Array, "height width"]) -> Float[Array, "3 height width"]:
    """Give the points (mm) that the pixels see at a depth (mm)."""
    x = jnp.arange(view.width, dtype=depth.dtype)[None] + 0.5
    y = jnp.arange(view.height, dtype=depth.dtype)[:, None] + 0.5
    return view.unproject(jnp.broadcast_to(x, depth.shape), jnp.broadcast_to(y, depth.shape), depth)


def diffusion_layers(
    sources: Sources,
    material: Material,
    seen: Sequence[SeenSurface],
    interval: Float[Array, "2"],
    view: AbstractView,
    diffuser: AbstractDiffuser,
    normalization: AbstractNormalization,
) -> tuple[list[DiffusionLayers], Float[Array, ""]]:
    r"""Diffuse the irradiance of the splats to the points that the pixels see.

    **Arguments:**

    - `sources`: centers (mm), normals, areas (mm^2) and irradiance of the splats. Differentiable.
    - `material`: its Gaussians, one per layer. Their weights tell the normalization how much light is absorbed; the layers are
      not multiplied by them. Differentiable.
    - `seen`: the surface in front, and the one that shows behind its silhouettes. Differentiable.
    - `interval`: from `handover_interval`.

    **Returns:** the layers of both, without weights, and what capacity was needed over what was planned. They are linear in the
    light. For weights that are not negative and sum to one or less, their weighted sum is at most the greatest irradiance; where
    they sum to one it keeps constants. Each layer keeps constants, and `min E <= L_k <= max E`, where the normalization's gain
    is 1: everywhere for `PlainMean`; for `ExitOdds` on flat pieces and at open edges.

    **Source:** Kim et al. 2010, section 4.2; the normalization's own.
    """
    covered = jnp.stack([stop_gradient(each.surface.weight_sum) > 0 for each in seen])
    points = jnp.stack([pixel_points(view, each.surface.depth) for each in seen])
    variances = material.gaussians.variances
    kernels = Kernels(variances, normalization.depths(variances))
    diffused = diffuser.diffuse(sources, kernels, points, covered, view)
    found = []
    for place, each in enumerate(seen):
        area = jnp.where(covered[place], each.area, 1.0)
        resolved = jax.vmap(lambda variance, area=area: resolved_share(variance, area, interval))(variances)
        resolved = resolved * diffused.carried[:, None, None]
        own = each.irradiance[None]
        # Splats too far apart to carry a layer do not count its exits either.
        exits = 1 + resolved * (diffused.exits[:, place] - 1)
        means = own + resolved[:, None] * (diffused.means[:, place] - own)
        found.append(DiffusionLayers(normalization.gain(exits, material, each.albedo) * means, resolved))
    return found, diffused.needed
