"""Merged splats keep what the far field needs, and their tree is nested."""

import bodies
import equinox as eqx
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


def test_merging_keeps_areas_and_means():
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
            sums = [np.bincount(place, areas * row, len(area)) for row in rows]
            return np.asarray(sums)[:, full] / area[full]

        np.testing.assert_allclose(clusters.areas, area, rtol=1e-5)
        merged = clusters.centers, clusters.normals, clusters.irradiance
        for ours, rows in zip(merged, (centers, normals, irradiance), strict=True):
            np.testing.assert_allclose(ours[:, full], mean(rows), rtol=1e-3, atol=1e-4)


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
