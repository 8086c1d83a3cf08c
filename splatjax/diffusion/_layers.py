"""Pass 4: splat-based diffusion (section 4.2), one layer per Gaussian."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.splatting import AbstractView, Surface

from ._diffuser import AbstractDiffuser, Sources
from ._handover import resolved_share


class DiffusionLayers(eqx.Module):
    """The layers `L_k` of one surface, and how much of each is the diffusion integral, not the surface's own irradiance."""

    layers: Float[Array, "gaussians channels height width"]
    resolved: Float[Array, "gaussians height width"]
    needed: Float[Array, ""]


def diffusion_layers(
    sources: Sources,
    variances: Float[Array, " gaussians"],
    surface: Surface,
    surface_irradiance: Float[Array, "channels height width"],
    surface_area: Float[Array, "height width"],
    interval: Float[Array, "2"],
    view: AbstractView,
    diffuser: AbstractDiffuser,
) -> DiffusionLayers:
    r"""Diffuse the irradiance of the splats to the points that the pixels see.

    **Arguments:**

    - `sources`: centers (mm), areas (mm^2) and irradiance of the splats. Differentiable.
    - `variances`: mm^2, one per layer. Differentiable.
    - `surface`: where the pixels see the surface. Differentiable.
    - `surface_irradiance`, `surface_area`: of the splats, blended by pass 3: the layer where the splats are too far apart to
      carry it, and how far apart they are.
    - `interval`: from `handover_interval`.

    **Returns:** layers without weights. Constants are kept, and `min E <= L_k <= max E`.

    **Source:** Kim et al. 2010, section 4.2.
    """
    covered = stop_gradient(surface.weight_sum) > 0
    x = jnp.arange(view.width, dtype=variances.dtype)[None] + 0.5
    y = jnp.arange(view.height, dtype=variances.dtype)[:, None] + 0.5
    shape = covered.shape
    points = view.unproject(jnp.broadcast_to(x, shape), jnp.broadcast_to(y, shape), surface.depth)
    diffused = diffuser.diffuse(sources, variances, points, covered, view)
    area = jnp.where(covered, surface_area, 1.0)
    resolved = jax.vmap(lambda variance: resolved_share(variance, area, interval))(variances)
    own = surface_irradiance[None]
    return DiffusionLayers(own + resolved[:, None] * (diffused.layers - own), resolved, diffused.needed)
