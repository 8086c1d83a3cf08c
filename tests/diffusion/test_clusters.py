"""Merged splats keep what the far field needs, and their cells are nested. The orders and lists of
blocks that sums over sources rest on.
"""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.diffusion import POINTS_PER_BLOCK, Sources, _neighbors, compact_order
from splatjax.diffusion._clusters import SOURCES_PER_BLOCK, LayerSources
from splatjax.diffusion._neighbors import Boxes, find_neighbors

EDGES, COUNT = [0.0, 2.0, 4.0, 16.0], 800
DEPTHS = [0.1, 0.0, 0.2, 0.3]


def sources_and_tree():
    body, rng = bodies.bumpy(COUNT), np.random.default_rng(2)
    irradiance = jnp.asarray(rng.uniform(size=(2, COUNT)), float)
    exists = np.arange(COUNT) % 16 > 0
    areas = jnp.where(exists, 0.01 * body.areas, 0.0)
    sources = Sources(body.centers.T, body.normals.T, areas, irradiance)
    given = np.asarray(body.centers), np.asarray(body.normals), exists
    return sources, LayerSources.build(*given, EDGES)


def test_merging_keeps_areas_and_means():
    splats, layers = sources_and_tree()
    centers, normals, areas, irradiance = (
        np.asarray(each, float) for each in jax.tree.leaves(splats)
    )
    merge = eqx.filter_jit(lambda *given: LayerSources.merged(*given))
    merged = merge(layers, splats, jnp.asarray(DEPTHS))
    total, owner = np.zeros(layers.count), np.repeat(np.asarray(layers.layers), SOURCES_PER_BLOCK)
    for layer, (parents, depth) in enumerate(zip(np.asarray(layers.parents), DEPTHS, strict=True)):
        area = np.bincount(parents, areas, layers.count)
        full, total = area > 0, total + area
        assert np.all(owner[full] == layer)

        def mean(rows, parents=parents, area=area, full=full):
            sums = [np.bincount(parents, areas * row, len(area)) for row in rows]
            return np.asarray(sums)[:, full] / area[full]

        own = (merged.centers, centers - depth * normals), (merged.irradiance, irradiance)
        for ours, rows in own:
            np.testing.assert_allclose(ours[:, full], mean(rows), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(merged.areas, total, rtol=1e-5)


def test_a_cluster_fills_no_more_than_its_cell_and_none_is_lost():
    sources, layers = sources_and_tree()
    centers, exists = np.asarray(sources.centers), np.asarray(sources.areas) > 0
    numbers = []
    for layer, parents in enumerate(np.asarray(layers.parents)):
        own = parents[exists]
        numbers.append(len(np.unique(own)))
        edge = sum(EDGES[: layer + 1])  # a cell takes in all of the clusters whose centers it holds
        for cluster in np.unique(own)[::7]:
            extent = np.ptp(centers[:, exists][:, own == cluster], axis=1)
            assert np.all(extent <= edge * (1 + 1e-5))
    assert exists.sum() == numbers[0] > numbers[1] > numbers[2] > numbers[3] >= 1
    assert layers.count <= 1.5 * sum(numbers) + COUNT


def test_blocks_of_a_compact_order_are_small():
    points = bodies.unit(np.random.default_rng(1).normal(size=(4000, 3)))
    order = compact_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(4000))
    for size in (
        2 * POINTS_PER_BLOCK,
        POINTS_PER_BLOCK,
        POINTS_PER_BLOCK // 2,
        POINTS_PER_BLOCK // 4,
    ):
        blocks = points[order[: 4000 // size * size]].reshape(-1, size, 3)
        extent = np.max(np.ptp(blocks, axis=1), axis=1)
        even = np.sqrt(4 * np.pi * size / 4000)  # edge of a square with its share of the sphere
        assert np.median(extent) < 2 * even
        assert np.max(extent) < 5 * even


@pytest.mark.parametrize("at_once", [1 << 20, 40])
def test_neighbors_are_the_boxes_within_reach_each_once(at_once, monkeypatch):
    monkeypatch.setattr(_neighbors, "_AT_ONCE", at_once)
    count, reach = 26 * POINTS_PER_BLOCK, 1.5
    places = np.random.default_rng(3).uniform(-6, 6, (count, 3))
    centers = jnp.asarray(places[compact_order(places)].T, float)
    exists = jnp.arange(count) < count - POINTS_PER_BLOCK // 2
    points, sources = (
        Boxes.around(centers, exists, size) for size in (POINTS_PER_BLOCK, SOURCES_PER_BLOCK)
    )
    gaps = jnp.maximum(
        points.low[:, None] - sources.high[None], sources.low[None] - points.high[:, None]
    )
    expected = np.sum(np.maximum(gaps, 0) ** 2, axis=2) <= reach**2
    # The blocks of sources belong to two layers; of a third nothing is in reach.
    layers = np.where(np.arange(expected.shape[1]) < expected.shape[1] // 2, 0, 2)
    found = find_neighbors(points, sources, layers, [reach, 0.0, reach])
    lists = jax.tree.map(np.asarray, found)
    for layer, block in np.ndindex(3, len(expected)):
        near = np.flatnonzero(expected[block] & (layers == layer))
        own = layer * len(expected) + block
        row = lists.rows[lists.first[own] :][: lists.counts[own]].reshape(-1)
        np.testing.assert_array_equal(np.sort(row[row < len(layers)]), near)
