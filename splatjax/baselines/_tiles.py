"""Lists of splats per tile, processed block by block in the simplest way, and differentiable
throughout.
"""

import abc
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from splatjax._chunking import needed_over_planned, running, with_spare
from splatjax.scene import Splats
from splatjax.splatting import (
    AbstractRasterizer,
    AbstractRasterPlan,
    AbstractView,
    Bins,
    Footprints,
    FragmentSums,
    PixelSums,
    SplattingSettings,
    TileGrid,
    TileRasterizer,
    bin_items,
    plan_pairs,
)

from ._kernels import AbstractSplatKernel

Result = TypeVar("Result", bound=PyTree)


class AbstractListRasterizer(AbstractRasterizer):
    """Passes 2 and 3 by a kernel, over lists of splats. Shadow maps are rendered as in the renderer
    itself, so that baselines differ only in the picture.
    """

    kernel: eqx.AbstractVar[AbstractSplatKernel]

    def make_plan(self, parts, views, settings):
        if len(parts) > 1:
            raise ValueError(
                f"a {type(self).__name__} works on one device; give a TileRasterizer for a mesh"
            )
        counts = [_demand(self.kernel, parts[0], view, settings) for view in views]
        grid = TileGrid(views[0].width, views[0].height)
        # Blocks of the longest list of each chunk; every list of the chunk takes as many.
        longest = [np.sort(grid.blocks(tiles))[::-1][:: grid.lanes] for tiles in counts]
        blocks = with_spare(("blocks", grid), max(int(chunks.sum()) for chunks in longest), 4)
        return ListPlan(self, plan_pairs(counts, grid), blocks)

    def for_shadows(self) -> AbstractRasterizer:
        return TileRasterizer()

    @abc.abstractmethod
    def front(
        self, lists: "TileLists", attributes: Float[Array, "attributes splats"], view: AbstractView
    ) -> Float[Array, "places rows pixels"]:
        """Compute the rows of the front surface, as in `FragmentSums`, lane by lane of the
        lists.
        """


class ListPlan(AbstractRasterPlan):
    """The capacity of the lists of an `AbstractListRasterizer`. No surface behind the front is
    rendered.
    """

    rasterizer: AbstractListRasterizer
    pairs: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)

    def sum_fragments(
        self,
        splats: Splats,
        attributes: Float[Array, "attributes splats"],
        view: AbstractView,
        settings: SplattingSettings,
        combination,
    ) -> FragmentSums:
        grid = TileGrid(view.width, view.height)
        footprints = self.rasterizer.kernel.footprints(splats, view, settings)
        bins = bin_items(footprints.ranges(grid), grid, self.pairs)
        lengths = grid.blocks(bins.counts[bins.order[:: grid.lanes]])
        ends = jnp.concatenate([running(jnp.add, lengths), jnp.full(1, self.blocks, jnp.int32)])
        block = jnp.arange(self.blocks, dtype=jnp.int32)
        chunk = jnp.searchsorted(ends, block, side="right").astype(jnp.int32)
        lists = TileLists(footprints, bins, chunk, ends[chunk] - 1 - block, grid)
        rows = self.rasterizer.front(lists, attributes, view)
        rows = jnp.where(grid.within_picture(bins.order)[:, None], rows, 0.0)
        tiles = jnp.minimum(bins.order, grid.count)
        sums = PixelSums(rows[:, :-1], rows[:, -1])
        needed = jnp.maximum(bins.needed, needed_over_planned(ends[-2], self.blocks))
        return FragmentSums(tiles, sums, needed.astype(rows.dtype), len(rows))


class TileLists(eqx.Module):
    """The splats of every tile, in blocks of `[lanes, slots]`; the blocks of a chunk contain the
    lists of the same tiles, and are numbered.
    """

    footprints: Footprints
    bins: Bins
    chunk: Int[Array, " blocks"]
    """Chunk of each block; the number of chunks for an empty block."""
    number: Int[Array, " blocks"]
    grid: TileGrid

    def map_blocks(self, look: Callable[..., Result], *more) -> Result:
        """Apply a function to every block, one after the other: to its splats `[lanes, slots]`, the
        offsets, and further values of its chunk.

        **Arguments:**

        - `look`: function of ids `[lanes, slots]`, footprints `[lanes, slots, 1]`, offsets in x and
          y `[lanes, slots, pixels]` and of each of `more` `[lanes, ...]`.
        - `more`: values of every tile, as `reduce_blocks` returns them.
        """
        grid, dtype = self.grid, self.footprints.x.dtype
        last = self.bins.order.shape[0] // grid.lanes - 1

        @jax.checkpoint
        def map_block(chunk, number):
            chunk = jnp.minimum(chunk, last)
            tile = jax.lax.dynamic_slice_in_dim(self.bins.order, chunk * grid.lanes, grid.lanes)
            ids = self.bins.block(tile, number, grid.slots)
            x, y = (pixel.astype(dtype)[:, None] + 0.5 for pixel in grid.columns_and_rows(tile))
            footprints = jax.tree.map(
                lambda plane: plane.at[ids].get(mode="fill", fill_value=0)[:, :, None],
                self.footprints,
            )
            return look(
                ids,
                footprints,
                x - footprints.x,
                y - footprints.y,
                *(values[chunk] for values in more),
            )

        return jax.lax.map(lambda block: map_block(*block), (self.chunk, self.number))

    def reduce_blocks(self, combine: Callable, results: jax.Array) -> jax.Array:
        """Combine the results of the blocks of each chunk by a segment reduction: `[chunks, lanes,
        ...]`.
        """
        chunks = self.bins.order.shape[0] // self.grid.lanes
        return combine(results, self.chunk, num_segments=chunks, indices_are_sorted=True)


@eqx.filter_jit
def _demand(
    kernel: AbstractSplatKernel, splats: Splats, view: AbstractView, settings: SplattingSettings
):
    grid = TileGrid(view.width, view.height)
    return kernel.footprints(splats, view, settings).ranges(grid).per_tile(grid)
