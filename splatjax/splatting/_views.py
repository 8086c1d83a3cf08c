"""A splat is a disc. In the picture its rim is an ellipse, and a fragment of it is described by
numbers that are polynomials in the offset `d` (pixels) from the projected center:

    nearness  e(d)  = nearness + slope . d          1 / z in perspective, -z without
    quadric   n(d)  = a dx^2 + b dx dy + c dy^2
    rho^2           = n / e^2 in perspective, n without: 1 on the rim

so that the surface in front has the largest nearness and no fragment needs a square root.
"""

import abc
import dataclasses
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax._records import record, valid
from splatjax.scene import Splats

from ._grid import TileGrid, TileRanges

# Cosine to the line of sight, below which float32 cannot determine the visible side of a splat.
EDGE_ON = 1e-5
_SLOPE_FILTER = 0.25  # pixels; see `widen_ellipse`
# The weight sum that covers a pixel inside a surface. Splats whose radius is 1.5 times the root of
# their area, scattered at random, have at least 0.2 inside a closed surface.
CLOSED = 0.15
# Unevenness of even and of scattered splats, and the fraction of their mean weight sum that covers
# a pixel.
_UNEVENNESS, _FRACTIONS = (0.1, 0.35), (0.9, 0.11)
_MEAN_WEIGHT = (1 - 13 * math.exp(-4)) / 4  # `fragment_weight` over a disc


@record
class SplattingSettings(eqx.Module):
    r"""Settings of the surface that splats form. Static, but for the last.

    **Attributes:**

    - `filter_radius`: radius of the screen filter, pixels, positive. At the root of 2, the sum of a
      small splat's weights over the pixels is independent of its position between them, to 4%.
    - `epsilon_z`: fragments within this many radii behind the front belong to it (3.1).
    - `largest_slope`: slanted splats have epsilon lengthened by `1 / cos`, up to this factor.
    - `full_coverage`: weight sum from which on a surface covers a pixel beside the background,
      positive. `None` to derive it from the splats (`measured`).
    """

    filter_radius: float = eqx.field(
        static=True, default=2**0.5, metadata=valid("positive (pixels)", lambda x: x > 0)
    )
    epsilon_z: float = eqx.field(
        static=True, default=1.5, metadata=valid("positive (radii)", lambda x: x > 0)
    )
    largest_slope: float = eqx.field(
        static=True, default=3.0, metadata=valid("at least 1", lambda x: x >= 1)
    )
    full_coverage: float | Float[Array, ""] | None = eqx.field(
        default=None, metadata=valid("positive", lambda x: x > 0)
    )

    @property
    def covered_from(self) -> float | Float[Array, ""]:
        """The value of `full_coverage`; it must be known."""
        if self.full_coverage is None:
            raise ValueError(
                "full_coverage depends on the splats; call settings.measured(unevenness, discs)"
            )
        return self.full_coverage

    @property
    def hidden_from(self) -> Float[Array, ""]:
        """The weight sum of a front from which on nothing is seen behind it, beside the background
        too.
        """
        return jnp.maximum(jnp.asarray(self.covered_from), CLOSED)

    def measured(
        self, unevenness: Float[Array, ""], discs: Float[Array, ""]
    ) -> "SplattingSettings":
        """Return these settings with a value for `full_coverage`: a fraction of the mean weight
        sum inside a surface of such splats.

        The fraction is nine tenths where splats are spread evenly: the sum falls to a half at an
        outline, and the step then covers half the pixel. The more the sum varies inside the
        surface, the less the fraction.

        **Arguments:**

        - `unevenness`: see `splatjax.diffusion.unevenness`.
        - `discs`: the sum of the squared radii of all splats divided by the sum of their areas.
        """
        if self.full_coverage is not None:
            return self
        known = (jnp.asarray(values, unevenness.dtype) for values in (_UNEVENNESS, _FRACTIONS))
        fraction = jnp.interp(unevenness, *known)
        full = fraction * _MEAN_WEIGHT * math.pi * discs
        return dataclasses.replace(self, full_coverage=full)


class Footprints(eqx.Module):
    """The projected splats, one array per number. Pixels, origin top left, unless stated otherwise.

    **Attributes:**

    - `shift`: moves the surface away by epsilon (3.1): a factor on nearness in perspective,
      subtracted from it in an orthographic view. Not differentiated.
    - `opacity`: the fraction of the peak weight after the screen filter: 1 for large frontal
      splats, 0 edge on.
    - `box`: left, right, top and bottom of the rim. Not differentiated.
    """

    x: Float[Array, " splats"]
    y: Float[Array, " splats"]
    slope_x: Float[Array, " splats"]
    slope_y: Float[Array, " splats"]
    a: Float[Array, " splats"]
    b: Float[Array, " splats"]
    c: Float[Array, " splats"]
    nearness: Float[Array, " splats"]
    shift: Float[Array, " splats"]
    opacity: Float[Array, " splats"]
    box: tuple[Float[Array, " splats"], ...]
    visible: Bool[Array, " splats"]

    def ranges(self, grid: TileGrid) -> TileRanges:
        """Find the tiles that each splat may touch."""
        return TileRanges.of(self.box, self.visible, grid)


