"""Sums over blocks of sources against plain sums; the orders and lists of blocks they rest on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.diffusion import BLOCK, _neighbors, compact_order
from splatjax.diffusion._gaussian_sums import (
    SourceTable,
    gaussian_sums,
    gaussian_sums_forward,
)
from splatjax.diffusion._kernel import TruncatedGaussian
from splatjax.diffusion._neighbors import SOURCES, Boxes, Neighbors, find_neighbors

COUNT, REACH = 26 * BLOCK, 1.5


def squares_and_products(sums, points):
    """A finish that mixes rows and needs the points."""
    return jnp.stack([sums[0] * points[1] + sums[2], sums[1] ** 2])


def blocks_in_space(count=COUNT):
    centers = np.random.default_rng(3).uniform(-6, 6, (count, 3))
    return jnp.asarray(centers[compact_order(centers)].T, float)


def test_values_and_derivatives_are_those_of_plain_sums(float64):
    """In reverse mode and in forward mode; lanes without points included."""
    rng, kernel = np.random.default_rng(4), TruncatedGaussian(4.0)
    points, centers = blocks_in_space(5 * BLOCK), blocks_in_space(3 * BLOCK)
    rows = jnp.asarray(rng.normal(size=(3, 3 * BLOCK)))
    boxes = (
        Boxes.around(each, jnp.ones(each.shape[1], bool), n)
        for each, n in ((points, BLOCK), (centers, SOURCES))
    )
    lists = find_neighbors(*boxes, 4.0**0.5)

    def ours(points, *sources, sums=gaussian_sums):
        blocks = points.reshape(3, -1, BLOCK).transpose(1, 0, 2)
        found = sums(blocks, SourceTable.of(*sources, SOURCES), lists, kernel, squares_and_products)
        return found.transpose(1, 0, 2).reshape(found.shape[1], -1)

    def plain(points, centers, rows):
        offset = points[:, None] - centers[:, :, None]
        weights, _ = kernel(jnp.sum(offset * offset, axis=0))
        return squares_and_products(rows @ weights, points)

    given = points, centers, rows
    (found, push), (expected, pull) = (jax.vjp(each, *given) for each in (ours, plain))
    assert float(jnp.max(jnp.abs(expected))) > 0.5
    np.testing.assert_allclose(found, expected, atol=1e-12)
    cotangent = jnp.asarray(rng.normal(size=expected.shape))
    for a, b in zip(push(cotangent), pull(cotangent), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-11 * float(jnp.max(jnp.abs(b))))
    ways = tuple(jnp.asarray(rng.normal(size=each.shape)) for each in given)
    (_, a), (_, b) = (
        jax.jvp(each, given, ways)
        for each in (lambda *g: ours(*g, sums=gaussian_sums_forward), plain)
    )
    np.testing.assert_allclose(a, b, atol=1e-11 * float(jnp.max(jnp.abs(b))))


def test_blocks_of_a_compact_order_are_small():
    points = np.random.default_rng(1).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    order = compact_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(4000))
    for size in (2 * BLOCK, BLOCK, BLOCK // 2, BLOCK // 4):
        blocks = points[order[: 4000 // size * size]].reshape(-1, size, 3)
        extent = np.max(np.ptp(blocks, axis=1), axis=1)
        even = np.sqrt(4 * np.pi * size / 4000)  # edge of a square with its share of the sphere
        assert np.median(extent) < 2 * even
        assert np.max(extent) < 5 * even


@pytest.mark.parametrize("at_once", [1 << 20, 40])
def test_neighbors_are_the_boxes_within_reach_each_once(at_once, monkeypatch):
    """Also where few boxes are tested at one go."""
    monkeypatch.setattr(_neighbors, "_AT_ONCE", at_once)
    centers, exists = blocks_in_space(), jnp.arange(COUNT) < COUNT - BLOCK // 2
    points, sources = (Boxes.around(centers, exists, size) for size in (BLOCK, SOURCES))
    gaps = jnp.maximum(
        points.low[:, None] - sources.high[None], sources.low[None] - points.high[:, None]
    )
    expected = np.sum(np.maximum(gaps, 0) ** 2, axis=2) <= REACH**2
    lists = jax.tree.map(np.asarray, find_neighbors(points, sources, REACH))
    for block, near in enumerate(expected):
        row = lists.rows[lists.first[block] :][: lists.counts[block]].reshape(-1)
        np.testing.assert_array_equal(np.sort(row[row < len(near)]), np.flatnonzero(near))


def test_what_has_moved_needs_as_much_more_reach():
    centers, exists = blocks_in_space(2 * BLOCK), jnp.arange(2 * BLOCK) < 3 * BLOCK // 2

    def around(points):
        return Boxes.around(points, exists, BLOCK // 2)

    boxes, reach = around(centers), jnp.asarray(REACH)
    planned = Neighbors(find_neighbors(boxes, boxes, REACH), boxes, boxes, reach)
    shift = jnp.asarray([[0.1], [-0.03], [0.07]])
    for of_points, of_sources, moved in ((0.0, 0.0, 0.0), (1.0, 0.0, 0.1), (1.0, -2.0, 0.3)):
        ends = around(centers + of_points * shift), around(centers + of_sources * shift)
        needed = planned.needed(*ends, 0.8 * reach)
        np.testing.assert_allclose(needed, 0.8 + 3**0.5 * moved / REACH, rtol=1e-5)
