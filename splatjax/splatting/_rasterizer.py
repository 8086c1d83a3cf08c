"""Rasterizers: the weight of a fragment (Eq. 1), and sums of attributes over the front surface and
the one right behind it.
"""

import abc
import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatjax._combination import DeviceMesh
from splatjax._smooth import smooth_step
from splatjax.scene import Splats

from ._grid import TileGrid
from ._views import CLOSED, AbstractView, SplattingSettings

_AT_RIM = math.exp(-4.0)


def fragment_weight(squared_radius: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Compute the Gaussian weight of a fragment in object space, `exp(-4 rho^2)`, tapered at the
    rim.

    Its tangent at the rim is subtracted, `exp(-4 q) - exp(-4) (5 - 4 q)` with `q = rho^2`, so that
    value and derivative are zero there, and the weight is positive inside.

    **Arguments:** `squared_radius`: `rho^2` in units of the splat's radius, in [0, 1].
    Differentiable.

    **Returns:** 0.908 at the center, 0 at the rim.
    """
    return jnp.exp(-4 * squared_radius) - _AT_RIM * (5 - 4 * squared_radius)


def fragment_weight_derivative(
    squared_radius: Float[Array, "..."], weight: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Compute the derivative of `fragment_weight` in `rho^2`, from the weight itself."""
    return -4 * weight - 16 * _AT_RIM * (1 - squared_radius)


# The root of weight / (1 - rho^2)^2 as a polynomial, highest power first: the weight is within
# 6e-7.
_ROOT = (
    0.00836205691,
    -0.0539352847,
    0.188329054,
    -0.469631159,
    0.863365958,
    -1.10681572,
    0.95311135,
)


def fast_fragment_weight(squared_radius: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute `fragment_weight`, exactly 0 at the rim; in float32 by a polynomial, which costs a
    third of the exponential.
    """
    if squared_radius.dtype != jnp.float32:
        return jnp.where(squared_radius < 1, fragment_weight(squared_radius), 0.0)
    root = jnp.polyval(jnp.asarray(_ROOT, jnp.float32), squared_radius) * (1 - squared_radius)
    return root * root


def coverage(
    weight_sum: Float[Array, "..."], full: float | Float[Array, "..."] = CLOSED
) -> Float[Array, "..."]:
    """Compute the fraction of a pixel that a surface covers: a smooth step of the sum of its
    weights, 1 from `full` on.
    """
    return smooth_step(weight_sum, 0, full)


def may_show_behind(
    weights: Float[Array, "tiles pixels"], grid: TileGrid, hidden_from: Float[Array, ""]
) -> Bool[Array, "tiles pixels"]:
    """Mark the pixels in which the surface behind may be seen, by the weight sums of the front. In
    a tile with a pixel that the front leaves open, and in the tiles around it (which contain all
    pixels beside the background), these are the sums below `hidden_from`; elsewhere, below
    `CLOSED`.
    """
    has_open = jnp.any(weights < CLOSED, axis=1).reshape(grid.down, grid.across)
    near = lax.reduce_window(has_open, False, lax.bitwise_or, (3, 3), (1, 1), "SAME").reshape(-1)
    return weights < jnp.where(near, hidden_from, CLOSED)[:, None]


LEAST_WEIGHT = 0.06  # of a fragment that decides where the surface behind the front is


def least_weight(
    view_class: type[AbstractView],
    a: Float[Array, "*splats"],
    b: Float[Array, "*splats"],
    c: Float[Array, "*splats"],
    nearness: Float[Array, "*splats"],
    filter_radius: float,
) -> Float[Array, "*splats"]:
    """Compute `LEAST_WEIGHT`, reduced for splats smaller than a pixel as the filter reduces their
    weight.
    """
    # Disc and filter together have axes whose squares add up to r^2 (1 + cos^2) + 2 f^2.
    determinant = (a * c - 0.25 * b * b) * view_class.squared_radius(nearness, jnp.ones_like(a))
    axes = (a + c) / jnp.where(determinant > 0, determinant, 1.0)
    # In float32 the determinant may vanish, for splats much larger than a pixel.
    return LEAST_WEIGHT * jnp.where(
        determinant > 0, jnp.clip(axes - 2 * filter_radius**2, 0, 1), 1.0
    )


class SurfaceCapacity(eqx.Module):
    """Capacity for tiles of the front, and of the surface behind it. Static."""

    front: int = eqx.field(static=True)
    behind: int = eqx.field(static=True)


class PixelSums(eqx.Module):
    """Sums over the fragments of pixels; 0 without fragments, and beyond the picture.

    **Attributes:**

    - `rows`: sums of weights times attributes, followed by sums of weights times the nearness of
      the ray's hits with the planes of the splats.
    - `weights`: sums of weights.
    """

    rows: Float[Array, "places rows pixels"]
    weights: Float[Array, "places pixels"]


class FragmentSums(eqx.Module):
    """Sums over the fragments of the pixels of some tiles.

    **Attributes:**

    - `tiles`: the tile at each place, first of the front, then of the surface behind; the number of
      tiles in an empty place.
    - `sums`: the sums of each place.
    - `needed`: needed capacity divided by planned capacity; above 1 the sums are incomplete.
    - `front`: the number of places of the front. Static.
    """

    tiles: Int[Array, " places"]
    sums: PixelSums
    needed: Float[Array, ""]
    front: int = eqx.field(static=True)


def invalid_factor(needed: Float[Array, ""]) -> Float[Array, ""]:
    """Compute the factor on results of sums: 1, or NaN if the plan did not suffice."""
    return jnp.where(needed <= 1, 1.0, jnp.nan).astype(needed.dtype)


class AbstractRasterPlan(eqx.Module):
    """A rasterizer with its planned capacity."""

    def choose(
        self, splats: Splats, view: AbstractView
    ) -> tuple[Int[Array, " chosen"], Float[Array, ""]]:
        """List the splats that a view may see, in order, padded by the number of splats. Also
        compute the needed capacity divided by the planned capacity.
        """
        every = jnp.arange(splats.count, dtype=jnp.int32)
        return every, jnp.zeros((), splats.centers.dtype)

    @abc.abstractmethod
    def sum_fragments(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
        combination: DeviceMesh,
    ) -> FragmentSums:
        r"""Sum attributes and nearness over the fragments of every pixel (passes 2 and 3).

        Fragments are weighted with `fragment_weight`, times the opacity of their footprint. The
        *front* of a pixel are the fragments nearer than `min_i (depth_i + epsilon_i)` (3.1).
        The surface *behind* is computed in pixels that the front does not cover in full: of the
        remaining fragments, those nearer than the same minimum over the remaining fragments of a
        weight of at least 0.06 (less for splats smaller than a pixel, `least_weight`), so that the
        rims of splats seen nearly edge on do not hide the surface behind them. If no fragment has
        that weight, the minimum is over all that remain.

        The choice of fragments is piecewise constant: it has no derivative.

        **Arguments:**

        - `splats`, `attributes`: the splats of this device, at least one, and their attributes.
          Differentiable.
        - `combination`: combines the parts of the splats of several devices.

        **Returns:** the sums over the splats of this device.
        """

    def fitted(
        self,
        splats: Splats,
        views: Sequence[AbstractView],
        settings: SplattingSettings,
        devices: int = 1,
    ) -> "AbstractRasterPlan":
        """Return a plan with the capacity for the surface behind reduced to the need of these
        views of all splats, with some to spare. With many attributes it is most of the memory. Not
        for traced arrays.
        """
        return self


class AbstractRasterizer(eqx.Module):
    """An implementation of passes 2 and 3, and of the depths of pass 1; a setting."""

    @abc.abstractmethod
    def make_plan(
        self,
        parts: Sequence[Splats],
        views: Sequence[AbstractView],
        settings: SplattingSettings,
    ) -> AbstractRasterPlan:
        """Compute the capacity for these splats in each of these views. Not for traced arrays.

        **Arguments:**

        - `parts`: parts of one size; one for each device.
        - `views`: views of one size.
        """

    def for_shadows(self) -> "AbstractRasterizer":
        """Return the rasterizer of the shadow maps: itself, unless it supports only pictures."""
        return self
