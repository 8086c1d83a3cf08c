"""Passes 2 and 3: the surface in front, and the one behind it at silhouettes, with blended
attributes (Eq. 1).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scene import Splats

from ._kernel import coverage
from ._rasterizer import AbstractRasterizer, FragmentSums
from ._settings import SplattingSettings
from ._views import AbstractView


def blend_fragments(
    sums: Float[Array, "tiles *rows pixels"], weights: Float[Array, "tiles *#rows pixels"]
) -> Float[Array, "..."]:
    r"""Blend the fragments of each pixel, `c(f) = sum_i w_i c_i / sum_i w_i` (Eq. 1); 0 where there
    is none.

    **Arguments:** `sums`, `weights`: of `w_i c_i` and of `w_i`. Differentiable.

    **Source:** Kim et al. 2010, Eq. 1.
    """
    there = weights != 0  # they are never negative, and NaN must stay
    return sums * jnp.where(there, 1 / jnp.where(there, weights, 1.0), 0.0)


class Surface(eqx.Module):
    """One surface as pixels see it, in tiles. Where `weight_sum` is 0 there is none: attributes 0,
    depth that of nearness 1.
    """

    attributes: Float[Array, "tiles attributes pixels"]
    depth: Float[Array, "tiles pixels"]
    """mm along the view's forward axis."""
    weight_sum: Float[Array, "tiles pixels"]
    coverage: Float[Array, "tiles pixels"]

    @classmethod
    def of(cls, sums: FragmentSums, view: AbstractView, settings: SplattingSettings) -> "Surface":
        """Blend the sums of a rasterizer."""
        nearness = blend_fragments(sums.nearness, sums.weights)
        depth = view.depth(jnp.where(sums.weights != 0, nearness, 1.0))
        attributes = blend_fragments(sums.attributes, sums.weights[:, None])
        return cls(attributes, depth, sums.weights, coverage(sums.weights, settings.full_coverage))


class Surfaces(eqx.Module):
    """What the pixels see, in the tiles of a `TileGrid`: a front surface, and what shows through
    where it ends.
    """

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

    The nearness of each ray's hit with each splat's plane is blended like an attribute, so that a
    plane stays a plane.

    **Arguments:**

    - `splats`: differentiable; which fragments count is not.
    - `attributes`: one row per attribute. Differentiable.
    - `view`: differentiable.

    **Returns:** `Surfaces`; NaN where the rasterizer's capacity was exceeded.
    """
    summed = rasterizer.summed(splats, attributes, view, settings)
    surface = jax.checkpoint(
        partial(Surface.of, settings=settings)
    )  # what is blended is cheap to find again, and large
    front, behind = (surface(each, view) for each in (summed.front, summed.behind))
    return Surfaces(front, behind, summed.needed)
