"""What a rasterizer does, whichever way: weighted sums over the front surface and over what lies right behind it."""

import abc
from collections.abc import Sequence

import equinox as eqx
from jaxtyping import Array, Float

from ._settings import SplattingSettings
from ._views import AbstractView, Footprints


class SurfaceSums(eqx.Module):
    """Sums of weighted fragments per pixel: over the front surface, and over the surface behind it where the front leaves a gap.

    One row per attribute, then the nearness of the ray's hits with the fragments' planes, then the weights themselves.
    """

    front: Float[Array, "rows height width"]
    behind: Float[Array, "rows height width"]
    needed: Float[Array, ""]
    """The largest of needed over planned capacity; above 1 the sums are NaN."""


class AbstractRasterizer(eqx.Module):
    r"""Passes 2 and 3. Fragments are weighted with `fragment_weight`, times the opacity of their footprint.

    The *front* of a pixel are the fragments within epsilon of the nearest one (3.1). *Behind* are, in pixels that the front
    does not cover in full, the fragments within epsilon of the nearest one that is not in front.
    The choice of fragments is piecewise constant: it has no derivative.
    """

    @abc.abstractmethod
    def planned(self, footprints: Sequence[Footprints], view: AbstractView) -> "AbstractRasterizer":
        """Give a rasterizer with room for each of these sets of footprints in views of this size. Not for traced arrays."""

    @abc.abstractmethod
    def sums(
        self, footprints: Footprints, attributes: Float[Array, "attributes splats"], view: AbstractView, settings: SplattingSettings
    ) -> SurfaceSums:
        """Sum weighted attributes, nearness and weights over the fragments of every pixel."""
