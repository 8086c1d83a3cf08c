"""The fast rasterizer: tile by tile, only the splats that touch the tile."""

import dataclasses
import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array, Float, Int

from splatjax._chunking import map_chunks
from splatjax._combination import AbstractCombination, OneDevice
from splatjax.scene import Splats

from ._bins import BinCapacity, Bins, bin_items, round_up
from ._fragments import PLANES, Slots, Sweep
from ._grid import TileGrid
from ._rasterizer import AbstractRasterizer, AbstractRasterPlan, FragmentSums, Places
from ._sweeps import PartSweep, sum_fragments
from ._views import AbstractView, SplattingSettings

_STEP = 1024  # of the planned number of splats
_SPARE = 1.5  # times the tiles with a surface behind that planning found


class TileRasterizer(AbstractRasterizer):
    r"""Sorts splats into tiles and sweeps each tile's own list.

    **Attributes:** (static)

    - `lanes`, `slots`: tiles swept together, and splats of each swept together.
    """

    lanes: int = eqx.field(static=True, default=64)
    slots: int = eqx.field(static=True, default=32)

    def make_plan(
        self, parts: Sequence[Splats], views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "TilePlan":
        demands = [[self.demand(part, view, settings) for view in views] for part in parts]
        return self.plan_for(demands, parts[0].count, views[0])

    def demand(
        self, splats: Splats, view: AbstractView, settings: SplattingSettings
    ) -> tuple[Array, Int[Array, " tiles"]]:
        """Count the splats that may be seen, and the splats of every tile."""
        return _demand(splats, view, settings, self.grid(view))

    def plan_for(
        self,
        demands: Sequence[Sequence[tuple[Array, Int[Array, " tiles"]]]],
        splats: int,
        view: AbstractView,
    ) -> "TilePlan":
        """Make the plan for the demand of each part in each view, of so many splats at most."""
        grid = self.grid(view)
        seen = round_up(max(int(seen) for part in demands for seen, _ in part), _STEP)
        bins = BinCapacity.for_counts([tiles for part in demands for _, tiles in part], grid)
        front = bins.chunks * self.lanes
        if len(demands) > 1:
            # Places are shared by the parts: there is one for each tile that any part touches.
            touched = [
                np.any([np.asarray(tiles) > 0 for _, tiles in each], axis=0)
                for each in zip(*demands, strict=True)
            ]
            grain = math.lcm(self.lanes, len(demands))
            front = round_up(max(int(np.sum(tiles)) for tiles in touched), grain)
        return TilePlan(self, min(seen, splats), bins, Places(front, front))

    def grid(self, view: AbstractView) -> TileGrid:
        """Cut the picture of a view into tiles."""
        return TileGrid(view.width, view.height, self.lanes, self.slots)


class TilePlan(AbstractRasterPlan):
    """The capacity of a `TileRasterizer`: splats that may be seen, and their lists.

    **Attributes:** (static)

    - `rasterizer`: its setting.
    - `splats`: splats that may be seen.
    - `bins`, `places`: of the lists, and of the tiles with a surface.
    """

    rasterizer: TileRasterizer
    splats: int = eqx.field(static=True)
    bins: BinCapacity
    places: Places

    def fitted(
        self, parts: Sequence[Splats], views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "TilePlan":
        whole, plan = parts[0], self
        if len(parts) > 1:
            whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
            plan = self.rasterizer.make_plan([whole], views, settings)
        most = max(int(_tiles_behind(whole, view, settings, plan)) for view in views)
        grain = math.lcm(self.rasterizer.lanes, len(parts))
        behind = -(-int(_SPARE * most + 1) // grain) * grain
        return dataclasses.replace(self, places=Places(self.places.front, behind))

    def choose(
        self, splats: Splats, view: AbstractView
    ) -> tuple[Int[Array, " chosen"], Float[Array, ""]]:
        may_be_seen = view.may_see(splats)
        ends = jnp.cumsum(may_be_seen.astype(jnp.int32))
        every = jnp.arange(splats.count, dtype=jnp.int32)
        listed = jnp.full(self.splats, splats.count, jnp.int32)
        listed = listed.at[jnp.where(may_be_seen, ends - 1, self.splats)].set(every, mode="drop")
        return listed, (ends[-1] / self.splats).astype(splats.centers.dtype)

    def sum_fragments(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
        combination: AbstractCombination,
    ) -> FragmentSums:
        binned = self._bin(splats, attributes, view, settings)
        return sum_fragments(
            binned.sweep,
            self.places,
            combination,
            binned.bins,
            binned.shift,
            binned.planes,
            binned.attributes,
        )

    def part_sweep(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> PartSweep:
        """Prepare the stages of the sweep for one of several parts of the splats."""
        each = self._bin(splats, attributes, view, settings)
        slots = Slots.gathered(each.shift, each.planes, each.attributes, each.bins)
        return PartSweep(each.sweep, each.bins, slots)

    def _bin(self, splats: Splats, attributes, view: AbstractView, settings) -> "_Binned":
        """Project the splats, and list them by tile."""
        grid = self.rasterizer.grid(view)
        footprints = map_chunks(lambda part: view.footprints(part, settings), splats)
        bins = bin_items(footprints.ranges(grid), grid, self.bins)
        return _Binned(
            sweep=Sweep(type(view), grid, settings.full_coverage, settings.filter_radius),
            bins=bins,
            shift=stop_gradient(footprints.shift),
            planes=tuple(getattr(footprints, name) for name in PLANES),
            attributes=attributes.T,
        )


class _Binned(eqx.Module):
    """What a sweep over the tiles reads."""

    sweep: Sweep
    bins: Bins
    shift: Float[Array, " seen"]
    planes: tuple[Float[Array, " seen"], ...]
    attributes: Float[Array, "seen attributes"]


@eqx.filter_jit
def _demand(splats: Splats, view: AbstractView, settings: SplattingSettings, grid: TileGrid):
    """Count the splats that may be seen, and the splats of every tile."""
    ranges = view.footprints(splats, settings).ranges(grid)
    return jnp.sum(view.may_see(splats)), ranges.per_tile(grid)


@eqx.filter_jit
def _tiles_behind(splats: Splats, view: AbstractView, settings: SplattingSettings, plan: TilePlan):
    """Count the tiles in which a surface shows behind the front."""
    chosen, _ = plan.choose(splats, view)
    nothing = jnp.zeros((0, len(chosen)), splats.centers.dtype)
    sums = plan.sum_fragments(splats.take(chosen), nothing, view, settings, OneDevice())
    return jnp.sum(sums.tiles[sums.front :] < plan.rasterizer.grid(view).count)
