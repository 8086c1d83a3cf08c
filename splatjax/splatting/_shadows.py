"""Pass 1: shadow maps, and the fraction of a light that reaches each splat."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import AT_ONCE, jit_unless_traced, map_chunks, rounded_up
from splatjax._combination import DeviceMesh, extreme
from splatjax._records import record, valid
from splatjax._smooth import smooth_step
from splatjax.scene import Splats, rotation_towards

from ._grid import TILE_SIDE, TileGrid
from ._groups import MERGED_COUNTS
from ._projections import OrthographicView, PerspectiveView
from ._rasterizer import AbstractRasterPlan, FragmentSums, coverage, invalid_factor
from ._surfaces import Surface
from ._views import CLOSED, AbstractView, SplattingSettings

# The weight sum that covers a pixel of a map. Discs extend beyond an open edge; a larger sum than
# in pictures makes its shadow extend less. Evenly spread splats always exceed a sum of 1.
_COVERED = 2 * CLOSED
_LEAST_RESOLUTION = 64
_AT_LEAST_8 = valid("at least 8 (pixels)", lambda n: n >= 8)
_COMPARED = valid("2 or 3 (pixels)", lambda n: (n == 2) | (n == 3))
_NOT_NEGATIVE = valid("at least 0", lambda x: x >= 0)
_POSITIVE = valid("positive", lambda x: x > 0)
_NEAR = 1e-2  # mm: nearer, a splat is so large in pixels that float32 overflows


@record
class ShadowSettings(eqx.Module):
    r"""Settings of shadow maps and of the comparison with them. All are static except `filled`.

    For sharper edges, raise `resolution` and `pixels_per_spacing`; for shadows closer to a contact,
    lower `bias` and `softness`; if a surface shadows itself, raise `bias`.

    **Attributes:**

    - `resolution`: largest number of pixels along a side of each map.
    - `pixels_per_spacing`: largest number of pixels of the map per spacing of the splats; a finer
      map would show single discs instead of the body. `inf` for the full resolution. The size is
      rounded up to one of two sizes per octave, and is at least 64.
    - `bias`: a splat that faces the light is compared with the map at this distance along its
      normal, so that no surface shadows itself. The unit is `sqrt(radius^2 + diagonal^2)`, with the
      radius of the splat, or merged disc, and the diagonal of a pixel of the map at its depth.
    - `softness`: behind the surface of the map, the light fades to 0 over this distance, in the
      same unit, so that shadows have gradients. Across their edges it fades over about two pixels.
    - `compared`: a splat is compared with 2 x 2 or 3 x 3 pixels of the map.
    - `merged_spacing`: largest spacing of discs that replace 8, 16 or 32 neighboring splats each,
      in pixels of the map; 0 merges no splats.
    - `largest_slope`: the slope up to which the receiver's plane is continued from pixel to pixel
      of the map. On heads, 4 leaves steps at grazing light, and more than 8 has no effect.
    - `filled`: side, in pixels, of the part of the map that shows the body. `None` to derive it.
    """

    resolution: int = eqx.field(static=True, default=1024, metadata=_AT_LEAST_8)
    bias: float = eqx.field(static=True, default=0.2, metadata=_NOT_NEGATIVE)
    softness: float = eqx.field(static=True, default=0.4, metadata=_POSITIVE)
    largest_slope: float = eqx.field(static=True, default=8.0, metadata=_POSITIVE)
    compared: int = eqx.field(static=True, default=3, metadata=_COMPARED)
    merged_spacing: float = eqx.field(static=True, default=0.0, metadata=_NOT_NEGATIVE)
    pixels_per_spacing: float = eqx.field(
        static=True,
        default=4.0,
        metadata=valid("positive; inf for the full resolution", lambda x: x > 0, finite=False),
    )
    filled: float | Float[Array, ""] | None = eqx.field(default=None, metadata=_POSITIVE)

    @property
    def side(self) -> int | float | Float[Array, ""]:
        """The pixels along a side of the part of the map that shows the body."""
        return self.resolution if self.filled is None else self.filled

    def for_spacing(self, spacing: float, bounds: "Bounds") -> "ShadowSettings":
        """Return the settings with the resolution for a spacing of the splats, mm: a power of 2, or
        the given one if smaller, for which other bodies share a program. Not for traced arrays.
        """
        if self.filled is not None:
            return self
        across = self.pixels_per_spacing * 2 * float(bounds.radius)
        pixels = int(min(across / spacing, self.resolution)) if spacing else self.resolution
        filled = rounded_up(max(pixels, 1), _LEAST_RESOLUTION, per_octave=2)
        filled = np.asarray(min(filled, self.resolution), bounds.radius.dtype)
        size = min(1 << (int(filled) - 1).bit_length(), self.resolution)
        return dataclasses.replace(self, resolution=size, filled=jax.device_put(filled))

    def splats_per_disc(self, spacing: float, bounds: "Bounds") -> int:
        """Return the number of splats in each merged disc. Not for traced arrays."""
        largest = self.merged_spacing * 2 * float(bounds.radius) / float(self.side)
        return max((n for n in MERGED_COUNTS if n**0.5 * spacing <= largest), default=1)


class Bounds(eqx.Module):
    """A sphere around all discs. It determines the shadow maps, and is differentiated with them."""

    center: Float[Array, "3"]
    radius: Float[Array, ""]

    @classmethod
    @jit_unless_traced
    def of(cls, splats: Splats, combination: DeviceMesh) -> "Bounds":
        """Enclose the splats of all parts. Splats without a radius are padding and do not count."""
        exists = splats.radii > 0
        high, low = (
            sign * extreme(jnp.where(exists[:, None], sign * splats.centers, -jnp.inf), combination)
            for sign in (1, -1)
        )
        center = 0.5 * (low + high)
        offset = splats.centers - center[None]
        squared = jnp.sum(offset * offset, axis=1)
        squared = extreme(jnp.where(exists, squared, -jnp.inf), combination)
        apart = squared > 0  # a single splat lies in its center, wherever it moves
        reach = jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)
        radius = reach + extreme(splats.radii, combination)
        empty = combination.largest([jnp.any(exists).astype(radius.dtype)]) == 0
        return cls(jnp.where(empty, 0.0, center), jnp.where(empty, 1.0, radius))


def _rotation_towards(forward: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Build a rotation whose third row is `forward`; the other two are smooth in it, except where
    `|forward_y|` is 0.9.
    """
    up = jnp.where(
        jnp.abs(jax.lax.stop_gradient(forward[1])) < 0.9,
        jnp.asarray([0.0, 1.0, 0.0], forward.dtype),
        jnp.asarray([1.0, 0.0, 0.0], forward.dtype),
    )
    return rotation_towards(forward, up)


