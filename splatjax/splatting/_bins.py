"""Lists of items per tile of the picture.

Tiles are swept `lanes` at a time, those with lists of similar length together, and `slots` items of
each list at a time, a *block*. No item is dropped: the only limit is the planned number of pairs of
item and tile, and exceeding it is reported.
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
_CHEAP = 1 << 18  # pairs that are sorted in a few milliseconds


def plan_pairs(
    per_tile: Sequence[Int[Array, " tiles"]], grid: TileGrid, spare: float = 1.03
) -> int:
    """Choose the capacity of pairs of item and tile for each of these numbers of items per tile."""
    pairs = max(int(np.asarray(tiles, np.int64).sum()) for tiles in per_tile)
    return with_spare(("pairs", grid), pairs, _ROW, 2, spare, _CHEAP)


class Bins(eqx.Module):
    """Items per tile.

    **Attributes:**

    - `ids`: ids of items, in one list per tile.
    - `begins`, `counts`: begin and length of the list of every tile, and of an empty list after the
      last tile.
    - `order`: the tiles, those with the longest lists first; a *chunk* is `lanes` of them.
    - `needed`: needed capacity divided by planned capacity; above 1 the lists are incomplete.
    - `items`: number of items. Static.
    """

    ids: Int[Array, " pairs"]
    begins: Int[Array, " tiles_and_one"]
    counts: Int[Array, " tiles_and_one"]
    order: Int[Array, " tiles"]
    needed: Float[Array, ""]
    items: int = eqx.field(static=True)

    def block(
        self, tiles: Int[Array, " lanes"], number: Int[Array, ""], slots: int
    ) -> Int[Array, "lanes slots"]:
        """Read one block of `slots` ids from the list of each tile. Slots after the end of a list
        contain the number of items.
        """
        place = (number * slots + jnp.arange(slots, dtype=jnp.int32))[None]
        listed = jnp.where(
            place < self.counts[tiles][:, None], self.begins[tiles][:, None] + place, len(self.ids)
        )
        return self.ids.at[listed].get(mode="fill", fill_value=self.items)


def _pairs(ranges: TileRanges, grid: TileGrid, capacity: int):
    """List all pairs of item and tile, item after item, padded by `grid.padded_count`. Also compute
    the capacity needed over planned.
    """
    counts = ranges.across * ranges.down
    ends = running(jnp.add, counts)
    begins, total = ends - counts, ends[-1]
    # The item of a pair is the number of items whose pairs all precede it.
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

    Returns, for the sorted pairs, tile, column before sorting and rank; and the counts per tile,
    that of empty pairs last.
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
    return sorted_tile, column_before, rank, counts


def bin_items(ranges: TileRanges, grid: TileGrid, pairs: int) -> Bins:
    """List the items of every tile, in order, with a capacity of pairs. Not differentiated."""
    items, tiles = ranges.left.shape[0], grid.padded_count
    # List the pairs item after item, and number the pairs of each tile.
    item, tile, needed = _pairs(ranges, grid, pairs)
    tile, column, rank, counts = _ranks(tile, tiles)
    item = jnp.take_along_axis(item.reshape(-1, _ROW), column, axis=1, mode="promise_in_bounds")

    # Tile after tile. Empty pairs, whose tile is the one after the last, come after all others.
    begins = running(jnp.add, counts) - counts
    place = begins.at[tile].get(mode="promise_in_bounds") + rank
    ids = jnp.full(pairs, items, jnp.int32)
    ids = ids.at[place.reshape(-1)].set(item.reshape(-1), mode="drop")

    # Longest lists first; of equally many blocks in scan order, so that the lanes of a chunk are
    # neighbors.
    counts = counts.at[tiles].set(0)
    order = jnp.argsort(-grid.blocks(counts[:tiles]), stable=True).astype(jnp.int32)
    return Bins(ids, begins, counts, order, needed, items)
