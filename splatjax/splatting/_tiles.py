"""The fast rasterizer: each tile sweeps only the splats that touch it."""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax._chunking import (
    jit_unless_traced,
    list_chosen,
    map_chunks,
    needed_over_planned,
    take_points,
    with_spare,
)
from splatjax._combination import DeviceMesh
from splatjax.cache import reuse_capacity
from splatjax.scene import Splats

from ._bins import bin_items, plan_pairs
from ._fragments import NUMBERS, PartSweep
from ._grid import TileGrid
from ._rasterizer import AbstractRasterizer, AbstractRasterPlan, FragmentSums, SurfaceCapacity
from ._sweeps import sum_tile_fragments
from ._views import AbstractView, SplattingSettings

_STEP = 1024  # least step to which the planned number of splats is rounded up
_CHEAP = 4096  # tiles that take hardly any time where there is no surface
_SPARE = 2.0  # planned tiles with a surface behind, over the number found by planning


class TileRasterizer(AbstractRasterizer):
    r"""Sorts splats into tiles and sweeps each tile's own list.

    **Attributes:** (static)

    - `lanes`, `slots`: number of tiles swept together, and of splats of each tile.
    - `spare`: factor on the needed capacity.
    """

    lanes: int = eqx.field(static=True, default=64)
    slots: int = eqx.field(static=True, default=32)
    spare: float = eqx.field(static=True, default=1.03)

    def for_shadows(self) -> "TileRasterizer":
        """Return a rasterizer with 25% spare capacity, so that other lights and bodies reuse the
        program: without attributes, capacity takes little memory and no time.
        """
        return dataclasses.replace(self, spare=1.25)

    def make_plan(
        self, parts: Sequence[Splats], views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "TilePlan":
        demands = [[self.demand(part, view, settings) for view in views] for part in parts]
        return self.plan_for(demands, parts[0].count, views[0], len(parts))

    @eqx.filter_jit
    def demand(
        self, splats: Splats, view: AbstractView, settings: SplattingSettings
    ) -> tuple[Array, Int[Array, " tiles"]]:
        """Count the splats that may be visible, and the splats of every tile."""
        ranges = view.footprints(splats, settings).ranges(self.grid(view))
        return jnp.sum(view.may_see(splats)), ranges.per_tile(self.grid(view))

    def plan_for(
        self,
        demands: Sequence[Sequence[tuple[Array, Int[Array, " tiles"]]]],
        splats: int,
        view: AbstractView,
        devices: int = 1,
    ) -> "TilePlan":
        """Make the plan for the demand of each part in each view, of so many splats at most. Every
        device has a share of the places.
        """
        grid = self.grid(view)
        most = max(int(seen) for part in demands for seen, _ in part)
        seen = with_spare(("seen", splats), most, max(_STEP, splats // 8), spare=self.spare)
        pairs = plan_pairs([tiles for part in demands for _, tiles in part], grid, self.spare)
        # There is a place for each tile that any part touches.
        touched = [
            np.any([np.asarray(tiles) > 0 for _, tiles in of_view], axis=0)
            for of_view in zip(*demands, strict=True)
        ]
        most = max(int(np.sum(tiles)) for tiles in touched)
        step = self.lanes * -(-grid.half // 2)
        front = with_spare(("front", grid), most, step, spare=self.spare, cheap=_CHEAP)
        grain = math.lcm(self.lanes, devices)
        front = min(max(front, self.lanes * grid.half), grid.padded_count)
        front = -(-front // grain) * grain
        return TilePlan(self, min(seen, splats), pairs, SurfaceCapacity(front, front))

    def grid(self, view: AbstractView) -> TileGrid:
        """Cut the picture of a view into tiles."""
        return TileGrid(view.width, view.height, self.lanes, self.slots)


class TilePlan(AbstractRasterPlan):
    """The capacity of a `TileRasterizer`: splats that may be visible, and their lists.

    **Attributes:** (static)

    - `rasterizer`: the rasterizer that made the plan.
    - `splats`: number of splats that may be visible.
    - `pairs`: capacity of the lists: pairs of splat and tile.
    - `places`: capacity for the tiles with a surface.
    """

    rasterizer: TileRasterizer
    splats: int = eqx.field(static=True)
    pairs: int = eqx.field(static=True)
    places: SurfaceCapacity

    def fitted(
        self,
        splats: Splats,
        views: Sequence[AbstractView],
        settings: SplattingSettings,
        devices: int = 1,
    ) -> "TilePlan":
        plan = self if devices == 1 else self.rasterizer.make_plan([splats], views, settings)
        # Coarse capacities, so that other bodies and pictures of the size share the program.
        grid = self.rasterizer.grid(views[0])
        every_tile = SurfaceCapacity(grid.padded_count, grid.padded_count)
        seen = min(1 << plan.splats.bit_length(), splats.count)
        coarse = TilePlan(self.rasterizer, seen, 1 << plan.pairs.bit_length(), every_tile)
        most = max(int(_tiles_behind(splats, view, settings, coarse)) for view in views)
        grain = math.lcm(self.rasterizer.lanes * -(-grid.half // 8), devices)
        capacity = -(-int(_SPARE * most + 1) // grain) * grain
        cheap = max(2.0, _CHEAP / capacity)
        behind = reuse_capacity(("behind", grid, grain), int(1.25 * most) + 1, capacity, cheap)
        return dataclasses.replace(self, places=SurfaceCapacity(self.places.front, behind))

    def choose(
        self, splats: Splats, view: AbstractView
    ) -> tuple[Int[Array, " chosen"], Float[Array, ""]]:
        may_be_seen = view.may_see(splats)
        needed = needed_over_planned(jnp.sum(may_be_seen, dtype=jnp.int32), self.splats)
        return list_chosen(may_be_seen, self.splats), needed.astype(splats.centers.dtype)

    def sum_fragments(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
        combination: DeviceMesh,
    ) -> FragmentSums:
        sweep_settings, *binned = self._bin(splats, attributes, view, settings)
        return sum_tile_fragments(sweep_settings, self.places, combination, *binned)

    @jit_unless_traced
    def part_sweep(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> PartSweep:
        """Prepare the stages of the sweep for the splats of one of several parts that the view may
        see.
        """
        chosen, _ = self.choose(splats, view)
        seen = splats.take(chosen), take_points(attributes, chosen)
        return PartSweep.of(*self._bin(*seen, view, settings))

    def _bin(self, splats: Splats, attributes, view: AbstractView, settings: SplattingSettings):
        """Project the splats, and list them by tile. Returns the arguments of `PartSweep.of`."""
        grid = self.rasterizer.grid(view)
        footprints = map_chunks(lambda part: view.footprints(part, settings), splats)
        return (
            (type(view), grid, settings.filter_radius),
            settings.hidden_from.astype(splats.centers.dtype),
            bin_items(footprints.ranges(grid), grid, self.pairs),
            jax.lax.stop_gradient(footprints.shift),
            tuple(getattr(footprints, name) for name in NUMBERS),
            attributes,
        )


@eqx.filter_jit
def _tiles_behind(splats: Splats, view: AbstractView, settings: SplattingSettings, plan: TilePlan):
    """Count the tiles in which a surface is visible behind the front."""
    chosen, _ = plan.choose(splats, view)
    no_rows = jnp.zeros((0, len(chosen)), splats.centers.dtype)
    sums = plan.sum_fragments(splats.take(chosen), no_rows, view, settings, DeviceMesh())
    return jnp.sum(sums.tiles[sums.front :] < plan.rasterizer.grid(view).count)