@jit_unless_traced
def distant_view(
    direction: Float[Array, "3"], bounds: Bounds, settings: ShadowSettings
) -> OrthographicView:
    """Make the view of a directional light: the bounding sphere in parallel projection."""
    return OrthographicView(
        position=bounds.center,
        rotation=_rotation_towards(direction / jnp.linalg.norm(direction)),
        scale=0.5 * (settings.side - 4) / bounds.radius,
        width=settings.resolution,
        height=settings.resolution,
    )


@jit_unless_traced
def near_view(
    position: Float[Array, "3"], bounds: Bounds, settings: ShadowSettings
) -> PerspectiveView:
    """Make the view of a point light outside the bounding sphere: a frustum around the sphere."""
    to_center = bounds.center - position
    distance = jnp.linalg.norm(to_center)
    closest = distance * distance - bounds.radius * bounds.radius
    tangent = bounds.radius / jnp.sqrt(jnp.maximum(closest, 1e-6 * bounds.radius * bounds.radius))
    size = settings.resolution
    return PerspectiveView(
        position=position,
        rotation=_rotation_towards(to_center / distance),
        focal_length=0.5 * (settings.side - 4) / tangent,
        width=size,
        height=size,
        near=_NEAR,
    )


def cube_views(position: Float[Array, "3"], settings: ShadowSettings) -> list[PerspectiveView]:
    """Make the views of a point light inside the bounding sphere: six faces of a cube."""
    size, dtype = settings.resolution, position.dtype
    # Two pixels beyond each edge, for the filter.
    focal_length = jnp.asarray(0.5 * (settings.side - 4), dtype)
    return [
        PerspectiveView(
            position=position,
            rotation=_rotation_towards(axis),
            focal_length=focal_length,
            width=size,
            height=size,
            near=_NEAR,
        )
        for axis in jnp.concatenate([jnp.eye(3, dtype=dtype), -jnp.eye(3, dtype=dtype)])
    ]


