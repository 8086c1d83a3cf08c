"""Lists of splats per tile, walked block by block in the plainest way: nothing is kept back, and
every derivative is there.
"""

import abc
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from splatjax.scene import Splats
from splatjax.splatting import (
    AbstractRasterizer,
    AbstractView,
    BinCapacity,
    Bins,
    Footprints,
    FragmentSums,
    SplattingSettings,
    SummedFragments,
    TileGrid,
    TileRasterizer,
    bin_items,
)

from ._kernels import AbstractKernel

Result = TypeVar("Result", bound=PyTree)


class AbstractListRasterizer(AbstractRasterizer):
    """Passes 2 and 3 by a kernel, over lists of splats. Shadow maps are the renderer's: baselines
    differ in the picture alone.
    """

    kernel: eqx.AbstractVar[AbstractKernel]
    capacity: eqx.AbstractVar[BinCapacity | None]

    def planned(self, splats: Splats, views: Sequence[AbstractView], settings: SplattingSettings):
        counts = [_demand(self.kernel, splats, view, settings) for view in views]
        capacity = BinCapacity.for_counts(counts, _grid(views[0]))
        return eqx.tree_at(
            lambda rasterizer: rasterizer.capacity,
            self,
            capacity,
            is_leaf=lambda leaf: leaf is None,
        )

    def for_shadows(self) -> AbstractRasterizer:
        return TileRasterizer()

    @abc.abstractmethod
    def front(
        self, lists: "Lists", attributes: Float[Array, "attributes splats"], view: AbstractView
    ) -> FragmentSums:
        """Give the surface that the lists show."""

    def summed(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
    ) -> SummedFragments:
        nothing = FragmentSums.nothing(_grid(view).count, attributes.shape[0], attributes.dtype)
        if splats.count == 0:
            return SummedFragments(nothing, nothing, jnp.zeros((), attributes.dtype))
        lists = self.lists(splats, view, settings)
        return SummedFragments(
            self.front(lists, attributes, view), nothing, lists.bins.needed.astype(attributes.dtype)
        )

    def lists(self, splats: Splats, view: AbstractView, settings: SplattingSettings) -> "Lists":
        """Sort the splats into the tiles of a picture.

        **Raises:** `ValueError` where the rasterizer comes from no plan.
        """
        if self.capacity is None:
            raise ValueError(
                f"this {type(self).__name__} has no capacity yet; take one from a plan "
                "(splatjax.plan) or from `planned`"
            )
        footprints, grid = self.kernel.footprints(splats, view, settings), _grid(view)
        bins = bin_items(footprints.ranges(grid), grid, self.capacity)
        chunk = (
            jnp.searchsorted(
                bins.first_block, jnp.arange(bins.ids.shape[0], dtype=jnp.int32), side="right"
            )
            - 1
        )
        return Lists(footprints, bins, chunk.astype(jnp.int32), grid)


class Lists(eqx.Module):
    """The splats of every tile, in blocks of `[lanes, slots]`; the blocks of a chunk hold the lists
    of the same tiles.
    """

    footprints: Footprints
    bins: Bins
    chunk: Int[Array, " blocks"]
    """The number of chunks for a block that holds nothing."""
    grid: TileGrid

    def each(self, look: Callable[..., Result], *more) -> Result:
        """Look at every block, one after the other: its splats `[lanes, slots]`, what more there is
        of its chunk, and offsets.

        **Arguments:**

        - `look`: of ids `[lanes, slots]`, footprints `[lanes, slots, 1]`, offsets in x and y
          `[lanes, slots, pixels]` and of each of `more` `[lanes, ...]`.
        - `more`: of every tile, as `over_blocks` gives it.
        """
        grid, dtype = self.grid, self.footprints.x.dtype
        last = self.bins.order.shape[0] // grid.lanes - 1

        @jax.checkpoint
        def one(ids, chunk):
            chunk = jnp.minimum(chunk, last)
            tile = jax.lax.dynamic_slice_in_dim(self.bins.order, chunk * grid.lanes, grid.lanes)
            x, y = (each.astype(dtype)[:, None] + 0.5 for each in grid.columns_and_rows(tile))
            found = jax.tree.map(
                lambda plane: plane.at[ids].get(mode="fill", fill_value=0)[:, :, None],
                self.footprints,
            )
            return look(ids, found, x - found.x, y - found.y, *(each[chunk] for each in more))

        return jax.lax.map(lambda block: one(*block), (self.bins.ids, self.chunk))

    def over_blocks(self, combine: Callable, found: jax.Array) -> jax.Array:
        """Combine what the blocks of each chunk found, by a segment reduction: `[chunks, lanes,
        ...]`.
        """
        chunks = self.bins.order.shape[0] // self.grid.lanes
        return combine(found, self.chunk, num_segments=chunks, indices_are_sorted=True)

    def tiles(
        self, found: Float[Array, "chunks lanes rows pixels"]
    ) -> Float[Array, "tiles rows pixels"]:
        """Put what the chunks found in the order of the tiles; 0 beyond the picture, NaN where the
        lists had no room.
        """
        within, tiles = (
            self.grid.within_picture(),
            self.bins.by_tile(found.reshape(-1, *found.shape[2:]), self.grid.count),
        )
        return (
            tiles if within is None else jnp.where(within[:, None], tiles, 0.0)
        ) + self.bins.poison(found.dtype)


def _grid(view: AbstractView) -> TileGrid:
    return TileGrid(view.width, view.height)


@eqx.filter_jit
def _demand(
    kernel: AbstractKernel, splats: Splats, view: AbstractView, settings: SplattingSettings
):
    grid = _grid(view)
    return kernel.footprints(splats, view, settings).ranges(grid).per_tile(grid)
