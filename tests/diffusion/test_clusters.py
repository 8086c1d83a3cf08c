"""Merged splats keep what the far field needs, and their tree is nested."""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from splatjax.diffusion import BLOCK, Sources
from splatjax.diffusion._clusters import ClusterTree

CELLS, COUNT = [2.0, 4.0, 16.0], 800
levels_of = eqx.filter_jit(lambda tree, sources: tree.levels(sources))


def sources_and_tree(cells=CELLS):
    body, rng = bodies.bumpy(COUNT), np.random.default_rng(2)
    irradiance = jnp.asarray(rng.uniform(size=(2, COUNT)), float)
    sources = Sources(body.centers.T, body.normals.T, 0.01 * body.areas, irradiance)
    exists = np.arange(COUNT) % 16 > 0
    sources = eqx.tree_at(lambda s: s.areas, sources, jnp.where(exists, sources.areas, 0.0))
    given = np.asarray(body.centers), np.asarray(body.normals), exists
    return sources, ClusterTree.build(*given, cells)


def of_splats(tree):
    """The cluster of every splat at each level."""
    place = np.arange(COUNT)
    return [place := np.asarray(parents)[place] for parents in tree.parents]


def close(ours, theirs, tolerance):
    for found, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        scale = max(float(jnp.max(jnp.abs(expected))), 1e-3)
        np.testing.assert_allclose(found, expected, atol=tolerance * scale)


def test_merging_keeps_area_energy_and_second_moments():
    sources, tree = sources_and_tree()
    given = (sources.centers, sources.normals, sources.irradiance)
    centers, normals, irradiance = (np.asarray(each, float) for each in given)
    areas = np.asarray(sources.areas, float)
    splats, *levels = levels_of(tree, sources)
    np.testing.assert_array_equal(splats.areas, sources.areas)
    for clusters, place in zip(levels, of_splats(tree), strict=True):
        area = np.bincount(place, areas, len(clusters.areas))
        full = area > 0

        def mean(rows, place=place, area=area, full=full):
            sums = [np.bincount(place, areas * row, len(area)) for row in np.atleast_2d(rows)]
            return np.asarray(sums)[:, full] / area[full]

        np.testing.assert_allclose(clusters.areas, area, rtol=1e-5)
        for ours, rows in (
            (clusters.centers, centers),
            (clusters.normals, normals),
            (clusters.irradiance, irradiance),
        ):
            expected = mean(rows)
            ours = np.atleast_2d(ours)[:, full]
            np.testing.assert_allclose(ours, expected, rtol=1e-3, atol=1e-4)


def test_merging_twice_is_merging_once_and_lowering_is_merging_lowered_splats():
    sources, tree = sources_and_tree()
    levels, depth = levels_of(tree, sources), jnp.asarray(1.7)
    whole = jnp.asarray(of_splats(tree)[-1], jnp.int32)
    merged = eqx.filter_jit(lambda splats: splats.merged(whole, tree.counts[-1]))
    close(levels[-1], merged(levels[0]), 2e-4)
    below = eqx.tree_at(lambda s: s.centers, sources, sources.centers - depth * sources.normals)
    lowered = eqx.filter_jit(lambda levels: [each.lowered(depth) for each in levels])
    for ours, theirs in zip(lowered(levels), levels_of(tree, below), strict=True):
        close(ours, theirs, 3e-4)


def test_a_cluster_fills_no_more_than_its_cell_and_none_is_lost():
    sources, tree = sources_and_tree()
    centers, exists = np.asarray(sources.centers), np.asarray(sources.areas) > 0
    numbers = []
    for place, count, level in zip(of_splats(tree), tree.counts, range(3), strict=True):
        own = place[exists]
        numbers.append(len(np.unique(own)))
        assert numbers[-1] <= count <= 1.2 * numbers[-1] + BLOCK
        edge = sum(CELLS[: level + 1])  # a cell takes in all of the clusters whose centers it holds
        for cluster in np.unique(own)[::7]:
            extent = np.ptp(centers[:, exists][:, own == cluster], axis=1)
            assert np.all(extent <= edge * (1 + 1e-5))
    assert exists.sum() > numbers[0] > numbers[1] > numbers[2] >= 1
    larger = tree.with_capacity([count + BLOCK for count in tree.counts])
    for ours, theirs in zip(levels_of(larger, sources), levels_of(tree, sources), strict=True):
        np.testing.assert_allclose(jnp.sum(ours.areas), jnp.sum(sources.areas), rtol=1e-5)
        close(jax.tree.map(lambda a, b: a[..., : b.shape[-1]], ours, theirs), theirs, 1e-6)


def test_what_faces_the_other_way_is_in_a_cluster_of_its_own():
    rng = np.random.default_rng(4)
    across = np.concatenate([rng.uniform(0, 8, (200, 2))] * 2)
    side = np.repeat([1.0, -1.0], 200)
    centers = np.concatenate([across, 0.1 * side[:, None]], axis=1)
    normals = side[:, None] * np.asarray([0.0, 0.0, 1.0]) + rng.normal(scale=0.3, size=(400, 3))
    tree = ClusterTree.build(centers, normals, np.ones(400, bool), [3.0, 9.0])
    place = np.arange(400)
    for parents, cells in zip(tree.parents, (9, 1), strict=True):
        place = np.asarray(parents)[place]
        assert not set(place[:200]) & set(place[200:])
        assert len(set(place)) == 2 * cells
