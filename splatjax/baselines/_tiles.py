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

from ._kernels import AbstractSplatKernel

Result = TypeVar("Result", bound=PyTree)


class AbstractListRasterizer(AbstractRasterizer):
    """Passes 2 and 3 by a kernel, over lists of splats. Shadow maps are the renderer's: baselines
    differ in the picture alone.
    """

    kernel: eqx.AbstractVar[AbstractSplatKernel]
    capacity: eqx.AbstractVar[BinCapacity | None]

    def planned(self, splats: Splats, views: Sequence[AbstractView], settings: SplattingSettings):
        counts = [_demand(self.kernel, splats, view, settings) for view in views]
        capacity = BinCapacity.for_counts(counts, TileGrid(views[0].width, views[0].height))
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
        rows, dtype = attributes.shape[0], attributes.dtype
        empty_sums = FragmentSums.nothing(TileGrid(view.width, view.height).count, rows, dtype)
        if splats.count == 0:
            return SummedFragments(empty_sums, empty_sums, jnp.zeros((), dtype))
        lists = self.lists(splats, view, settings)
        front = self.front(lists, attributes, view)
        return SummedFragments(front, empty_sums, lists.bins.needed.astype(dtype))

    def lists(self, splats: Splats, view: AbstractView, settings: SplattingSettings) -> "Lists":
        """Sort the splats into the tiles of a picture.

        **Raises:** `ValueError` where the rasterizer comes from no plan.
        """
        if self.capacity is None:
            raise ValueError(
                f"this {type(self).__name__} has no capacity yet; take one from a plan "
                "(splatjax.plan) or from `planned`"
            )
        footprints, grid = (
            self.kernel.footprints(splats, view, settings),
            TileGrid(view.width, view.height),
        )
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

    def map_blocks(self, look: Callable[..., Result], *more) -> Result:
        """Look at every block, one after the other: its splats `[lanes, slots]`, what more there is
        of its chunk, and offsets.

        **Arguments:**

        - `look`: of ids `[lanes, slots]`, footprints `[lanes, slots, 1]`, offsets in x and y
          `[lanes, slots, pixels]` and of each of `more` `[lanes, ...]`.
        - `more`: of every tile, as `reduce_blocks` returns it.
        """
        grid, dtype = self.grid, self.footprints.x.dtype
        last = self.bins.order.shape[0] // grid.lanes - 1

        @jax.checkpoint
        def one(ids, chunk):
            chunk = jnp.minimum(chunk, last)
            tile = jax.lax.dynamic_slice_in_dim(self.bins.order, chunk * grid.lanes, grid.lanes)
            x, y = (pixel.astype(dtype)[:, None] + 0.5 for pixel in grid.columns_and_rows(tile))
            own = jax.tree.map(
                lambda plane: plane.at[ids].get(mode="fill", fill_value=0)[:, :, None],
                self.footprints,
            )
            return look(ids, own, x - own.x, y - own.y, *(values[chunk] for values in more))

        return jax.lax.map(lambda block: one(*block), (self.bins.ids, self.chunk))

    def reduce_blocks(self, combine: Callable, results: jax.Array) -> jax.Array:
        """Combine what the blocks of each chunk found, by a segment reduction: `[chunks, lanes,
        ...]`.
        """
        chunks = self.bins.order.shape[0] // self.grid.lanes
        return combine(results, self.chunk, num_segments=chunks, indices_are_sorted=True)

    def tiles(
        self, results: Float[Array, "chunks lanes rows pixels"]
    ) -> Float[Array, "tiles rows pixels"]:
        """Put what the chunks found in the order of the tiles; 0 beyond the picture, NaN where the
        lists had no room.
        """
        within = self.grid.within_picture()
        tiles = self.bins.by_tile(results.reshape(-1, *results.shape[2:]), self.grid.count)
        tiles = tiles if within is None else jnp.where(within[:, None], tiles, 0.0)
        return tiles + self.bins.poison(results.dtype)


@eqx.filter_jit
def _demand(
    kernel: AbstractSplatKernel, splats: Splats, view: AbstractView, settings: SplattingSettings
):
    grid = TileGrid(view.width, view.height)
    return kernel.footprints(splats, view, settings).ranges(grid).per_tile(grid)
