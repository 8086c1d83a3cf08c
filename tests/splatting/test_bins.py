"""Lists per tile against every pair tried one by one; their capacity; pixels in tiles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting import (
    BinCapacity,
    TileGrid,
    TileRanges,
    bin_items,
    round_up,
)

GRID = TileGrid(61, 45, lanes=4, slots=4)
COUNT = 900
KINDS = ("scattered", "all in one tile", "off screen", "infinite")


def boxes(kind):
    """Left, right, top, bottom of items, and which are visible."""
    rng = np.random.default_rng(11)
    middle = rng.uniform(-10, 70, (2, COUNT))
    half = np.exp(rng.uniform(np.log(0.1), np.log(30.0), (2, COUNT)))
    if kind == "all in one tile":
        middle, half = rng.uniform(17, 23, (2, COUNT)), np.full((2, COUNT), 0.9)
    if kind == "off screen":
        middle, half = rng.uniform(-90, -40, (2, COUNT)), np.full((2, COUNT), 20.0)
    if kind == "infinite":
        half = np.where(rng.uniform(size=half.shape) < 0.05, np.inf, half)
    (left, top), (right, bottom) = middle - half, middle + half
    return left, right, top, bottom, rng.uniform(size=COUNT) < 0.9


def brute_force(left, right, top, bottom, visible):
    """Every tile and item with a pixel center of the tile inside the item's box."""
    tiles = np.arange(GRID.count, dtype=np.int32)
    x, y = (np.asarray(each) + 0.5 for each in GRID.columns_and_rows(jnp.asarray(tiles)))
    x, y = np.where(GRID.within_picture(), x, np.nan), y
    column, row = (each[:, None] for each in (x, y))
    in_x = (column >= left[:, None]) & (column <= right[:, None])
    in_y = (row >= top[:, None]) & (row <= bottom[:, None])
    return set(zip(*np.nonzero(np.any(in_x & in_y, axis=2) & visible), strict=True))


@jax.jit
def ranges_of(left, right, top, bottom, visible):
    ranges = TileRanges.of(left, right, top, bottom, visible, GRID)
    return ranges, ranges.per_tile(GRID)


def every_kind():
    given = [boxes(kind) for kind in KINDS]
    return given, [ranges_of(*(jnp.asarray(each) for each in box)) for box in given]


def lists_of(bins):
    """The list of each tile, in order."""
    ids, first = np.asarray(bins.ids), np.asarray(bins.first_block)
    lists = {}
    for place, tile in enumerate(np.asarray(bins.order).tolist()):
        chunk, lane = divmod(place, GRID.lanes)
        row = ids[first[chunk] : first[chunk + 1], lane].reshape(-1)
        lists[tile] = row[row < COUNT].tolist()
    return lists


def test_lists_hold_exactly_the_pairs_of_brute_force_in_order():
    given, ranges = every_kind()
    capacity = BinCapacity.for_counts([counts for _, counts in ranges], GRID)
    binned = jax.jit(lambda each: bin_items(each, GRID, capacity))
    for kind, box, (item_ranges, counts) in zip(KINDS, given, ranges, strict=True):
        bins = binned(item_ranges)
        lists = lists_of(bins)
        pairs = [(tile, item) for tile, items in lists.items() for item in items]
        assert sorted(pairs) == sorted(brute_force(*box)), kind
        assert all(items == sorted(items) for items in lists.values()), kind
        assert [len(lists[tile]) for tile in range(GRID.tiles)] == counts.tolist(), kind
        assert 0 <= float(bins.needed) <= 1


@pytest.mark.parametrize("short", [{"pairs": 1024}, {"blocks": 1}, {"chunks": 1}], ids=str)
def test_too_small_a_capacity_is_reported(short):
    _, ranges = every_kind()
    enough = BinCapacity.for_counts([counts for _, counts in ranges], GRID)
    named = {name: getattr(enough, name) for name in ("pairs", "blocks", "chunks")} | short
    needed = jax.jit(lambda each: bin_items(each, GRID, BinCapacity(**named)).needed)
    assert float(needed(ranges[3][0])) > 1


@pytest.mark.parametrize("step", [1, 4, 1024])
def test_rounding_up_leaves_three_percent_and_takes_few_sizes(step):
    counts = np.arange(0, 40_000, 7)
    rounded = np.asarray([round_up(int(count), step) for count in counts])
    assert np.all((rounded >= 1.03 * counts - 1) & (rounded > counts) & (rounded % step == 0))
    assert np.all(rounded <= 1.03 * counts * (1 + 1 / 16) + step + 2)
    assert len(np.unique(rounded[(counts > 16_384) & (counts < 32_768)])) <= 17


def test_pixels_are_numbered_tile_by_tile():
    x, y = np.meshgrid(np.arange(GRID.width), np.arange(GRID.height))
    picture = jnp.asarray(np.stack([x, y]), float)
    tiles = GRID.cut(picture)
    np.testing.assert_array_equal(GRID.join(tiles), picture)
    within = GRID.within_picture()
    assert within.sum() == x.size
    assert not np.any(np.asarray(tiles).transpose(0, 2, 1)[~within])
    assert TileGrid(64, 48).within_picture() is None
    numbers = np.asarray(GRID.pixel(jnp.asarray(x), jnp.asarray(y))).reshape(-1)
    for row, expected in enumerate((x, y)):
        np.testing.assert_array_equal(
            np.asarray(tiles)[:, row].reshape(-1)[numbers], expected.ravel()
        )
