"""Sums over blocks of sources against plain sums; orders and lists that they rest on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.diffusion._gaussian_sums import (
    Steps,
    as_they_are,
    faded,
    gaussian_sums,
    gaussian_sums_forward,
    source_table,
    tapered,
)
from splatjax.diffusion._neighbors import Boxes, Neighbors
from splatjax.diffusion._order import BLOCK, compact_order

SOURCES, ROWS, POINTS, SLOTS = 96, 3, 16, 2


def total_and_square(sums, points):
    """A finish that mixes rows and needs the points."""
    return jnp.stack([sums[0] * points[1] + sums[2], sums[1] ** 2])


def problem(dtype):
    rng = np.random.default_rng(4)
    centers = jnp.asarray(rng.uniform(-3, 3, (3, SOURCES)), dtype)
    rates = jnp.asarray(rng.uniform(0.3, 1.2, SOURCES), dtype)
    rows = jnp.asarray(rng.normal(size=(ROWS, SOURCES)), dtype)
    points = jnp.asarray(rng.uniform(-3, 3, (5, 3, POINTS)), dtype)
    return centers, rates, rows, points


def plain(points, centers, rates, rows, kernel, finish):
    def block(x):
        offset = x[:, None] - centers[:, :, None]
        return finish(rows @ kernel(rates[:, None] * jnp.sum(offset * offset, axis=0))[0], x)

    return jax.vmap(block)(points)


def all_meet(blocks: int, points_blocks: int) -> Steps:
    """Lists of everything, in two sweeps of three lanes; the last lane has no points of its own."""
    lanes, steps = 3, -(-blocks // SLOTS)
    ids = np.full((2 * steps, lanes, SLOTS), blocks, np.int32)
    ids.reshape(2, steps, lanes, SLOTS)[:] = np.pad(
        np.arange(blocks), (0, -blocks % SLOTS), constant_values=blocks
    ).reshape(1, steps, 1, SLOTS)
    order = np.asarray([4, 0, 2, 1, 3, 5], np.int32)
    assert points_blocks == 5
    return Steps(
        jnp.asarray(ids),
        jnp.asarray([0, steps], jnp.int32),
        jnp.asarray([steps, 2 * steps], jnp.int32),
        jnp.asarray(order),
    )


@pytest.mark.parametrize("finish", [as_they_are, total_and_square])
@pytest.mark.parametrize("kernel", [faded(4.0), tapered(2.0)], ids=["faded", "tapered"])
def test_values_and_gradients_are_those_of_plain_sums(float64, kernel, finish):
    with jax.enable_x64(True):
        centers, rates, rows, points = problem(jnp.float64)
        steps = all_meet(SOURCES // 16, 5)
        padded = jnp.pad(points, ((0, 1), (0, 0), (0, 0)), constant_values=-1e6)

        def ours(points, centers, rates, rows, sums=gaussian_sums):
            return sums(points, source_table(centers, rates, rows, 16), steps, kernel, finish)[:5]

        def theirs(*given):
            return plain(*given, kernel, finish)

        expected, pull = jax.vjp(theirs, points, centers, rates, rows)
        found, push = jax.vjp(
            lambda points, *rest: ours(jnp.concatenate([points, padded[5:]]), *rest),
            points,
            centers,
            rates,
            rows,
        )
        cotangent = jnp.asarray(np.random.default_rng(6).normal(size=expected.shape))
        assert float(jnp.max(jnp.abs(expected))) > 0.5
        np.testing.assert_allclose(found, expected, atol=1e-12)
        for a, b in zip(push(cotangent), pull(cotangent), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-11 * float(jnp.max(jnp.abs(b))))
        rng = np.random.default_rng(7)
        moved = [jnp.asarray(rng.normal(size=each.shape)) for each in (centers, rates, rows)]
        _, slope = jax.jvp(
            lambda *rest: ours(padded, *rest, sums=gaussian_sums_forward),
            (centers, rates, rows),
            tuple(moved),
        )
        _, expected = jax.jvp(
            lambda *rest: theirs(points, *rest), (centers, rates, rows), tuple(moved)
        )
        np.testing.assert_allclose(slope, expected, atol=1e-11 * float(jnp.max(jnp.abs(expected))))


@pytest.mark.parametrize("kernel", [faded(3.0), tapered(3.0)], ids=["faded", "tapered"])
def test_kernels_come_down_to_zero_without_a_step(kernel, float64):
    exponents = jnp.linspace(0, 6, 60_001)
    weight, fall = kernel(exponents)
    assert float(weight[0]) > 0.9
    assert np.all(np.asarray(weight)[exponents >= 4.5] == 0)
    assert np.all(np.diff(np.asarray(weight)) <= 0)
    rise = (
        np.cumsum((np.asarray(fall)[1:] + np.asarray(fall)[:-1]) / 2) * 1e-4
    )  # what its derivative says it falls by
    np.testing.assert_allclose(weight[0] - weight[1:], rise, atol=1e-5)


def test_a_taper_comes_down_with_its_derivative():
    _, fall = tapered(3.0)(jnp.asarray([4.5 * (1 - 1e-5), 4.6]))
    assert np.all(np.abs(np.asarray(fall)) < 1e-5)


def test_blocks_of_a_compact_order_are_small():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    order = compact_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(4000))
    for size in (BLOCK, BLOCK // 4, BLOCK // 8):
        blocks = points[order[: 4000 // size * size]].reshape(-1, size, 3)
        extent = np.max(np.ptp(blocks, axis=1), axis=1)
        even = np.sqrt(4 * np.pi * size / 4000)  # edge of a square with its share of the sphere
        assert np.median(extent) < 2 * even
        assert np.max(extent) < 5 * even


def test_neighbors_are_all_blocks_within_reach_and_moving_too_far_is_told(float32):
    rng = np.random.default_rng(2)
    centers = rng.uniform(-5, 5, (640, 3))
    centers = jnp.asarray(centers[compact_order(centers)].T, jnp.float32)
    there = jnp.arange(640) < 600
    points, sources = Boxes.around(centers, there, BLOCK), Boxes.around(centers, there, 16)
    reach = 2.0
    found = Neighbors.find(points, sources, reach, 4, SLOTS)
    listed = [set() for _ in range(12)]
    for sweep, (begin, end) in enumerate(
        zip(found.steps.begins.tolist(), found.steps.ends.tolist(), strict=True)
    ):
        for lane in range(4):
            listed[sweep * 4 + lane] = set(
                np.asarray(found.steps.ids)[begin:end, lane].ravel().tolist()
            ) - {40}
    apart = np.linalg.norm(np.asarray(centers)[:, :, None] - np.asarray(centers)[:, None], axis=0)
    for block in range(10):
        rows = np.arange(block * BLOCK, min((block + 1) * BLOCK, 600))
        near = {int(j) // 16 for j in np.flatnonzero(np.min(apart[rows], axis=0)[:600] <= reach)}
        assert near <= listed[block]
        assert len(listed[block]) < 40
    assert float(found.needed(points, sources, jnp.asarray(reach, jnp.float32))) <= 1 + 1e-6
    moved = Boxes.around(centers + 0.2, there, BLOCK)
    assert float(found.needed(moved, sources, jnp.asarray(1.5, jnp.float32))) <= 1
    assert float(found.needed(moved, sources, jnp.asarray(1.8, jnp.float32))) > 1
