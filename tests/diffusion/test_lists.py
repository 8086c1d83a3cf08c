"""Which blocks of sources meet which blocks of points: every pair within reach, and no pair that
the boxes keep apart.
"""

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splatjax.diffusion._pixels import Pixels
from splatjax.diffusion._tree import blocks_of
from test_diffusers import atlas_of

from splatjax.diffusion import _neighbors
from splatjax.diffusion._neighbors import Boxes, Neighbors
from splatjax.diffusion._order import BLOCK, compact_order
from splatjax.splatting import SIDE, BinCapacity

LANES, SLOTS, REACH = 5, 3, 1.5


def boxes_of(points, block):
    cut = np.asarray(points, float).reshape(3, -1, block)
    return cut.min(axis=2), cut.max(axis=2)


def gaps(one, other):
    """Squared distances of all boxes from all others."""
    (low, high), (low_b, high_b) = one, other
    apart = np.maximum(low[:, :, None] - high_b[:, None], low_b[:, None] - high[:, :, None])
    return np.sum(np.maximum(apart, 0) ** 2, axis=0)


@pytest.mark.parametrize("at_once", [1 << 20, 40])
def test_neighbors_are_the_boxes_within_reach_each_once(at_once, monkeypatch):
    """More blocks of sources than are tested at one go, and more of points than lanes."""
    monkeypatch.setattr(_neighbors, "_AT_ONCE", at_once)
    centers = np.random.default_rng(3).uniform(-6, 6, (BLOCK * 26, 3))
    centers = jnp.asarray(centers[compact_order(centers)].T, float)
    there = np.ones(centers.shape[1], bool)
    points, sources = Boxes.around(centers, there, BLOCK), Boxes.around(centers, there, BLOCK // 4)
    expected = gaps(boxes_of(centers, BLOCK), boxes_of(centers, BLOCK // 4)) <= REACH**2
    steps = jax.tree.map(np.asarray, Neighbors.find(points, sources, REACH, LANES, SLOTS).steps)
    blocks, none = expected.shape
    assert len(steps.begins) == -(-blocks // LANES)
    np.testing.assert_array_equal(steps.order, np.arange(len(steps.begins) * LANES))
    for place in range(blocks):
        sweep, lane = divmod(place, LANES)
        row = steps.ids[steps.begins[sweep] : steps.ends[sweep], lane].reshape(-1)
        np.testing.assert_array_equal(np.sort(row[row < none]), np.flatnonzero(expected[place]))
    # As many steps as the longest list of each sweep has, and little room beyond.
    longest = [
        -(-expected[i : i + LANES].sum(axis=1).max() // SLOTS) for i in range(0, blocks, LANES)
    ]
    np.testing.assert_array_equal(steps.ends - steps.begins, longest)
    assert sum(longest) <= len(steps.ids) <= 1.1 * sum(longest) + 1


def test_what_has_moved_needs_as_much_more_reach():
    centers = jnp.asarray(np.random.default_rng(4).uniform(-6, 6, (3, 2 * BLOCK)), float)
    there = jnp.arange(2 * BLOCK) < 3 * BLOCK // 2  # the last block is empty in part
    boxes = Boxes.around(centers, there, BLOCK // 2)
    found = Neighbors.find(boxes, boxes, REACH, LANES, SLOTS)
    reach = jnp.asarray(1.2)

    def needed(points, sources):
        moved = (Boxes.around(each, there, BLOCK // 2) for each in (points, sources))
        return float(found.needed(*moved, reach))

    shift = jnp.asarray([[0.1], [-0.03], [0.07]])
    np.testing.assert_allclose(needed(centers, centers), 1.2 / REACH, rtol=1e-5)
    np.testing.assert_allclose(
        needed(centers + shift, centers), (1.2 + 3**0.5 * 0.1) / REACH, rtol=1e-5
    )
    np.testing.assert_allclose(
        needed(centers + shift, centers - 2 * shift), (1.2 + 3**0.5 * 0.3) / REACH, rtol=1e-5
    )
    middle = jnp.mean(jnp.where(there, centers, 0.0), axis=1, keepdims=True)
    assert (
        needed(0.9 * (centers - middle) + middle, centers) <= 1.2 / REACH + 0.2
    )  # what draws together moves as well


def test_tiles_list_the_blocks_within_reach_of_what_they_show():
    body = bodies.bumpy(32 * 16)
    order = compact_order(np.asarray(body.centers))
    centers = body.centers[order].T
    view = bodies.perspective(fov=32.0, width=44, height=36)
    atlas, points, covered = atlas_of(body, view)
    origin = jnp.asarray([0.4, -0.3, 0.2])
    pixels = Pixels.of(points, covered, origin, atlas)
    there, reach = jnp.arange(512) % 37 > 0, jnp.linspace(0.4, 1.6, 512)
    bins = jax.jit(
        lambda reach: pixels.bins(
            centers - origin[:, None], there, reach, 16, 4, BinCapacity(8192, 400, 2)
        )
    )(reach)
    assert float(bins.needed) <= 1
    steps = jax.tree.map(np.asarray, pixels.steps(bins, 32))
    listed = np.zeros((points.shape[0] + 1, 32), bool)
    for place, tile in enumerate(steps.order):
        sweep, lane = divmod(place, bins.ids.shape[1])
        row = steps.ids[steps.begins[sweep] : steps.ends[sweep], lane].reshape(-1)
        assert np.all(row <= 32)
        assert len(set(row[row < 32])) == np.sum(row < 32), "a block is listed twice"
        listed[tile, row[row < 32]] = True
    inside = [np.asarray(each) for each in (points, covered, there, reach, centers)]
    for tile, (shown, seen) in enumerate(zip(inside[0], inside[1], strict=True)):
        assert shown.shape == (3, SIDE**2)
        apart = (
            np.linalg.norm(inside[4][:, :, None] - shown[:, None, seen], axis=0)
            if seen.any()
            else np.full((512, 1), np.inf)
        )
        near = (inside[2] & np.any(apart <= inside[3][:, None], axis=1)).reshape(32, 16).any(axis=1)
        assert not np.any(near & ~listed[tile]), "a block within reach is missing"
        if seen.any():
            own = shown[:, seen].min(axis=1)[:, None], shown[:, seen].max(axis=1)[:, None]
            cut = [
                np.where(inside[2], inside[4], far).reshape(3, 32, 16) for far in (np.inf, -np.inf)
            ]
            far = (
                gaps(own, (cut[0].min(axis=2), cut[1].max(axis=2)))[0]
                > 1.0001 * inside[3].reshape(32, 16).max(axis=1) ** 2
            )
            assert not np.any(far & listed[tile]), "a block out of reach is listed"
        else:
            assert not listed[tile].any()
    assert not listed[-1].any()


def test_rounding_up_to_blocks():
    for count in (0, 1, BLOCK - 1, BLOCK, BLOCK + 1, 10 * BLOCK + 3):
        assert blocks_of(count) % BLOCK == 0
        assert max(count, 1) <= blocks_of(count) < max(count, 1) + BLOCK
