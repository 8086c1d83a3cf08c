"""Passes 2 and 3: the surface in front, and the one behind it at silhouettes, with blended attributes (Eq. 1)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scene import Splats

from ._kernel import coverage
from ._rasterizer import AbstractRasterizer
from ._settings import SplattingSettings
from ._views import AbstractView


class Surface(eqx.Module):
    """One surface as pixels see it. Where `weight_sum` is 0 there is none: attributes 0, depth 1."""

    attributes: Float[Array, "attributes height width"]
    depth: Float[Array, "height width"]
    weight_sum: Float[Array, "height width"]
    coverage: Float[Array, "height width"]


class Surfaces(eqx.Module):
    """What the pixels see: a front surface, and what shows through where it ends."""

    front: Surface
    behind: Surface
    needed: Float[Array, ""]


def splat_surfaces(
    splats: Splats,
    attributes: Float[Array, "attributes splats"],
    view: AbstractView,
    settings: SplattingSettings,
    rasterizer: AbstractRasterizer,
) -> Surfaces:
    r"""Find the visible surfaces and blend the attributes of their splats (passes 2 and 3).

    The nearness of each ray's hit with each splat's plane is blended like an attribute, so that a plane stays a plane.

    **Arguments:**

    - `splats`: differentiable; which fragments count is not.
    - `attributes`: one row per attribute. Differentiable.
    - `view`: differentiable.

    **Returns:** `Surfaces`; NaN where the rasterizer's capacity was exceeded.
    """
    blended = rasterizer.blended(splats, attributes, view, settings)

    def surface(rows: Float[Array, "rows height width"]) -> Surface:
        weight_sum = rows[-1]
        depth = view.depth(jnp.where(weight_sum != 0, rows[-2], 1.0))
        return Surface(rows[:-2], depth, weight_sum, coverage(weight_sum, settings.full_coverage))

    return Surfaces(surface(blended.front), surface(blended.behind), blended.needed)
