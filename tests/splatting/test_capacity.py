"""Room that is planned: enough, little more than that, and of few different sizes."""

import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting import BinCapacity, TileGrid, round_up


@pytest.mark.parametrize("step", [1, 4, 1024])
def test_rounding_up_leaves_three_percent_and_takes_few_sizes(step):
    counts = np.arange(0, 40_000, 7)
    found = np.asarray([round_up(int(count), step) for count in counts])
    assert np.all(found >= 1.03 * counts - 1)
    assert np.all(found > counts)
    assert np.all(found <= 1.03 * counts * (1 + 1 / 16) + step + 2)
    assert np.all(found % step == 0)
    octave = found[(counts > 16_384) & (counts < 32_768)]
    assert len(np.unique(octave)) <= 17


def test_room_is_for_the_longest_list_of_every_chunk():
    grid = TileGrid(64, 64, lanes=4, slots=8)  # 64 tiles
    counts = np.zeros(64, int)
    counts[[3, 9, 17, 40, 41]] = 100, 20, 9, 9, 1  # chunks of 13 and 1 blocks
    room = BinCapacity.for_counts([jnp.asarray(counts), jnp.asarray(counts[::-1] // 2)], grid)
    assert (room.pairs, room.blocks, room.chunks) == (
        round_up(139, 1024),
        round_up(14, 4),
        round_up(2, 4),
    )
    assert BinCapacity.for_counts([jnp.ones(64, int)], grid).chunks == 16  # no more than there are
    nothing = BinCapacity.for_counts([jnp.zeros(64, int)], grid)
    assert (nothing.pairs, nothing.blocks, nothing.chunks) == (
        round_up(1, 1024),
        round_up(1, 4),
        round_up(1, 4),
    )


def test_room_grows_by_doubling():
    small, large = BinCapacity(1024, 4, 4), BinCapacity(3 * 1024, 20, 8)
    assert small.grown(None, 5) == BinCapacity(1024, 4, 5)
    assert large.grown(None, 5) == BinCapacity(4096, 32, 5)
    assert large.grown(BinCapacity(1024, 64, 9), 5) == BinCapacity(4096, 64, 5)
    assert BinCapacity(1025, 5, 1).grown(small, 1) == BinCapacity(2048, 8, 1)
    assert BinCapacity(4096, 16, 1).grown(small, 1) == BinCapacity(4096, 16, 1)