def in_cube_face(view: AbstractView, points: Float[Array, "3 splats"]) -> Float[Array, " splats"]:
    """Return 1 for the points that belong to a face of the cube, those whose largest coordinate is
    along its axis, and 0 for others. A point between faces belongs to each of them in equal parts.
    """
    offset = points - view.position[:, None]
    along, away = jnp.tensordot(view.rotation[2], offset, 1), jnp.abs(offset)
    largest = jnp.max(away, axis=0) * (1 - 1e-6)
    faces = jnp.sum(away >= largest[None], axis=0).astype(points.dtype)
    return jnp.where(along >= largest, 1 / faces, 0.0)


class ShadowMap(eqx.Module):
    """Depth (mm) and coverage of the front surface and of the one behind it, `[tiles, pixels]`.

    **Attributes:**

    - `splats_per_disc`: the number of splats of each disc. Static.
    """

    view: AbstractView
    planes: Float[Array, "4 tiles pixels"]
    needed: Float[Array, ""]
    splats_per_disc: int = eqx.field(static=True, default=1)

    @classmethod
    def of(cls, sums: FragmentSums, view: AbstractView, splats_per_disc: int = 1) -> "ShadowMap":
        """Blend the sums of all parts."""
        surface = Surface.of(sums.sums, view, sums.needed)
        covered = coverage(sums.sums.weights, _COVERED)
        of_places = jnp.stack([surface.depth, covered])
        empty = jnp.zeros((2, TileGrid(view.width, view.height).count, TILE_SIDE**2), covered.dtype)
        planes = [
            empty.at[:, sums.tiles[places]].set(of_places[:, places], mode="drop")
            for places in (slice(sums.front), slice(sums.front, None))
        ]
        planes = invalid_factor(sums.needed) * jnp.concatenate(planes)
        return cls(view, planes, sums.needed, splats_per_disc)


def make_shadow_map(
    splats: Splats,
    view: AbstractView,
    splatting: SplattingSettings,
    plan: AbstractRasterPlan,
    combination: DeviceMesh,
    splats_per_disc: int = 1,
) -> ShadowMap:
    """Render a shadow map (4.1): the surfaces visible from a light, by passes 2 and 3 of the
    camera.

    **Arguments:**

    - `splats`: splats, or discs of merged splats (`merge_splats`).
    """
    chosen, needed = plan.choose(splats, view)
    no_rows = jnp.zeros((0, len(chosen)), splats.centers.dtype)
    splatting = dataclasses.replace(splatting, full_coverage=_COVERED)
    sums = plan.sum_fragments(splats.take(chosen), no_rows, view, splatting, combination)
    needed = combination.largest([jnp.maximum(needed, sums.needed)])
    total = combination.total([sums.sums])
    sums = eqx.tree_at(lambda sums: (sums.sums, sums.needed), sums, (total, needed))
    return ShadowMap.of(sums, view, splats_per_disc)


