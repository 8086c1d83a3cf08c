"""A picture divided into tiles, and the lists of the items that touch them, stored so that sweeps
read contiguous memory.

Tiles are ordered by the length of their list and swept `lanes` at a time, a *chunk*; the lists of a
chunk are stored as *blocks* of `[lanes, slots]`. No item is dropped: the only limits are the
planned numbers of pairs and of blocks, and exceeding either is reported.
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import needed_over_planned, with_spare

TILE_SIDE = 8  # pixels
_HALF = 128
_TILE_BITS = 22  # in a sort key of 32, for the number of a tile
_ROW_BITS = 32 - _TILE_BITS  # of a sort key: the number of a pair in its row
_ROW = 1 << _ROW_BITS  # pairs sorted together


class TileGrid(eqx.Module):
    """A picture divided into square tiles, row by row; the last ones may extend beyond it."""

    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    lanes: int = eqx.field(static=True, default=64)
    slots: int = eqx.field(static=True, default=32)

    def __check_init__(self):
        if self.padded_count >= 1 << _TILE_BITS:
            raise ValueError(
                f"a picture of {self.width} x {self.height} pixels takes {self.padded_count} "
                f"tiles, and fewer than {1 << _TILE_BITS} can be sorted; render fewer pixels"
            )

    @property
    def across(self) -> int:
        return -(-self.width // TILE_SIDE)

    @property
    def down(self) -> int:
        return -(-self.height // TILE_SIDE)

    @property
    def count(self) -> int:
        """Tiles of the picture."""
        return self.across * self.down

    @property
    def padded_count(self) -> int:
        """Tiles of the picture, and a few empty ones that fill the last chunk."""
        return -(-self.count // self.lanes) * self.lanes

    @property
    def half(self) -> int:
        """Chunks of half of the picture, or of 1024 x 1024 pixels if it is larger. Capacities are
        planned in parts of this number, so that many bodies share a program.
        """
        return min(-(-self.padded_count // (2 * self.lanes)), _HALF)

    def cut(self, picture: Float[Array, "rows height width"]) -> Float[Array, "tiles rows pixels"]:
        """Divide a picture into tiles; 0 beyond its edges."""
        rows, height, width = picture.shape
        whole = jnp.pad(
            picture,
            ((0, 0), (0, self.down * TILE_SIDE - height), (0, self.across * TILE_SIDE - width)),
        )
        return (
            whole.reshape(rows, self.down, TILE_SIDE, self.across, TILE_SIDE)
            .transpose(1, 3, 0, 2, 4)
            .reshape(self.count, rows, TILE_SIDE**2)
        )

    def join(self, tiles: Float[Array, "tiles rows pixels"]) -> Float[Array, "rows height width"]:
        """Join the tiles of a picture."""
        rows = tiles.shape[1]
        whole = tiles.reshape(self.down, self.across, rows, TILE_SIDE, TILE_SIDE).transpose(
            2, 0, 3, 1, 4
        )
        return whole.reshape(rows, self.down * TILE_SIDE, self.across * TILE_SIDE)[
            :, : self.height, : self.width
        ]

    def columns_and_rows(
        self, tiles: Int[Array, " some"]
    ) -> tuple[Int[Array, "some pixels"], Int[Array, "some pixels"]]:
        """Return the column and the row of every pixel of some tiles."""
        within = jnp.arange(TILE_SIDE**2, dtype=jnp.int32)
        x = (tiles % self.across * TILE_SIDE)[:, None] + (within % TILE_SIDE)[None]
        y = (tiles // self.across * TILE_SIDE)[:, None] + (within // TILE_SIDE)[None]
        return x, y

    def pixel(self, x: Int[Array, "..."], y: Int[Array, "..."]) -> Int[Array, "..."]:
        """Return the number of a pixel among those of all tiles, tile by tile."""
        return (
            (y // TILE_SIDE * self.across + x // TILE_SIDE) * TILE_SIDE**2
            + y % TILE_SIDE * TILE_SIDE
            + x % TILE_SIDE
        )

    def within_picture(self, tiles: Int[Array, " some"]) -> Bool[Array, "some pixels"]:
        """Mark the pixels of some tiles that are inside the picture."""
        x, y = self.columns_and_rows(tiles)
        return (x < self.width) & (y < self.height)


class TileRanges(eqx.Module):
    """The rectangle of tiles that each item touches; `down` is 0 for an item that touches none."""

    left: Int[Array, " items"]
    top: Int[Array, " items"]
    across: Int[Array, " items"]
    down: Int[Array, " items"]

    @classmethod
    def of(
        cls,
        left: Float[Array, " items"],
        right: Float[Array, " items"],
        top: Float[Array, " items"],
        bottom: Float[Array, " items"],
        visible: Bool[Array, " items"],
        grid: TileGrid,
    ) -> "TileRanges":
        """Find the tiles with a pixel center inside each box (pixels)."""
        pixels = (left, grid.width), (top, grid.height)
        i0, j0 = (jnp.clip(jnp.ceil(low - 0.5), 0, count) for low, count in pixels)
        pixels = (right, grid.width), (bottom, grid.height)
        i1, j1 = (jnp.clip(jnp.floor(high - 0.5), -1, count - 1) for high, count in pixels)
        touched = visible & (i0 <= i1) & (j0 <= j1)
        i0, i1, j0, j1 = (
            jnp.floor(pixel / TILE_SIDE).astype(jnp.int32) for pixel in (i0, i1, j0, j1)
        )
        return cls(i0, j0, jnp.where(touched, i1 - i0 + 1, 0), jnp.where(touched, j1 - j0 + 1, 0))

    def per_tile(self, grid: TileGrid) -> Int[Array, " tiles"]:
        """Count the items of every tile, from the corners of their rectangles."""
        one = jnp.where(self.across * self.down > 0, 1, 0)
        corners = jnp.zeros((grid.down + 1, grid.across + 1), jnp.int32)
        i0, j0 = jnp.minimum(self.left, grid.across), jnp.minimum(self.top, grid.down)
        i1, j1 = (
            jnp.minimum(self.left + self.across, grid.across),
            jnp.minimum(self.top + self.down, grid.down),
        )
        corners = (
            corners.at[j0, i0]
            .add(one)
            .at[j1, i1]
            .add(one)
            .at[j0, i1]
            .add(-one)
            .at[j1, i0]
            .add(-one)
        )
        counts = jnp.cumsum(jnp.cumsum(corners, axis=0), axis=1)[:-1, :-1].reshape(-1)
        return jnp.pad(counts, (0, grid.padded_count - counts.shape[0]))


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
        pairs, blocks, chunks, whole = 1, 1, 1, grid.padded_count // grid.lanes
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
            min(max(chunks, grid.half), whole),
        )


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


def _pairs(ranges: TileRanges, grid: TileGrid, capacity: int):
    """List all pairs of item and tile, item after item, padded by `grid.padded_count`. Also compute
    the capacity needed over planned.
    """
    counts = ranges.across * ranges.down
    ends, items = jnp.cumsum(counts), jnp.arange(counts.shape[0], dtype=jnp.int32)
    item = jnp.repeat(items, counts, total_repeat_length=capacity)
    pair = jnp.arange(capacity, dtype=jnp.int32)

    def of_item(values):
        return values.at[item].get(mode="promise_in_bounds")

    # The place of each pair in the rectangle of its item; the quotient is exact, since an item has
    # fewer than 2^22 tiles.
    local, across = pair - of_item(ends - counts), jnp.maximum(of_item(ranges.across), 1)
    down = (local.astype(jnp.float32) + 0.5) / across.astype(jnp.float32)
    corner = of_item(ranges.top * grid.across + ranges.left)
    tile = corner + local + down.astype(jnp.int32) * (grid.across - across)
    # The integer is exact but may wrap around; the float rounds but does not wrap around.
    needed = jnp.sum(counts.astype(jnp.float32)) / capacity
    needed = jnp.maximum(needed, needed_over_planned(ends[-1], capacity))
    return item, jnp.where(pair < ends[-1], tile, grid.padded_count), needed


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

    # Mark the last pair of each tile in its row, and find for every pair where its tile ends.
    rows = keys.shape[0]
    ends = jnp.concatenate(
        [sorted_tile[:, 1:] != sorted_tile[:, :-1], jnp.ones((rows, 1), bool)], axis=1
    )
    column_after = jnp.arange(_ROW, dtype=jnp.int32)[None]
    candidates = jnp.where(ends, column_after, _ROW)
    run_end = lax.cummin(candidates, axis=1, reverse=True)

    # Carry the counts from row to row. A rank is the count after the row, less the pairs of the
    # tile from here to the end of the row.
    def count_on(counts, row):
        tiles_of_row, from_end = row
        counts = counts.at[tiles_of_row].add(1, mode="promise_in_bounds")
        return counts, counts.at[tiles_of_row].get(mode="promise_in_bounds") - from_end

    counts, rank = lax.scan(
        count_on, jnp.zeros(tiles + 1, jnp.int32), (sorted_tile, run_end - column_after + 1)
    )
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
    first_block = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(lengths[order[::lanes]])])

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
    occupied = jnp.sum(first_block[1:] > first_block[:-1], dtype=jnp.int32)
    chunks = needed_over_planned(occupied, capacity.chunks)
    needed = jnp.maximum(pairs, jnp.maximum(blocks, chunks))
    return Bins(
        ids.reshape(capacity.blocks, lanes, slots),
        order,
        first_block,
        needed,
        capacity.chunks * lanes,
    )
