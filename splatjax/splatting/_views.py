"""What a view is: a projection of splats onto pixels."""

import abc

import equinox as eqx
from jaxtyping import Array, Bool, Float

from splatjax.scene import Splats

from ._footprints import Footprints, SplattingSettings

MARGIN = 8.0
"""Pixels around the picture; the screen filter reaches beyond a sphere."""


class AbstractView(eqx.Module):
    """A projection of the world onto pixels."""

    width: eqx.AbstractVar[int]
    height: eqx.AbstractVar[int]

    @abc.abstractmethod
    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        """Project splats. Splats that face away or are seen edge on, or lie before the near plane,
        are not visible.
        """

    @abc.abstractmethod
    def may_see(self, splats: Splats) -> Bool[Array, " splats"]:
        """Mark the splats that face the eye and whose spheres touch the picture: cheap, and never
        too few.
        """

    @staticmethod
    @abc.abstractmethod
    def inside(nearness: Float[Array, "..."], quadric: Float[Array, "..."]) -> Bool[Array, "..."]:
        """Test whether a fragment lies within the rim."""

    @staticmethod
    @abc.abstractmethod
    def squared_radius(
        nearness: Float[Array, "..."], quadric: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Compute `rho^2`, in units of the splat's radius, for a fragment inside."""

    @staticmethod
    @abc.abstractmethod
    def squared_radius_vjp(
        nearness: Float[Array, "..."],
        squared_radius: Float[Array, "..."],
        cotangent: Float[Array, "..."],
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Compute the cotangents of nearness and quadric for one of `rho^2`."""

    @staticmethod
    @abc.abstractmethod
    def shifted(nearness: Float[Array, "..."], shift: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute the nearness of a fragment moved away from the eye by epsilon."""

    @staticmethod
    @abc.abstractmethod
    def depth(nearness: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute the depth (mm along the forward axis) of a nearness."""

    @abc.abstractmethod
    def project(self, points: Float[Array, "3 *points"]) -> tuple[Float[Array, "*points"], ...]:
        """Compute column, row (pixels) and depth (mm) of points."""

    @abc.abstractmethod
    def slant(
        self,
        x: Float[Array, "*points"],
        y: Float[Array, "*points"],
        depth: Float[Array, "*points"],
        normals: Float[Array, "3 *points"],
    ) -> tuple[Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"]]:
        """Compute, for planes at projected points, two numbers and a third whose quotients are the
        depth's slope, mm per pixel.

        The third is the cosine-like factor that vanishes where a plane is seen edge on."""

    @abc.abstractmethod
    def unproject(
        self, x: Float[Array, "*points"], y: Float[Array, "*points"], depth: Float[Array, "*points"]
    ) -> Float[Array, "3 *points"]:
        """Compute the point in the world at a depth under a pixel."""


def rows(
    matrix: Float[Array, "3 3"], vectors: Float[Array, "3 splats"]
) -> tuple[Float[Array, " splats"], ...]:
    """Multiply by a matrix, as three planes."""
    x, y, z = vectors
    return tuple(matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z for i in range(3))