def _spline(away: Float[Array, "pixels ..."]) -> Float[Array, "pixels ..."]:
    """Compute the weights of two pixels by a linear B-spline or of three by a quadratic one; `away`
    is their distance from the middle, in pixels.
    """
    if len(away) == 2:
        return 1 - jnp.abs(away)
    sides, middle = 0.5 * (1.5 - jnp.abs(away[::2])) ** 2, 0.75 - away[1] ** 2
    return jnp.stack([sides[0], middle, sides[1]])


def compute_visibility(
    splats: Splats, shadow_map: ShadowMap, settings: ShadowSettings
) -> Float[Array, " splats"]:
    r"""Compute the fraction of a light that reaches each splat, by comparison with its shadow map.

    Nine pixels, or four, are compared and averaged with a spline; at each, the splat's depth is
    continued along its own plane. The front surface blocks light with its coverage, and the one
    behind it with the remaining coverage.

    **Returns:** in [0, 1]; 1 outside the map. Differentiable in the splats, the view and the map.
    """
    view, flat = shadow_map.view, shadow_map.planes.reshape(4, -1)

    def land(centers, normals, radii):
        x, y, depth = view.project(centers.T)
        reach = jnp.sqrt(shadow_map.splats_per_disc * radii**2 + 2 * view.pixel_size(depth) ** 2)
        across, down, facing = view.depth_slope(x, y, depth, normals.T)
        # Splats that face away from the light stay in the shadow of those that face it.
        bias = settings.bias * reach * jnp.clip(1 + settings.largest_slope * facing, 0, 1)
        x, y, depth = view.project(centers.T + bias[None] * normals.T)
        facing = jnp.maximum(facing, 1 / settings.largest_slope)
        return x, y, depth, across / facing, down / facing, reach

    # The projected positions are stored: each comparison, and each derivative, reads them.
    landed = map_chunks(land, splats.centers, splats.normals, splats.radii)
    # Few large parts, because each adds into an array as large as the map in the backward pass.
    return map_chunks(
        lambda *part: _compared(part, view, flat, settings), *landed, at_once=4 * AT_ONCE
    )


def _compared(
    landed: tuple[Float[Array, " splats"], ...],
    view: AbstractView,
    flat: Float[Array, "4 pixels"],
    settings: ShadowSettings,
) -> Float[Array, " splats"]:
    """Compare with depth and coverage of both surfaces of a map."""
    x, y, depth, slope_x, slope_y, reach = landed
    half = (settings.compared - 1) / 2
    column, row = (jnp.floor(jax.lax.stop_gradient(coordinate) - half) for coordinate in (x, y))
    # Pixels around each splat, side by side: [across, down, splats].
    step = jnp.arange(settings.compared, dtype=jnp.int32)[:, None]
    at_x, at_y = (
        (column.astype(jnp.int32)[None] + step)[:, None],
        (row.astype(jnp.int32)[None] + step)[None],
    )
    index = TileGrid(view.width, view.height).pixel(
        jnp.clip(at_x, 0, view.width - 1), jnp.clip(at_y, 0, view.height - 1)
    )
    inside = (at_x >= 0) & (at_y >= 0) & (at_x < view.width) & (at_y < view.height)
    middle = step.astype(x.dtype) + 0.5
    away_x, away_y = (column - x)[None] + middle, (row - y)[None] + middle
    expected = (
        depth[None, None] + (slope_x[None] * away_x)[:, None] + (slope_y[None] * away_y)[None]
    )

    def hidden(map_depth, map_coverage):
        beyond = (expected - map_depth) / reach[None, None]
        return map_coverage * smooth_step(beyond, 0, settings.softness)

    front_depth, front_coverage, behind_depth, behind_coverage = (
        plane.at[index].get(mode="promise_in_bounds") for plane in flat
    )
    behind = (1 - front_coverage) * hidden(behind_depth, behind_coverage)
    blocked = hidden(front_depth, front_coverage) + behind
    weights = _spline(away_x)[:, None] * _spline(away_y)[None]
    blocked = jnp.sum(weights * jnp.where(inside, blocked, 0.0), axis=(0, 1))
    return jnp.maximum(1 - blocked, 0)  # rounding must not make light negative
