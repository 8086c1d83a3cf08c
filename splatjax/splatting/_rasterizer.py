"""What a rasterizer does, whichever way: sums attributes over the front surface and over what lies
right behind it.
"""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, DTypeLike, Float

from splatjax.scene import Splats

from ._bins import SIDE
from ._settings import SplattingSettings
from ._views import AbstractView

LEAST_WEIGHT = 0.06  # of a fragment that says where the surface behind the front is


def least_weight(
    view: type[AbstractView],
    a: Float[Array, "*splats"],
    b: Float[Array, "*splats"],
    c: Float[Array, "*splats"],
    nearness: Float[Array, "*splats"],
    filter_radius: float,
) -> Float[Array, "*splats"]:
    """Give `LEAST_WEIGHT`, and in proportion less for splats smaller than a pixel: the filter makes
    them that much fainter.
    """
    # Disc and filter together have axes whose squares add up to r^2 (1 + cos^2) + 2 f^2.
    determinant = (a * c - 0.25 * b * b) * view.squared_radius(nearness, jnp.ones_like(a))
    axes = (a + c) / jnp.where(determinant > 0, determinant, 1.0)
    # In float32 the determinant may vanish, for splats much larger than a pixel.
    return LEAST_WEIGHT * jnp.where(
        determinant > 0, jnp.clip(axes - 2 * filter_radius**2, 0, 1), 1.0
    )


class FragmentSums(eqx.Module):
    """Of the fragments of one surface, per pixel; 0 where there is none, and in what of a tile lies
    beyond the picture.
    """

    attributes: Float[Array, "tiles attributes pixels"]
    """Of weights times attributes."""
    nearness: Float[Array, "tiles pixels"]
    """Of weights times the nearness of the ray's hits with the fragments' planes."""
    weights: Float[Array, "tiles pixels"]

    @classmethod
    def of(cls, rows: Float[Array, "tiles rows pixels"]) -> "FragmentSums":
        """Take one row after the other: attributes, nearness, weights."""
        attributes, nearness, weights = lax.split(rows, [rows.shape[1] - 2, 1, 1], axis=1)
        return cls(attributes, nearness[:, 0], weights[:, 0])

    @classmethod
    def nothing(cls, tiles: int, attributes: int, dtype: DTypeLike) -> "FragmentSums":
        """Give those of no fragment at all."""
        return cls.of(jnp.zeros((tiles, attributes + 2, SIDE**2), dtype))

    def rows(self) -> Float[Array, "tiles rows pixels"]:
        """Give what `of` takes."""
        return jnp.concatenate(
            [self.attributes, self.nearness[:, None], self.weights[:, None]], axis=1
        )


class SummedFragments(eqx.Module):
    """The front surface, and the surface behind it where the front leaves a gap, in the tiles of a
    `TileGrid`.
    """

    front: FragmentSums
    behind: FragmentSums
    needed: Float[Array, ""]
    """The largest of needed over planned capacity; above 1 all is NaN."""


class AbstractRasterizer(eqx.Module):
    r"""Passes 2 and 3. Fragments are weighted with `fragment_weight`, times the opacity of their
    footprint.

    The *front* of a pixel are the fragments within epsilon of the nearest one (3.1). *Behind* are,
    in pixels that the front does not cover in full, the fragments within epsilon of the nearest one
    that is not in front and weighs at least 0.06 (less for splats smaller than a pixel,
    `least_weight`): the rims of splats that are seen nearly edge on do not hide the surface behind
    them. Where none does, the nearest one counts. The choice of fragments is piecewise constant: it
    has no derivative.
    """

    @abc.abstractmethod
    def planned(
        self, splats: Splats, views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "AbstractRasterizer":
        """Give a rasterizer with room for these splats in each of these views, all of one size. Not
        for traced arrays.
        """

    @abc.abstractmethod
    def summed(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> SummedFragments:
        """Sum attributes and nearness over the fragments of every pixel."""

    def for_shadows(self) -> "AbstractRasterizer":
        """Give what draws the shadow maps beside it: itself, unless it is made for pictures
        alone.
        """
        return self
