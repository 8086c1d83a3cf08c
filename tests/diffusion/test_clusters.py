"""Merged splats keep what the far field needs, and their tree is nested."""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from splatjax.diffusion import Sources
from splatjax.diffusion._order import BLOCK
from splatjax.diffusion._tree import ClusterTree

CELLS = [2.0, 4.0, 16.0]


def sources():
    body = bodies.bumpy(800)
    irradiance = np.random.default_rng(2).uniform(size=(2, 800))
    return Sources(
        body.centers.T, body.normals.T, 0.01 * body.areas, jnp.asarray(irradiance, float)
    )


@eqx.filter_jit
def levels_of(tree, sources):
    return tree.levels(sources)


def of_splats(tree, level):
    """The cluster of every splat at a level."""
    place = np.empty(800, int)
    order = np.asarray(tree.order)
    place[order[order < 800]] = np.flatnonzero(order < 800)
    for parents in tree.parents[: level + 1]:
        place = np.asarray(parents)[place]
    return place


def test_merging_keeps_area_energy_and_first_moments():
    given = sources()
    tree = ClusterTree.build(given.centers.T, given.normals.T, CELLS)
    levels = levels_of(tree, given)
    centers, areas, irradiance = (
        np.asarray(each, float) for each in (given.centers, given.areas, given.irradiance)
    )
    for level, clusters in enumerate(levels[1:]):
        place, count = of_splats(tree, level), tree.counts[level]

        def total(values, place=place, count=count):
            return np.bincount(place, values, count)

        area = total(areas)
        full = area > 0
        mean = np.stack([total(areas * axis) for axis in centers])[:, full] / area[full]
        np.testing.assert_allclose(np.asarray(clusters.areas), area, rtol=1e-5)
        np.testing.assert_allclose(np.asarray(clusters.centers)[:, full], mean, atol=1e-4)
        for channel, values in enumerate(irradiance):
            energy = np.asarray(clusters.areas * clusters.irradiance[channel])
            np.testing.assert_allclose(energy, total(areas * values), rtol=1e-5)
            for axis in range(3):
                expected = total(areas * values * centers[axis])
                found = energy * np.asarray(clusters.centers[axis]) + np.asarray(
                    clusters.moments[channel, axis]
                )
                np.testing.assert_allclose(found, expected, atol=1e-5 * np.max(areas) * 800 * 10)
        offset = centers - np.asarray(clusters.centers, float)[:, place]
        spread = total(areas * 0.5 * np.sum(offset**2, axis=0))[full] / area[full]
        np.testing.assert_allclose(np.asarray(clusters.spread)[full], spread, rtol=1e-3, atol=1e-5)


def _whole(tree):
    place = np.arange(len(tree.order))
    for parents in tree.parents:
        place = np.asarray(parents)[place]
    return jnp.asarray(place, jnp.int32)


def test_merging_twice_is_merging_once():
    given = sources()
    tree = ClusterTree.build(given.centers.T, given.normals.T, CELLS)
    splats, *_, step_by_step = levels_of(tree, given)
    at_once = eqx.filter_jit(lambda splats, parents: splats.merged(parents, tree.counts[2]))(
        splats, _whole(tree)
    )
    for ours, theirs in zip(jax.tree.leaves(step_by_step), jax.tree.leaves(at_once), strict=True):
        np.testing.assert_allclose(
            np.asarray(ours), np.asarray(theirs), atol=2e-4 * np.max(np.abs(theirs))
        )


def test_lowering_clusters_is_merging_lowered_splats():
    given, depth = sources(), 1.7
    tree = ClusterTree.build(given.centers.T, given.normals.T, CELLS)
    below = Sources(
        given.centers - depth * given.normals, given.normals, given.areas, given.irradiance
    )
    lowered = eqx.filter_jit(lambda levels: [each.lowered(jnp.asarray(depth)) for each in levels])(
        levels_of(tree, given)
    )
    for ours, theirs in zip(lowered, levels_of(tree, below), strict=True):
        for found, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            scale = max(np.max(np.abs(expected)), 1e-3)
            np.testing.assert_allclose(np.asarray(found), np.asarray(expected), atol=3e-4 * scale)


def test_a_cluster_fills_no_more_than_its_cell():
    given = sources()
    tree = ClusterTree.build(given.centers.T, given.normals.T, CELLS)
    centers = np.asarray(given.centers)
    numbers = []
    for level in range(len(CELLS)):
        place = of_splats(tree, level)
        numbers.append(len(np.unique(place)))
        assert numbers[-1] <= tree.counts[level] <= 1.2 * numbers[-1] + BLOCK
        edge = sum(CELLS[: level + 1])  # a cell takes in all of the clusters whose centers it holds
        for cluster in np.unique(place)[::7]:
            assert np.all(np.ptp(centers[:, place == cluster], axis=1) <= edge * (1 + 1e-5))
    assert 800 > numbers[0] > numbers[1] > numbers[2] >= 1


def test_no_cells_merge_nothing():
    given = sources()
    tree = ClusterTree.build(given.centers.T, given.normals.T, [])
    (only,) = levels_of(tree, given)
    order = np.asarray(tree.order)
    np.testing.assert_array_equal(np.sort(order[order < 800]), np.arange(800))
    np.testing.assert_array_equal(
        np.asarray(only.areas)[order < 800], np.asarray(given.areas)[order[order < 800]]
    )
    assert not np.any(np.asarray(only.areas)[order == 800])
    assert not np.any(np.asarray(only.spread))


def test_what_faces_the_other_way_is_in_a_cluster_of_its_own():
    rng = np.random.default_rng(4)
    across = np.concatenate([rng.uniform(0, 8, (200, 2))] * 2)
    side = np.repeat([1.0, -1.0], 200)
    centers = np.concatenate([across, 0.1 * side[:, None]], axis=1)
    normals = side[:, None] * np.asarray([0.0, 0.0, 1.0]) + rng.normal(scale=0.3, size=(400, 3))
    tree = ClusterTree.build(jnp.asarray(centers), jnp.asarray(normals), [3.0, 9.0])
    place = np.arange(len(tree.order))
    for parents, cells in zip(tree.parents, (9, 1), strict=True):
        place = np.asarray(parents)[place]
        mine = np.empty(400, int)
        mine[np.asarray(tree.order)[:400]] = place[:400]
        assert not set(mine[:200]) & set(mine[200:])
        assert len(set(mine)) == 2 * cells