def widen_ellipse(
    xx: Float[Array, " splats"],
    xy: Float[Array, " splats"],
    yy: Float[Array, " splats"],
    *,
    root_determinant: Float[Array, " splats"],
    det_slope: tuple[Float[Array, " splats"], ...],
    s_slope: tuple[Float[Array, " splats"], ...],
    filter_radius: float,
) -> tuple[tuple[Array, Array, Array], tuple[Array, ...], tuple[Array, Array], Array]:
    """Widen the ellipse `d^T S^-1 d = 1`, with `S = [[xx, xy], [xy, yy]]`, by the screen filter.

    The slope of the splat's plane is given as `det_slope`, which is `det S` times the slope, and
    `s_slope`, which is `S` times the slope. The slope itself is infinite edge on; a quarter of a
    pixel is therefore added to `S` before dividing by it. For splats wider than a pixel, hits stay
    on the plane. No terms cancel, so float32 suffices for every slant.

    **Returns:** the numbers a, b, c of `a dx^2 + b dx dy + c dy^2`, which is 1 on the ellipse; the
    slope of the plane along x and y, in the unit of the slopes that were given; xx and yy, the
    squares of half the width and half the height; and the product of the half axes.
    """
    determinant, trace, fine = root_determinant * root_determinant, xx + yy, _SLOPE_FILTER**2
    slanted = determinant + fine * (trace + fine)
    slopes = zip(det_slope, s_slope, strict=True)
    # The filter adds f^2 I: xy is unchanged.
    wide = filter_radius**2
    determinant = determinant + wide * (trace + wide)
    xx, yy = xx + wide, yy + wide
    return (
        (yy / determinant, -2 * xy / determinant, xx / determinant),
        tuple((of_det + fine * of_s) / slanted for of_det, of_s in slopes),
        (xx, yy),
        jnp.sqrt(determinant),
    )


def epsilon_of(radii, filter_radius, cosine, settings: SplattingSettings):
    """Compute the depth (mm) within which fragments belong to one surface: in radii, more on
    slanted splats.
    """
    reach = jnp.sqrt(radii * radii + filter_radius * filter_radius)
    return settings.epsilon_z * reach / jnp.maximum(cosine, 1 / settings.largest_slope)


MARGIN = 8.0  # pixels around the picture; the screen filter reaches beyond a sphere


class AbstractView(eqx.Module):
    """A projection of the world onto pixels.

    **Attributes:**

    - `position`: mm.
    - `rotation`: world to view; its rows are the right, down and forward axes.
    """

    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]
    width: eqx.AbstractVar[int]
    height: eqx.AbstractVar[int]

    @abc.abstractmethod
    def footprints(self, splats: Splats, settings: SplattingSettings) -> Footprints:
        """Project splats. Splats that face away, are edge on, or are before the near plane are not
        visible.
        """

    @abc.abstractmethod
    def may_see(self, splats: Splats) -> Bool[Array, " splats"]:
        """Mark the splats that face the eye and whose spheres touch the picture: a cheap,
        conservative test.
        """

    @staticmethod
    @abc.abstractmethod
    def inside(nearness: Float[Array, "..."], quadric: Float[Array, "..."]) -> Bool[Array, "..."]:
        """Test whether a fragment is within the rim."""

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

    @property
    def axis_pixel(self) -> tuple[Any, Any]:
        """Return column and row of the forward axis in the picture."""
        return self.width / 2, self.height / 2

    def project(self, points: Float[Array, "3 *points"]) -> tuple[Float[Array, "*points"], ...]:
        """Compute column, row (pixels) and depth (mm) of points."""
        offset = points - self.position.reshape(3, *[1] * (points.ndim - 1))
        x, y, depth = jnp.tensordot(self.rotation, offset, 1)
        mm, (middle_x, middle_y) = self.pixel_size(depth), self.axis_pixel
        return middle_x + x / mm, middle_y + y / mm, depth

    @abc.abstractmethod
    def depth_slope(
        self,
        x: Float[Array, "*points"],
        y: Float[Array, "*points"],
        depth: Float[Array, "*points"],
        normals: Float[Array, "3 *points"],
    ) -> tuple[Float[Array, "*points"], Float[Array, "*points"], Float[Array, "*points"]]:
        """Compute the slope of the depth over the picture, for planes through projected points, as
        numerators and denominator `(across, down, facing)`: `d depth / dx = across / facing`,
        `d depth / dy = down / facing`, mm per pixel.

        `facing` vanishes for a plane seen edge on, so the caller limits it before dividing.
        """

    @abc.abstractmethod
    def pixel_size(self, depth: Float[Array, "*points"]) -> Float[Array, "..."]:
        """Compute the width of a pixel at a depth, mm."""

    @abc.abstractmethod
    def unproject(
        self, x: Float[Array, "*points"], y: Float[Array, "*points"], depth: Float[Array, "*points"]
    ) -> Float[Array, "3 *points"]:
        """Compute the point in the world at a depth under a pixel."""


def rotate(
    rotation: Float[Array, "3 3"], vectors: Float[Array, "3 splats"]
) -> tuple[Float[Array, " splats"], ...]:
    """Rotate vectors; the components are three planes."""
    x, y, z = vectors
    return tuple(rotation[i, 0] * x + rotation[i, 1] * y + rotation[i, 2] * z for i in range(3))
