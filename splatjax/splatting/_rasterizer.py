"""What a rasterizer does, whichever way: blends attributes over the front surface and over what lies right behind it."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scene import Splats

from ._settings import SplattingSettings
from ._views import AbstractView

LEAST_WEIGHT = 0.06  # of a fragment that says where the surface behind the front is


def blend_fragments(sums: Float[Array, "*tiles rows pixels"]) -> Float[Array, "*tiles rows pixels"]:
    r"""Blend the fragments of each pixel, `c(f) = sum_i w_i c_i / sum_i w_i` (Eq. 1); 0 where there is none.

    **Arguments:** `sums`: of `w_i c_i`, one row each; the last row is of the weights `w_i` themselves, and is kept.

    **Source:** Kim et al. 2010, Eq. 1.
    """
    weight_sum = sums[..., -1:, :]
    covered = weight_sum != 0  # it is never negative, and NaN must stay
    blended = jnp.where(covered, sums[..., :-1, :] / jnp.where(covered, weight_sum, 1.0), 0.0)
    return jnp.concatenate([blended, weight_sum], axis=-2)


class Blended(eqx.Module):
    """Fragments blended per pixel (Eq. 1): those of the front surface, and of the surface behind it where the front leaves a gap.

    One row per attribute, then the nearness of the ray's hits with the fragments' planes, then the sum of the weights.
    """

    front: Float[Array, "rows height width"]
    behind: Float[Array, "rows height width"]
    needed: Float[Array, ""]
    """The largest of needed over planned capacity; above 1 all is NaN."""


class AbstractRasterizer(eqx.Module):
    r"""Passes 2 and 3. Fragments are weighted with `fragment_weight`, times the opacity of their footprint.

    The *front* of a pixel are the fragments within epsilon of the nearest one (3.1). *Behind* are, in pixels that the front
    does not cover in full, the fragments within epsilon of the nearest one that is not in front and weighs at least 0.06: the
    rims of splats that are seen nearly edge on do not hide the surface behind them. Where none does, the nearest one counts.
    The choice of fragments is piecewise constant: it has no derivative.
    """

    @abc.abstractmethod
    def planned(self, splats: Splats, views: Sequence[AbstractView], settings: SplattingSettings) -> "AbstractRasterizer":
        """Give a rasterizer with room for these splats in each of these views, all of one size. Not for traced arrays."""

    @abc.abstractmethod
    def blended(
        self, splats: Splats, attributes: Float[Array, "attributes splats"], view: AbstractView, settings: SplattingSettings
    ) -> Blended:
        """Blend attributes and nearness over the fragments of every pixel."""
