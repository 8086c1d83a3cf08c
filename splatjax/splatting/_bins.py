"""Lists of items per tile of the picture, laid out so that sweeps over them read contiguous memory.

Tiles are ordered by the length of their list and swept `lanes` at a time, a *chunk*; the lists of a
chunk are stored as *blocks* of `[lanes, slots]`. Nothing is dropped: the only limits are the
planned numbers of pairs and of blocks, and needing more than either is reported.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, DTypeLike, Float, Int

_ROW = 1024  # pairs sorted together; their place in the row takes the low 10 bits of a key
_ROW_BITS = 10


SIDE = 8
"""Pixels along a tile."""


class TileGrid(eqx.Module):
    """A picture cut into square tiles, row by row; the last ones may reach beyond it."""

    width: int = eqx.field(static=True)
    height: int = eqx.field(static=True)
    lanes: int = eqx.field(static=True, default=64)
    slots: int = eqx.field(static=True, default=32)

    @property
    def across(self) -> int:
        return -(-self.width // SIDE)

    @property
    def down(self) -> int:
        return -(-self.height // SIDE)

    @property
    def count(self) -> int:
        """Tiles of the picture."""
        return self.across * self.down

    @property
    def tiles(self) -> int:
        """Tiles of the picture, and a few empty ones that fill the last chunk."""
        return -(-self.count // self.lanes) * self.lanes

    def cut(self, picture: Float[Array, "rows height width"]) -> Float[Array, "tiles rows pixels"]:
        """Cut a picture into tiles; 0 beyond its edges."""
        rows, height, width = picture.shape
        whole = jnp.pad(
            picture, ((0, 0), (0, self.down * SIDE - height), (0, self.across * SIDE - width))
        )
        return (
            whole.reshape(rows, self.down, SIDE, self.across, SIDE)
            .transpose(1, 3, 0, 2, 4)
            .reshape(self.count, rows, SIDE**2)
        )

    def join(self, tiles: Float[Array, "tiles rows pixels"]) -> Float[Array, "rows height width"]:
        """Put a picture together from its tiles."""
        rows = tiles.shape[1]
        whole = tiles.reshape(self.down, self.across, rows, SIDE, SIDE).transpose(2, 0, 3, 1, 4)
        return whole.reshape(rows, self.down * SIDE, self.across * SIDE)[
            :, : self.height, : self.width
        ]

    def columns_and_rows(
        self, tiles: Int[Array, " some"]
    ) -> tuple[Int[Array, "some pixels"], Int[Array, "some pixels"]]:
        """Give the column and the row of every pixel of some tiles."""
        within = jnp.arange(SIDE**2, dtype=jnp.int32)
        x = (tiles % self.across * SIDE)[:, None] + (within % SIDE)[None]
        y = (tiles // self.across * SIDE)[:, None] + (within // SIDE)[None]
        return x, y

    def pixel(self, x: Int[Array, "..."], y: Int[Array, "..."]) -> Int[Array, "..."]:
        """Give the number of a pixel among those of all tiles, tile by tile."""
        return (y // SIDE * self.across + x // SIDE) * SIDE**2 + y % SIDE * SIDE + x % SIDE

    def within_picture(self) -> np.ndarray | None:
        """Say which pixels `[tiles, pixels]` lie in the picture; None if all do."""
        if self.width % SIDE == 0 and self.height % SIDE == 0:
            return None
        x, y = np.arange(self.across * SIDE) < self.width, np.arange(self.down * SIDE) < self.height
        within = y.reshape(self.down, 1, SIDE, 1) & x.reshape(1, self.across, 1, SIDE)
        return within.reshape(self.count, SIDE**2)


class TileRanges(eqx.Module):
    """The rectangle of tiles that each item touches."""

    left: Int[Array, " items"]
    top: Int[Array, " items"]
    across: Int[Array, " items"]
    down: Int[Array, " items"]
    """0 for an item that touches none."""

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
        across, down = (0, grid.width - 1), (0, grid.height - 1)
        i0, i1 = _first(left, *across) / SIDE, _last(right, *across) / SIDE
        j0, j1 = _first(top, *down) / SIDE, _last(bottom, *down) / SIDE
        touched = visible & (i0 <= i1) & (j0 <= j1)
        i0, i1, j0, j1 = (jnp.floor(edge).astype(jnp.int32) for edge in (i0, i1, j0, j1))
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
        return jnp.pad(counts, (0, grid.tiles - counts.shape[0]))


def _first(edge: Float[Array, " items"], first: int, last: int) -> Float[Array, " items"]:
    """Give the first pixel whose center is not before an edge; `last + 1` if none is."""
    return jnp.clip(jnp.ceil(edge - 0.5), first, last + 1)


def _last(edge: Float[Array, " items"], first: int, last: int) -> Float[Array, " items"]:
    """Give the last pixel whose center is not behind an edge; `first - 1` if none is."""
    return jnp.clip(jnp.floor(edge - 0.5), first - 1, last)


class BinCapacity(eqx.Module):
    """How many pairs of item and tile, blocks, and chunks with anything in them there is room for.
    Static.
    """

    pairs: int = eqx.field(static=True)
    blocks: int = eqx.field(static=True)
    chunks: int = eqx.field(static=True)

    @classmethod
    def for_counts(cls, per_tile: Sequence[Int[Array, " tiles"]], grid: TileGrid) -> "BinCapacity":
        """Give room for each of these numbers of items per tile, rounded up so that nearby ones
        need no other program.
        """
        pairs = blocks = chunks = 1
        for tiles in per_tile:
            counts = np.asarray(tiles, np.int64)
            longest = np.sort(-(-counts // grid.slots))[::-1][:: grid.lanes]
            pairs, blocks = max(pairs, int(counts.sum())), max(blocks, int(longest.sum()))
            chunks = max(chunks, int((longest > 0).sum()))
        return cls(
            round_up(pairs, _ROW),
            round_up(blocks, 4),
            min(round_up(chunks, 4), grid.tiles // grid.lanes),
        )

    def grown(self, other: "BinCapacity | None", chunks: int) -> "BinCapacity":
        """Give room for this and another, in powers of two, so that room soon grows no more; and
        for so many chunks.
        """
        more = BinCapacity(
            _ROW << (-(-self.pairs // _ROW) - 1).bit_length(),
            4 << (-(-self.blocks // 4) - 1).bit_length(),
            chunks,
        )
        return (
            more
            if other is None
            else BinCapacity(max(more.pairs, other.pairs), max(more.blocks, other.blocks), chunks)
        )


def round_up(count: int, step: int) -> int:
    """Round up to the next of sixteen steps per octave, and to a multiple of `step`, with 3% to
    spare.
    """
    count = int(count * 1.03) + 1
    grain = max(1 << max(count.bit_length() - 5, 0), step)
    return -(-count // grain) * grain


class Bins(eqx.Module):
    """Items per tile. An empty slot holds the number of items, which is no item."""

    ids: Int[Array, "blocks lanes slots"]
    order: Int[Array, " tiles"]
    """The tile of each lane, chunk after chunk."""
    first_block: Int[Array, " chunks_and_one"]
    needed: Float[Array, ""]
    places: int = eqx.field(static=True)
    """How many lanes, of the leading chunks, there is room for; what lies beyond has an empty list.
    """

    @property
    def chunks(self) -> Int[Array, ""]:
        """How many chunks have anything in them: longer lists come first, so these lead."""
        return jnp.minimum(_occupied(self.first_block), self.places // self.ids.shape[1])

    def poison(self, dtype: DTypeLike) -> Float[Array, ""]:
        """Give what is added to whatever is found: 0, or NaN where the lists lack room."""
        return jnp.where(self.needed <= 1, 0.0, jnp.nan).astype(dtype)

    def by_tile(
        self, swept: Float[Array, "places ..."], count: int, fill: float = 0
    ) -> Float[Array, "tiles ..."]:
        """Put what was found lane by lane in the order of the tiles; `fill` for empty ones."""
        lane = (
            jnp.zeros_like(self.order)
            .at[self.order]
            .set(jnp.arange(self.order.shape[0], dtype=jnp.int32))
        )
        return swept.at[lane[:count]].get(mode="fill", fill_value=fill)


def _occupied(first_block: Int[Array, " chunks_and_one"]) -> Int[Array, ""]:
    return jnp.sum(first_block[1:] > first_block[:-1], dtype=jnp.int32)


def _running_max(values: Int[Array, " pairs"]) -> Int[Array, " pairs"]:
    """Give the running maximum: columns in sequence, side by side."""
    columns = values.reshape(_ROW, -1).T

    def step(carry, value):
        carry = jnp.maximum(carry, value)
        return carry, carry

    last, columns = lax.scan(step, jnp.zeros(_ROW, values.dtype), columns)
    before = jnp.concatenate([jnp.zeros(1, values.dtype), lax.cummax(last)[:-1]])
    return jnp.maximum(columns, before[None]).T.reshape(-1)


def _pairs(ranges: TileRanges, grid: TileGrid, capacity: int):
    """List all pairs of item and tile, item after item; `grid.tiles` where there is none."""
    counts = ranges.across * ranges.down
    ends = jnp.cumsum(counts)
    begins, total = ends - counts, ends[-1]
    items = jnp.arange(counts.shape[0], dtype=jnp.int32)
    marks = (
        jnp.zeros(capacity, jnp.int32)
        .at[jnp.where(counts > 0, begins, capacity)]
        .max(items, mode="drop")
    )
    item = _running_max(marks)
    pair = jnp.arange(capacity, dtype=jnp.int32)

    def of_item(values):
        return values.at[item].get(mode="promise_in_bounds")

    corner = ranges.top * grid.across + ranges.left
    local, across = pair - of_item(begins), jnp.maximum(of_item(ranges.across), 1)
    down = ((local.astype(jnp.float32) + 0.5) / across.astype(jnp.float32)).astype(
        jnp.int32
    )  # exact below 4 million
    tile = of_item(corner) + local + down * (grid.across - across)
    return item, jnp.where(pair < total, tile, grid.tiles), jnp.sum(counts.astype(jnp.float32))


def _ranks(tile: Int[Array, " pairs"], tiles: int):
    """Number the pairs of each tile in order: rows are sorted apart, and counts carried from row to
    row.
    """
    place = jnp.arange(_ROW, dtype=jnp.uint32)[None]
    keys = (tile.astype(jnp.uint32).reshape(-1, _ROW) << _ROW_BITS) | place
    parts = jnp.array_split(keys, 2)  # a sort runs on one core; several run side by side
    keys = jnp.concatenate([lax.sort(part, dimension=1, is_stable=False) for part in parts])
    sorted_tile, source = (
        (keys >> _ROW_BITS).astype(jnp.int32),
        (keys & (_ROW - 1)).astype(jnp.int32),
    )
    rows = keys.shape[0]
    ends = jnp.concatenate(
        [sorted_tile[:, 1:] != sorted_tile[:, :-1], jnp.ones((rows, 1), bool)], axis=1
    )
    position = jnp.arange(_ROW, dtype=jnp.int32)[None]

    def earliest(carry, value):
        carry = jnp.minimum(carry, value)
        return carry, carry

    candidates = jnp.where(ends, position, _ROW).T
    run_end = lax.scan(earliest, jnp.full(rows, _ROW, jnp.int32), candidates, reverse=True)[1].T

    def count_on(counts, row):
        tiles_of_row, from_end = row
        counts = counts.at[tiles_of_row].add(1, mode="promise_in_bounds")
        return counts, counts.at[tiles_of_row].get(mode="promise_in_bounds") - from_end

    counts, rank = lax.scan(
        count_on, jnp.zeros(tiles + 1, jnp.int32), (sorted_tile, run_end - position + 1)
    )
    return sorted_tile, source, rank, counts[:tiles]


def bin_items(
    ranges: TileRanges,
    grid: TileGrid,
    capacity: BinCapacity,
    meet: Callable[[Int[Array, " pairs"], Int[Array, " pairs"]], Bool[Array, " pairs"]]
    | None = None,
) -> Bins:
    """List the items of every tile, in their order; if asked, only those that `meet` says the tile
    meets. Not differentiated.
    """
    items, lanes, slots, tiles = ranges.left.shape[0], grid.lanes, grid.slots, grid.tiles
    room = capacity.blocks * lanes * slots
    item, tile, total = _pairs(ranges, grid, capacity.pairs)
    if meet is not None:
        tile = jnp.where(meet(item, jnp.minimum(tile, tiles - 1)), tile, tiles)
    tile, source, rank, counts = _ranks(tile, tiles)
    item = jnp.take_along_axis(item.reshape(-1, _ROW), source, axis=1, mode="promise_in_bounds")

    # Longest lists first; equal ones in scan order, so that the lanes of a chunk are neighbors.
    lengths = -(-counts // slots)
    bits = (tiles - 1).bit_length()
    longest = (1 << (31 - bits)) - 1
    keys = ((longest - jnp.minimum(lengths, longest)) << bits) | jnp.arange(tiles, dtype=jnp.int32)
    order = lax.sort(keys, is_stable=False) & ((1 << bits) - 1)
    first_block = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(lengths[order[::lanes]])])
    lane = jnp.arange(tiles, dtype=jnp.int32)
    begins = first_block[lane // lanes] * (lanes * slots) + (lane % lanes) * slots
    begin_of_tile = jnp.full(tiles + 1, room, jnp.int32).at[order].set(begins)
    target = (
        begin_of_tile.at[tile].get(mode="promise_in_bounds")
        + (rank // slots) * (lanes * slots)
        + rank % slots
    )
    ids = jnp.full(room, items, jnp.int32).at[target.reshape(-1)].set(item.reshape(-1), mode="drop")
    blocks, chunks = first_block[-1].astype(jnp.float32), _occupied(first_block).astype(jnp.float32)
    needed = jnp.maximum(
        total / capacity.pairs, jnp.maximum(blocks / capacity.blocks, chunks / capacity.chunks)
    )
    return Bins(
        ids.reshape(capacity.blocks, lanes, slots),
        order,
        first_block,
        needed,
        capacity.chunks * lanes,
    )


def slot_plane(
    plane: Float[Array, " items"], fill: float, bins: Bins
) -> Float[Array, "blocks lanes slots"]:
    """Gather a number of the items into their slots; `fill` in empty slots."""
    return plane.at[bins.ids].get(mode="fill", fill_value=fill)


def scatter_slots(
    slots: Float[Array, "*blocks slots"], bins: Bins, items: int
) -> Float[Array, " items"]:
    """Add the slots of every item: the transpose of the gather."""
    return (
        jnp.zeros(items, slots.dtype).at[bins.ids.reshape(-1)].add(slots.reshape(-1), mode="drop")
    )
