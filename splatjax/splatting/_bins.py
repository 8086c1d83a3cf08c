"""Lists of items per tile of the picture, stored so that sweeps over them read contiguous memory.

Tiles are ordered by the length of their list and swept `lanes` at a time, a *chunk*; the lists of a
chunk are stored as *blocks* of `[lanes, slots]`. No item is dropped: the only limits are the
planned numbers of pairs and of blocks, and exceeding either is reported.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from splatjax._chunking import needed_over_planned, running, with_spare

from ._grid import TILE_BITS, TileGrid, TileRanges

_ROW_BITS = 32 - TILE_BITS  # of a sort key: the number of a pair in its row
_ROW = 1 << _ROW_BITS  # pairs sorted together


class BinCapacity(eqx.Module):
    """Capacity of the lists: pairs of item and tile, blocks, and chunks with any item. Static."""

    pairs: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)
    chunks: int = eqx.field(static=True)

    @classmethod
    def for_counts(
        cls, per_tile: Sequence[Int[Array, " tiles"]], grid: TileGrid, spare: float = 1.03
    ) -> "BinCapacity":
        """Choose the capacity for each of these numbers of items per tile."""
        pairs, blocks, chunks, all_chunks = 1, 1, 1, grid.padded_count // grid.lanes
        for tiles in per_tile:
            counts = np.asarray(tiles, np.int64)
            # Blocks of the longest list of each chunk: the lists of a chunk take as many each.
            longest = np.sort(-(-counts // grid.slots))[::-1][:: grid.lanes]
            pairs, blocks = max(pairs, int(counts.sum())), max(blocks, int(longest.sum()))
            chunks = max(chunks, int((longest > 0).sum()))
        chunks = with_spare(("chunks", grid), chunks, -(-grid.half // 4), spare=spare)
        return cls(
            with_spare(("pairs", grid), pairs, _ROW, per_octave=4, spare=spare),
            with_spare(("blocks", grid), blocks, 4, per_octave=2, spare=spare),
            min(max(chunks, grid.half), all_chunks),
        )

    def coarse(self, grid: TileGrid) -> "BinCapacity":
        """Round up to the next powers of two, and to all chunks."""
        all_chunks = grid.padded_count // grid.lanes
        pairs, blocks = (1 << count.bit_length() for count in (self.pairs, self.blocks))
        return BinCapacity(pairs, blocks, all_chunks)


class Bins(eqx.Module):
    """Items per tile.

    **Attributes:**

    - `ids`: of items; an empty slot contains the number of items.
    - `order`: the tile of each lane, chunk after chunk.
    - `first_block`: of each chunk; the last entry is the number of all blocks.
    - `needed`: capacity needed over planned; above 1 the lists are incomplete.
    - `planned_lanes`: capacity of the leading chunks, in lanes; the lists beyond are empty. Static.
    """

    ids: Int[Array, "blocks lanes slots"]
    order: Int[Array, " tiles"]
    first_block: Int[Array, " chunks_and_one"]
    needed: Float[Array, ""]
    planned_lanes: int = eqx.field(static=True)

    @property
    def chunks(self) -> Int[Array, ""]:
        """Count the chunks that are not empty, which come first: lists are sorted by length."""
        return jnp.minimum(_occupied(self.first_block), self.planned_lanes // self.ids.shape[1])


def _occupied(first_block: Int[Array, " chunks_and_one"]) -> Int[Array, ""]:
    return jnp.sum(first_block[1:] > first_block[:-1], dtype=jnp.int32)


def _pairs(ranges: TileRanges, grid: TileGrid, capacity: int):
    """List all pairs of item and tile, item after item, padded by `grid.padded_count`. Also compute
    the capacity needed over planned.
    """
    counts = ranges.across * ranges.down
    ends = running(jnp.add, counts)
    begins, total = ends - counts, ends[-1]
    # As many items have ended before a pair as lie before its own.
    ended = jnp.zeros(capacity, jnp.int32).at[ends].add(1, mode="drop")
    item = jnp.minimum(running(jnp.add, ended), counts.shape[0] - 1)
    pair = jnp.arange(capacity, dtype=jnp.int32)

    def of_item(values):
        return values.at[item].get(mode="promise_in_bounds")

    corner = ranges.top * grid.across + ranges.left
    local, across = pair - of_item(begins), jnp.maximum(of_item(ranges.across), 1)
    down = ((local.astype(jnp.float32) + 0.5) / across.astype(jnp.float32)).astype(
        jnp.int32
    )  # exact, since an item has fewer than 2^22 tiles
    tile = of_item(corner) + local + down * (grid.across - across)
    # The integer is exact but may wrap around; the float rounds but does not wrap around.
    needed = jnp.sum(counts.astype(jnp.float32)) / capacity
    needed = jnp.maximum(needed, needed_over_planned(total, capacity))
    return item, jnp.where(pair < total, tile, grid.padded_count), needed


def _ranks(tile: Int[Array, " pairs"], tiles: int):
    """Compute the rank of each pair in its tile's list, in rows that are sorted by tile.

    Returns, for the sorted pairs, tile, column before sorting and rank; and the counts per tile.
    """
    # Sort each row by tile; the low bits keep the order within a tile.
    column = jnp.arange(_ROW, dtype=jnp.uint32)[None]
    keys = (tile.astype(jnp.uint32).reshape(-1, _ROW) << _ROW_BITS) | column
    parts = jnp.array_split(keys, 2)  # a sort runs on one core; several run side by side
    keys = jnp.concatenate([lax.sort(part, dimension=1, is_stable=False) for part in parts])
    sorted_tile = (keys >> _ROW_BITS).astype(jnp.int32)
    column_before = (keys & (_ROW - 1)).astype(jnp.int32)

    # Mark the first pair of each tile in its row, and find for every pair where its tile begins.
    column_after = jnp.arange(_ROW, dtype=jnp.int32)[None]
    begins = jnp.pad(sorted_tile[:, 1:] != sorted_tile[:, :-1], ((0, 0), (1, 0)))
    from_begin = column_after - running(jnp.maximum, jnp.where(begins, column_after, 0))

    # Carry the counts from row to row. A rank is the count before the row, and the pairs of the
    # tile before it in the row.
    def count_on(counts, row):
        tiles_of_row, from_begin = row
        rank = counts.at[tiles_of_row].get(mode="promise_in_bounds") + from_begin
        return counts.at[tiles_of_row].add(1, mode="promise_in_bounds"), rank

    counts, rank = lax.scan(count_on, jnp.zeros(tiles + 1, jnp.int32), (sorted_tile, from_begin))
    return sorted_tile, column_before, rank, counts[:tiles]


def bin_items(ranges: TileRanges, grid: TileGrid, capacity: BinCapacity) -> Bins:
    """List the items of every tile, in order. Not differentiated."""
    items, lanes, slots, tiles = ranges.left.shape[0], grid.lanes, grid.slots, grid.padded_count
    size = capacity.blocks * lanes * slots
    # List the pairs item after item, and number the pairs of each tile.
    item, tile, pairs = _pairs(ranges, grid, capacity.pairs)
    tile, column, rank, counts = _ranks(tile, tiles)
    item = jnp.take_along_axis(item.reshape(-1, _ROW), column, axis=1, mode="promise_in_bounds")

    # Longest lists first; equal ones in scan order, so that the lanes of a chunk are neighbors.
    lengths = -(-counts // slots)
    order = jnp.argsort(-lengths, stable=True).astype(jnp.int32)
    first_block = jnp.concatenate(
        [jnp.zeros(1, jnp.int32), running(jnp.add, lengths[order[::lanes]])]
    )

    # Compute the first slot of each tile, and from it the slot of every pair.
    lane = jnp.arange(tiles, dtype=jnp.int32)
    begins = first_block[lane // lanes] * (lanes * slots) + (lane % lanes) * slots
    begin_of_tile = jnp.full(tiles + 1, size, jnp.int32).at[order].set(begins)
    target = (
        begin_of_tile.at[tile].get(mode="promise_in_bounds")
        + (rank // slots) * (lanes * slots)
        + rank % slots
    )
    ids = jnp.full(size, items, jnp.int32).at[target.reshape(-1)].set(item.reshape(-1), mode="drop")

    # Compute the needed over the planned capacity.
    blocks = needed_over_planned(first_block[-1], capacity.blocks)
    chunks = needed_over_planned(_occupied(first_block), capacity.chunks)
    needed = jnp.maximum(pairs, jnp.maximum(blocks, chunks))
    return Bins(
        ids.reshape(capacity.blocks, lanes, slots),
        order,
        first_block,
        needed,
        capacity.chunks * lanes,
    )
