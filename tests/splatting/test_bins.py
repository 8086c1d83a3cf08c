"""Lists per tile against every pair tried one by one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting import (
    BinCapacity,
    TileGrid,
    TileRanges,
    bin_items,
    scatter_slots,
    slot_plane,
)

GRID = TileGrid(61, 45, lanes=4, slots=4)
COUNT = 900


def boxes(kind):
    rng = np.random.default_rng(11)
    middle, half = (
        rng.uniform(-10, 70, (2, COUNT)),
        np.exp(rng.uniform(np.log(0.1), np.log(30.0), (2, COUNT))),
    )
    if kind == "all in one tile":
        middle, half = rng.uniform(17, 23, (2, COUNT)), np.full((2, COUNT), 0.9)
    if kind == "off screen":
        middle, half = rng.uniform(-90, -40, (2, COUNT)), np.full((2, COUNT), 20.0)
    if kind == "infinite":
        half = np.where(rng.uniform(size=half.shape) < 0.05, np.inf, half)
    return (
        middle[0] - half[0],
        middle[0] + half[0],
        middle[1] - half[1],
        middle[1] + half[1],
        rng.uniform(size=COUNT) < 0.9,
    )


def brute_force(left, right, top, bottom, visible):
    """Every item with a pixel center of the tile inside its box."""
    pairs = set()
    for tile in range(GRID.across * GRID.down):
        columns = (
            np.arange(tile % GRID.across * 8, min(tile % GRID.across * 8 + 8, GRID.width)) + 0.5
        )
        rows = (
            np.arange(tile // GRID.across * 8, min(tile // GRID.across * 8 + 8, GRID.height)) + 0.5
        )
        in_x = ((columns >= left[:, None]) & (columns <= right[:, None])).any(1)
        in_y = ((rows >= top[:, None]) & (rows <= bottom[:, None])).any(1)
        pairs |= {(tile, int(item)) for item in np.nonzero(in_x & in_y & visible)[0]}
    return pairs


@jax.jit
def ranges_of(left, right, top, bottom, visible):
    return TileRanges.of(left, right, top, bottom, visible, GRID)


def listed(bins):
    """The lists of a `Bins`, tile by tile, in order."""
    ids, order, first = np.asarray(bins.ids), np.asarray(bins.order), np.asarray(bins.first_block)
    lists = {}
    for place, tile in enumerate(order):
        chunk, lane = divmod(place, GRID.lanes)
        row = ids[first[chunk] : first[chunk + 1], lane].reshape(-1)
        lists[int(tile)] = row[row < COUNT].tolist()
    return lists


KINDS = ("scattered", "all in one tile", "off screen", "infinite")


def every_kind():
    given = [boxes(kind) for kind in KINDS]
    ranges = [
        ranges_of(*(jnp.asarray(each, float) for each in box[:4]), jnp.asarray(box[4]))
        for box in given
    ]
    return given, ranges


@jax.jit
def per_tile(ranges):
    return ranges.per_tile(GRID)


def test_lists_hold_exactly_the_pairs_of_brute_force_in_order():
    given, ranges = every_kind()
    capacity = BinCapacity.for_counts([per_tile(each) for each in ranges], GRID)
    binned = jax.jit(lambda r: bin_items(r, GRID, capacity))
    for kind, box, item_ranges in zip(KINDS, given, ranges, strict=True):
        bins = binned(item_ranges)
        lists = listed(bins)
        expected = brute_force(*box)
        assert {(tile, item) for tile, items in lists.items() for item in items} == expected, kind
        assert sum(map(len, lists.values())) == len(expected), f"{kind}: a pair is listed twice"
        assert all(items == sorted(items) for items in lists.values()), kind
        assert 0 <= float(bins.needed) <= 1
        counts = np.asarray(per_tile(item_ranges))
        assert [len(lists[tile]) for tile in range(GRID.tiles)] == counts.tolist(), kind


@pytest.mark.parametrize(
    "short", [{"pairs": 1024}, {"blocks": 1}, {"chunks": 1}], ids=lambda short: next(iter(short))
)
def test_too_small_a_capacity_is_reported(short):
    _, ranges = every_kind()
    enough = BinCapacity.for_counts([per_tile(each) for each in ranges], GRID)
    capacity = BinCapacity(
        **({"pairs": enough.pairs, "blocks": enough.blocks, "chunks": enough.chunks} | short)
    )
    needed = float(jax.jit(lambda r: bin_items(r, GRID, capacity))(ranges[3]).needed)
    assert needed > 1


def test_scatter_is_the_transpose_of_the_gather(dtype):
    _, ranges = every_kind()
    capacity = BinCapacity.for_counts([per_tile(ranges[0])], GRID)

    @jax.jit
    def both_ways(values, slots):
        bins = bin_items(ranges[0], GRID, capacity)
        gathered = slot_plane(values, 0.0, bins)
        return jnp.vdot(gathered, slots), jnp.vdot(values, scatter_slots(slots, bins, COUNT))

    rng = np.random.default_rng(1)
    values = jnp.asarray(rng.normal(size=COUNT), dtype)
    slots = jnp.asarray(rng.normal(size=(capacity.blocks, GRID.lanes, GRID.slots)), dtype)
    np.testing.assert_allclose(*both_ways(values, slots), rtol=1e-4)


def test_tiles_are_cut_and_joined():
    picture = jnp.asarray(np.random.default_rng(2).normal(size=(3, GRID.height, GRID.width)), float)
    tiles = GRID.cut(picture)
    assert tiles.shape == (GRID.count, 3, 64)
    np.testing.assert_array_equal(np.asarray(GRID.join(tiles)), np.asarray(picture))
    within = GRID.within_picture()
    assert within.sum() == GRID.width * GRID.height
    assert not np.any(np.asarray(tiles)[np.broadcast_to(~within[:, None], tiles.shape)])
    assert TileGrid(64, 48).within_picture() is None


def test_pixels_are_numbered_tile_by_tile():
    x, y = np.meshgrid(np.arange(GRID.width), np.arange(GRID.height))
    numbers = np.asarray(GRID.cut(jnp.asarray(np.stack([x, y]), float)), int)
    found = np.asarray(GRID.pixel(jnp.asarray(x), jnp.asarray(y))).reshape(-1)
    for row, expected in enumerate((x, y)):
        np.testing.assert_array_equal(numbers[:, row].reshape(-1)[found], expected.reshape(-1))
