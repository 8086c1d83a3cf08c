"""Passes 2 and 3: the surface in front, and the one behind it at silhouettes, with blended attributes (Eq. 1)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._kernel import coverage
from ._rasterizer import AbstractRasterizer
from ._settings import SplattingSettings
from ._views import AbstractView, Footprints


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


def blend_attributes(
    sums: Float[Array, "rows height width"], weight_sum: Float[Array, "height width"]
) -> Float[Array, "rows height width"]:
    r"""Blend the fragments of a pixel, `c(f) = sum_i w_i c_i / sum_i w_i` (Eq. 1); 0 where there is no fragment.

    **Source:** Kim et al. 2010, Eq. 1.
    """
    covered = weight_sum != 0  # it is never negative, and NaN must stay
    return jnp.where(covered[None], sums / jnp.where(covered, weight_sum, 1.0)[None], 0.0)


def splat_surfaces(
    footprints: Footprints,
    attributes: Float[Array, "attributes splats"],
    view: AbstractView,
    settings: SplattingSettings,
    rasterizer: AbstractRasterizer,
) -> Surfaces:
    r"""Find the visible surfaces and blend the attributes of their splats (passes 2 and 3).

    The nearness of each ray's hit with each splat's plane is blended like an attribute, so that a plane stays a plane.

    **Arguments:**

    - `footprints`: the splats in this view. Differentiable; which fragments count is not.
    - `attributes`: one row per attribute. Differentiable.

    **Returns:** `Surfaces`; NaN where the rasterizer's capacity was exceeded.
    """
    sums = rasterizer.sums(footprints, attributes, view, settings)

    def surface(sums: Float[Array, "rows height width"]) -> Surface:
        weight_sum = sums[-1]
        blended = blend_attributes(sums[:-1], weight_sum)
        depth = view.depth(jnp.where(weight_sum != 0, blended[-1], 1.0))
        return Surface(blended[:-1], depth, weight_sum, coverage(weight_sum, settings.full_coverage))

    return Surfaces(surface(sums.front), surface(sums.behind), sums.needed)
