"""The fast rasterizer: tile by tile, only the splats that touch the tile. It gives what
`DenseRasterizer` gives.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import map_chunks
from splatjax.scene import Splats

from ._bins import BinCapacity, Bins, TileGrid, bin_items, round_up
from ._rasterizer import AbstractRasterizer, FragmentSums, SummedFragments
from ._settings import SplattingSettings
from ._sweeps import PLANES, Sweep, sweep_tiles
from ._views import AbstractView

_STEP = 1024  # of the planned number of splats


class TileCapacity(eqx.Module):
    """What there is room for: splats that may be seen, and their lists. Static."""

    splats: int = eqx.field(static=True)
    bins: BinCapacity


class Binned(eqx.Module):
    """What a sweep over the tiles reads."""

    sweep: Sweep
    bins: Bins
    shift: Float[Array, " seen"]
    planes: tuple[Float[Array, " seen"], ...]
    attributes: tuple[Float[Array, " seen"], ...]


class TileRasterizer(AbstractRasterizer):
    r"""Sorts splats into tiles and sweeps each tile's own list.

    **Attributes:** (all static)

    - `lanes`, `slots`: tiles swept together, and splats of each swept together.
    - `capacity`: set by `planned`; a picture that needs more is NaN.
    """

    lanes: int = eqx.field(static=True, default=64)
    slots: int = eqx.field(static=True, default=32)
    capacity: TileCapacity | None = eqx.field(default=None)

    def _grid(self, view: AbstractView) -> TileGrid:
        return TileGrid(view.width, view.height, self.lanes, self.slots)

    def planned(
        self, splats: Splats, views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "TileRasterizer":
        return self.planned_for_each([splats], views, settings)

    def planned_for_each(
        self, parts: Sequence[Splats], views: Sequence[AbstractView], settings: SplattingSettings
    ) -> "TileRasterizer":
        """Give a rasterizer with room for any of several parts of the splats, all of one size, in
        each of these views.
        """
        counts = [self.demand(part, view, settings) for part in parts for view in views]
        return self.with_room(counts, parts[0].count, views[0])

    def demand(
        self, splats: Splats, view: AbstractView, settings: SplattingSettings
    ) -> tuple[Array, Int[Array, " tiles"]]:
        """Count the splats that may be seen, and the splats of every tile."""
        return _demand(splats, view, settings, self._grid(view))

    def with_room(
        self, demands: Sequence[tuple[Array, Int[Array, " tiles"]]], splats: int, view: AbstractView
    ) -> "TileRasterizer":
        """Give a rasterizer with room for each of several demands, of so many splats at most."""
        seen = round_up(max(int(seen) for seen, _ in demands), _STEP)
        bins = BinCapacity.for_counts([per_tile for _, per_tile in demands], self._grid(view))
        return TileRasterizer(self.lanes, self.slots, TileCapacity(min(seen, splats), bins))

    def summed(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> SummedFragments:
        dtype, grid = attributes.dtype, self._grid(view)
        if splats.count == 0:
            empty = FragmentSums.nothing(grid.count, attributes.shape[0], dtype)
            return SummedFragments(empty, empty, jnp.zeros((), dtype))
        binned = self.binned(splats, attributes, view, settings)
        front, behind = sweep_tiles(
            binned.sweep, binned.bins, binned.shift, binned.planes, binned.attributes
        )
        return SummedFragments(front, behind, binned.bins.needed.astype(dtype))

    def binned(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> "Binned":
        """Project the splats that may be seen, and list them by tile."""
        if self.capacity is None:
            raise ValueError(
                "this TileRasterizer has no capacity yet; take one from a plan (splatjax.plan) or "
                "from `planned`"
            )
        grid = self._grid(view)
        ids, seen = _compacted(view.may_see(splats), self.capacity.splats)
        splats = jax.tree.map(
            lambda leaf: (
                jnp.stack(_taken(leaf.T, ids), axis=-1)
                if leaf.ndim == 2
                else _taken(leaf[None], ids)[0]
            ),
            splats,
        )
        footprints = map_chunks(lambda part: view.footprints(part, settings), splats)
        bins = bin_items(footprints.ranges(grid), grid, self.capacity.bins)
        bins = eqx.tree_at(
            lambda b: b.needed, bins, jnp.maximum(bins.needed, seen / self.capacity.splats)
        )
        planes = tuple(getattr(footprints, name) for name in PLANES)
        sweep = Sweep(type(view), grid, settings.full_coverage, settings.filter_radius)
        return Binned(
            sweep, bins, stop_gradient(footprints.shift), planes, tuple(_taken(attributes, ids))
        )


@eqx.filter_jit
def _demand(splats: Splats, view: AbstractView, settings: SplattingSettings, grid: TileGrid):
    """Count the splats that may be seen, and the splats of every tile."""
    return jnp.sum(view.may_see(splats)), view.footprints(splats, settings).ranges(grid).per_tile(
        grid
    )


def _compacted(
    chosen: Bool[Array, " splats"], room: int
) -> tuple[Int[Array, " room"], Int[Array, ""]]:
    """List the chosen ones in order, then the number of all, which is none; and count them."""
    ends = jnp.cumsum(chosen.astype(jnp.int32))
    count = chosen.shape[0]
    target = jnp.where(chosen, ends - 1, room)
    return jnp.full(room, count, jnp.int32).at[target].set(
        jnp.arange(count, dtype=jnp.int32), mode="drop"
    ), ends[-1]


def _taken(
    rows: Float[Array, "rows splats"], ids: Int[Array, " room"]
) -> list[Float[Array, " room"]]:
    """Take columns, 0 for those that are none; row by row, so that derivatives are planes too."""
    split = lax.split(
        rows, [1] * rows.shape[0]
    )  # of a split the derivative is put together once; of slices, summed
    return [row[0].at[ids].get(mode="fill", fill_value=0, indices_are_sorted=True) for row in split]
