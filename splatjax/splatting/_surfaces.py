"""Passes 2 and 3: the surface in front, and the one behind it at silhouettes, with blended
attributes (Eq. 1).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import AT_ONCE, zeros_after
from splatjax._combination import DeviceMesh
from splatjax._smooth import smooth_step
from splatjax.scene import Splats

from ._grid import TILE_SIDE, TileGrid
from ._rasterizer import (
    AbstractRasterPlan,
    FragmentSums,
    PixelSums,
    coverage,
    invalid_factor,
)
from ._views import CLOSED, AbstractView, SplattingSettings

TILES_AT_ONCE = AT_ONCE // TILE_SIDE**2  # tiles in a chunk of values computed chunk by chunk
_BESIDE = 2  # pixels; a pixel this near an open one is beside the background
# The distance, in gaps between two surfaces, over which a third one ceases to be the second.
_ALIKE = 0.75, 0.25


def blend_fragments(
    sums: Float[Array, "tiles *rows pixels"], weights: Float[Array, "tiles *#rows pixels"]
) -> Float[Array, "..."]:
    r"""Blend the fragments of each pixel, `c(f) = sum_i w_i c_i / sum_i w_i` (Eq. 1); 0 without
    fragments.

    **Arguments:** `sums`, `weights`: sums of `w_i c_i` and of `w_i`. Differentiable.

    **Source:** Kim et al. 2010, Eq. 1.
    """
    exists = weights != 0  # they are never negative, and NaN must stay
    return sums * jnp.where(exists, 1 / jnp.where(exists, weights, 1.0), 0.0)


def coverages(
    weights: Float[Array, "surfaces tiles pixels"],
    nearness: Float[Array, "surfaces tiles pixels"],
    grid: TileGrid,
    full: float | Float[Array, ""],
) -> Float[Array, "surfaces tiles pixels"]:
    r"""Compute the fraction of each pixel that the front surface covers, and the one behind it.

    Coverage is a smooth step of the sum of weights; the surface behind covers this fraction of the
    part that the front leaves open. Within two pixels of a pixel that both leave open, the step
    ends at `full`, so that outlines are where the body ends. Elsewhere it ends at a sum that
    surfaces reach even in creases and between randomly scattered splats, so nothing shines through.
    At an edge before another surface, within two pixels of which the front recedes to the surface
    behind, the front yields to it what lies beyond the step that ends at `full`.

    **Arguments:** of the front, and of the surface behind it

    - `weights`: sums of weights. Differentiable.
    - `nearness`: blended nearness; 0 without a surface. Differentiable.
    """
    (front, behind), (near, far) = weights, nearness
    open_share = (1 - coverage(front)) * (1 - coverage(behind))
    remoteness = jnp.where(front > 0, -near, -jnp.inf)
    planes = grid.join(jnp.stack([open_share, remoteness], axis=1))
    window = 1, 2 * _BESIDE + 1, 2 * _BESIDE + 1
    planes = jax.lax.reduce_window(planes, -jnp.inf, jax.lax.max, window, (1, 1, 1), "SAME")
    beside, farthest = jnp.moveaxis(grid.cut(planes), 1, 0)
    # How far the front recedes near the pixel, relative to the gap to the surface behind.
    is_apart = (front > 0) & (behind > 0) & (near > far)
    gap = jnp.where(is_apart, near - far, 1.0)
    receded = jnp.where(is_apart, near + farthest, 0.0) / gap
    edge = smooth_step(jnp.abs(receded - 1), *_ALIKE)
    closed = CLOSED + beside * (full - CLOSED)
    of_front, of_behind = coverage(front, closed), coverage(behind, closed)
    yielded = edge * (of_front - coverage(front, full)) * of_behind
    return jnp.stack([of_front - yielded, (1 - of_front) * of_behind + yielded])


class Surface(eqx.Module):
    """The visible surface in the pixels of some tiles: the front one or the one behind it.

    **Attributes:**

    - `attributes`: blended; 0 where there is no surface.
    - `depth`: mm along the view's forward axis; 1 where there is no surface.
    - `covered`: whether there is a surface.
    """

    attributes: Float[Array, "tiles attributes pixels"]
    depth: Float[Array, "tiles pixels"]
    covered: Bool[Array, "tiles pixels"]

    @classmethod
    def of(cls, sums: PixelSums, view: AbstractView, needed: Float[Array, ""]) -> "Surface":
        """Blend sums. If more capacity was needed than planned, values and derivatives are NaN."""
        nearness, weights = sums.rows[:, -1], sums.weights * invalid_factor(needed)
        covered = stop_gradient(weights) > 0
        blended = jnp.where(weights != 0, blend_fragments(nearness, weights), 1.0)
        depth = jnp.where(covered, view.depth(blended), 1.0)
        return cls(blend_fragments(sums.rows[:, :-1], weights[:, None]), depth, covered)


class VisibleSurfaces(eqx.Module):
    """The visible surfaces of a view, in tiles: the one in front, and the one behind it at
    silhouettes.

    **Attributes:**

    - `tiles`: the tile of each place of this device; the number of tiles in an empty place.
    - `in_front`: whether a place belongs to the surface in front, or to the one behind.
    - `sums`: sums over the fragments.
    - `share`: the fraction of its pixel that each surface covers.
    - `needed`: needed capacity divided by planned capacity. Above 1 every picture and its
      derivatives are NaN.
    """

    view: AbstractView
    tiles: Int[Array, " places"]
    in_front: Bool[Array, " places"]
    sums: PixelSums
    share: Float[Array, "places pixels"]
    needed: Float[Array, ""]

    @classmethod
    def of(
        cls,
        sums: FragmentSums,
        view: AbstractView,
        settings: SplattingSettings,
        combination: DeviceMesh,
    ) -> "VisibleSurfaces":
        """Combine the sums of all devices; each keeps a share of the places."""
        grid = TileGrid(view.width, view.height)
        in_front = jnp.arange(len(sums.tiles)) < sums.front
        own = combination.own_share(sums.sums)
        # The sums of weights and nearness of both surfaces in all tiles, from all devices.
        rows = combination.gather(jnp.stack([own.weights, own.rows[:, -1]]), axis=1)
        of_tiles = jnp.zeros((2, 2, grid.count, TILE_SIDE**2), rows.dtype)
        surface = 1 - in_front.astype(jnp.int32)
        weights, nearness = of_tiles.at[:, surface, sums.tiles].set(rows, mode="drop")
        nearness = blend_fragments(nearness, weights)
        shares = coverages(weights, nearness, grid, settings.covered_from)
        shares = shares.at[surface, sums.tiles].get(mode="fill", fill_value=0)
        return cls(
            view=view,
            tiles=combination.own_rows(sums.tiles),
            in_front=combination.own_rows(in_front),
            sums=own,
            share=combination.own_rows(shares),
            needed=combination.largest([sums.needed]),
        )

    @property
    def overflow(self) -> Float[Array, ""]:
        """The needed capacity divided by the planned capacity if that does not suffice, else 0."""
        return jnp.where(self.needed <= 1, 0.0, self.needed)

    @property
    def grid(self) -> TileGrid:
        return TileGrid(self.view.width, self.view.height)

    def gathered(self, combination: DeviceMesh) -> "VisibleSurfaces":
        """Return the places of all devices, without the rows of their sums."""
        sums = PixelSums(self.sums.rows[:, :0], self.sums.weights)
        places = combination.gather((self.tiles, self.in_front, sums, self.share))
        return VisibleSurfaces(self.view, *places, self.needed)

    def front_picture(
        self, values: Float[Array, "places *rows pixels"], fill: float = 0.0
    ) -> Float[Array, "height width *rows"]:
        """Join the picture of the front surface; `fill` where there is none."""
        tiles = self._blank(values) + fill
        place = jnp.where(self.in_front, self.tiles, self.grid.count)
        return self._joined(tiles.at[place].set(values, mode="drop"))

    def picture(
        self, values: Float[Array, "places *rows pixels"]
    ) -> Float[Array, "height width *rows"]:
        """Composite the front over the surface behind it, premultiplied by coverage."""
        share = self.share.reshape(len(self.tiles), *[1] * (values.ndim - 2), -1)
        return self._joined(self._blank(values).at[self.tiles].add(share * values, mode="drop"))

    def _blank(
        self, values: Float[Array, "places *rows pixels"]
    ) -> Float[Array, "tiles *rows pixels"]:
        shape = self.grid.count, *values.shape[1:]
        return zeros_after((self.share, values), shape, values.dtype)

    def _joined(
        self, tiles: Float[Array, "tiles *rows pixels"]
    ) -> Float[Array, "height width *rows"]:
        flat = tiles.reshape(tiles.shape[0], -1, tiles.shape[-1])
        picture = jnp.moveaxis(self.grid.join(flat), 0, 2)
        return invalid_factor(self.needed) * picture.reshape(*picture.shape[:2], *tiles.shape[1:-1])


def visible_surfaces(
    splats: Splats,
    attributes: Float[Array, "attributes splats"],
    view: AbstractView,
    settings: SplattingSettings,
    plan: AbstractRasterPlan,
    combination: DeviceMesh,
) -> VisibleSurfaces:
    r"""Find the visible surfaces and sum the attributes of their splats (passes 2 and 3).

    The nearness of each ray's hit with each splat's plane is blended like an attribute, so that a
    plane stays a plane.

    **Arguments:**

    - `splats`: differentiable; the choice of fragments is not.
    - `attributes`: one row per attribute. Differentiable.
    - `view`: differentiable.
    - `plan`: a plan from an `AbstractRasterizer`.

    **Returns:** the surfaces; if the capacity of the plan is exceeded, `needed` is above 1 and
    every picture is NaN.
    """
    sums = plan.sum_fragments(splats, attributes, view, settings, combination)
    return VisibleSurfaces.of(sums, view, settings, combination)
