"""Laws of the diffusion integral at the splats, and the fast diffuser against the plain one, in
value and gradient.
"""

import dataclasses
from functools import cache

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from splatjax._combination import DeviceMesh
from splatjax.diffusion import (
    POINTS_PER_BLOCK,
    ClusterDiffuser,
    DenseDiffuser,
    EscapeNormalization,
    Sources,
    _neighbors,
    compact_order,
    dense_layer,
)
from splatjax.scene import Splats

COUNT, VARIANCES = 48 * POINTS_PER_BLOCK, (1.0, 9.0, 12.0)
KERNEL = EscapeNormalization()
RESOLVED = jnp.asarray([0.0, 1e-3])  # an interval that resolves every layer
# All of the root mean square of a layer. Beyond 4.5 standard deviations lie 4e-5 of the power;
# several times that in the dark.
SUPPORT_ERROR = 5e-4
# Median, 99th percentile and maximum at the splats. The light of a cluster is its mean: on a body
# as small as three standard deviations of the widest layer, half of its points err by 4e-3.
MEDIAN, HIGH, LARGEST = 4.5e-3, 1.5e-2, 3e-2
# float64: the same sums in another order; and central differences with a step of 1e-6.
VALUE, GRADIENT, DIFFERENCES = 1e-10, 1e-8, 1e-5


def in_order(body: Splats) -> Splats:
    order = compact_order(np.asarray(body.centers))
    return jax.tree.map(lambda leaf: leaf[order], body)


def sources_of(body: Splats, irradiance) -> Sources:
    return Sources(body.centers.T, body.normals.T, body.areas, jnp.asarray(irradiance, float))


@cache
def scene(count=COUNT) -> tuple[Splats, Sources]:
    """A bumpy body lit from the side, textured, evenly, and by a mixture of the first two."""
    body = in_order(bodies.bumpy(count))
    side = jnp.maximum(body.normals @ jnp.asarray([0.8, 0.3, 0.52]), 0.0)
    texture = 0.5 + 0.4 * jnp.sin(0.9 * body.centers[:, 0]) * jnp.cos(0.7 * body.centers[:, 1])
    mixed = 2 * side - 3 * texture
    return body, sources_of(body, jnp.stack([side, texture, jnp.full(count, 0.37), mixed]))


def planned(diffuser, body: Splats, variances=VARIANCES):
    return diffuser.make_plan(body, jnp.asarray(variances), KERNEL, RESOLVED)


@eqx.filter_jit
def run(plan, sources, variances):
    diffused = plan.diffuse(sources, variances, KERNEL, DeviceMesh())
    # Without layers that only fill up; here all others are resolved.
    return jax.tree.map(lambda rows: rows[: len(variances)], diffused.layers), diffused.needed


def sources_per_layer(plan) -> list[int]:
    parents = np.asarray(plan.sources.parents)[: len(plan.variances)]
    return [len(np.unique(of_layer)) for of_layer in parents]


@cache
def plain(count=COUNT):
    body, sources = scene(count)
    return run(planned(DenseDiffuser(), body), sources, jnp.asarray(VARIANCES))[0]


def errors(ours, theirs) -> np.ndarray:
    ours, theirs = np.asarray(ours, float), np.asarray(theirs, float)
    return np.abs(ours - theirs) / np.sqrt(np.mean(theirs**2))


def stacked(layers):
    return jnp.concatenate([layers.values[:, :, None], layers.slopes], axis=2)


def by_formula(sources, variances, largest):
    """Compute values and slopes of layers at the splats, over the sources up to the largest
    exponents.
    """
    found = []
    light = jnp.concatenate([sources.irradiance, jnp.ones((1, len(sources.areas)))])
    for end, variance in zip(largest, variances, strict=True):
        depth = KERNEL.depth * jnp.sqrt(variance)
        below = sources.centers - depth * sources.normals
        offset = below[:, None] - sources.centers[:, :, None]
        exponent = 0.5 * jnp.sum(offset * offset, axis=0) / variance
        # Fading over the last half of an exponent.
        fade = jnp.clip(2 * (end - exponent), 0, 1)
        weight = jnp.exp(-exponent) * fade * sources.areas[None]
        cut = 2 * jnp.exp(-end) * np.expm1(0.5)
        flat = 2 * jnp.pi * variance * (jnp.exp(-0.5 * depth**2 / variance) - cut)
        sums, pulls = light @ weight.T, jnp.einsum("cj,aij,ij->cai", light, offset, weight)
        means = sums[:-1] / sums[-1:]
        # By the quotient rule.
        slopes = (pulls[:-1] - means[:, None] * pulls[-1:]) / sums[-1][None, None]
        values = jnp.concatenate([means, sums[-1:] / flat])
        slopes = jnp.concatenate([slopes, pulls[-1:] / flat]) / variance
        found.append(jnp.concatenate([values[:, None], slopes], axis=1))
    return jnp.stack(found)


@pytest.mark.once
def test_plain_integral_is_the_formula():
    largest = jnp.full(3, jnp.inf)
    expected = jax.jit(by_formula)(scene()[1], jnp.asarray(VARIANCES), largest)
    scale = np.max(np.abs(expected), axis=(1, 3), keepdims=True)
    np.testing.assert_allclose(stacked(plain()) / scale, expected / scale, atol=2e-5)


@pytest.mark.once
@pytest.mark.parametrize(("error", "at_once"), [(0.0, 40), (2e-3, 1 << 13)])
def test_fast_diffuser_is_the_plain_one_within_its_stated_error(error, at_once, monkeypatch):
    """And both keep constants, are linear, and lie between the least and the greatest light. What
    is near is sought among all at once, or among a few.
    """
    monkeypatch.setattr(_neighbors, "_AT_ONCE", at_once)
    body, sources = scene()
    plan = planned(ClusterDiffuser(error=error), body)
    first, second, third = sources_per_layer(plan)
    assert first == body.count
    assert first > second > third if error else first == second == third
    fast, needed = run(plan, sources, jnp.asarray(VARIANCES))
    assert 0 < float(needed) <= 1
    light = np.asarray(sources.irradiance)
    for values in (np.asarray(fast.values), np.asarray(plain().values)):
        np.testing.assert_allclose(values[:, 2], 0.37, rtol=1e-5)
        np.testing.assert_allclose(values[:, 3], 2 * values[:, 0] - 3 * values[:, 1], atol=1e-5)
        assert np.all(values[:, :4].min(axis=(0, 2)) >= light.min(axis=1) - 1e-5)
        assert np.all(values[:, :4].max(axis=(0, 2)) <= light.max(axis=1) + 1e-5)
    for k in range(len(VARIANCES)):
        for row in (0, 1, -1):
            off = errors(fast.values[k, row], plain().values[k, row])
            found = np.quantile(off, [0.5, 0.99, 1])
            largest = LARGEST if error else SUPPORT_ERROR
            assert np.all(found < [MEDIAN, HIGH, largest]), (k, row, found)


@pytest.mark.once
def test_the_two_faces_of_a_thin_sheet_are_not_merged():
    """Their sources lie below each, on either side of the other: one cluster for both is off by a
    twentieth.
    """
    faces = [bodies.sheet(11.625, 0.75, (0, 0, side), (0, 0, 0.3 * side)) for side in (1.0, -1.0)]
    body = in_order(bodies.joined(*faces))
    x, y, z = body.centers.T
    light = jnp.where(z > 0, 0.6 + 0.4 * jnp.sin(0.5 * x) * jnp.cos(0.4 * y), 0.0)
    variances, sources = jnp.asarray([9.0]), sources_of(body, light[None])
    plan = planned(ClusterDiffuser(), body, variances)
    assert sources_per_layer(plan)[0] < 0.5 * body.count
    fast, dense = (
        run(each, sources, variances)[0].values[0]
        for each in (plan, planned(DenseDiffuser(), body, variances))
    )
    for ours, theirs in zip(fast, dense, strict=True):
        assert np.all(np.quantile(errors(ours, theirs), [0.5, 0.99]) < [MEDIAN, HIGH])


def test_gradients_are_those_of_the_plain_sum_over_the_sources_within_the_support(float64):
    """With `error=0` nothing is merged, and what is left out is known to the last source: so the
    fast sums are held to rounding. Forward mode too.
    """
    body, sources = scene(8 * POINTS_PER_BLOCK)
    variances = jnp.asarray([0.6, 9.0])
    # The most that the plan holds for.
    plan = planned(ClusterDiffuser(error=0.0), body, variances / 1.25)
    rng = np.random.default_rng(4)
    factors = jnp.asarray(rng.normal(size=(2, 5, 4, body.count)))

    def fast(sources, variances, plan=plan):
        return stacked(plan.diffuse(sources, variances, KERNEL, DeviceMesh()).layers)

    def within_support(sources, variances):
        return by_formula(sources, variances, plan.kernels.largest)

    def both(function):
        total = lambda *given: (jnp.vdot(factors, value := function(*given)), value)  # noqa: E731
        return jax.jit(jax.value_and_grad(total, argnums=(0, 1), has_aux=True))(sources, variances)

    ((_, ours), d_ours), ((_, theirs), d_theirs) = both(fast), both(within_support)
    np.testing.assert_allclose(ours, theirs, atol=VALUE * float(jnp.max(jnp.abs(theirs))))
    for found, expected in zip(jax.tree.leaves(d_ours), jax.tree.leaves(d_theirs), strict=True):
        np.testing.assert_allclose(found, expected, atol=GRADIENT * float(jnp.max(abs(expected))))
    _, derivative = jax.jit(
        lambda *given: plan.diffuse_with_derivative(*given, KERNEL, DeviceMesh())
    )(sources, variances)
    of_variances = jax.jit(lambda v: jax.jvp(lambda v: within_support(sources, v), (v,), (v,))[1])
    expected = of_variances(variances)
    scale = GRADIENT * float(jnp.max(jnp.abs(expected)))
    np.testing.assert_allclose(stacked(derivative.layers), expected, atol=scale)


def test_gradients_through_clusters_are_those_of_differences(float64):
    body, sources = scene(16 * POINTS_PER_BLOCK)
    variances = jnp.asarray([20.0, 60.0])
    plan = planned(ClusterDiffuser(), body, variances)
    # So wide a support that no difference steps over its rim.
    plan = dataclasses.replace(plan, kernels=KERNEL.truncated(np.full(2, 7.0)))
    first, second = sources_per_layer(plan)
    assert body.count > first > second
    factors = jnp.asarray(np.random.default_rng(1).normal(size=(2, 5, body.count)))

    @jax.jit
    def total(sources, logarithms):
        layers = plan.diffuse(sources, jnp.exp(logarithms), KERNEL, DeviceMesh()).layers
        return jnp.vdot(factors, layers.values)

    given = sources, jnp.log(variances)
    check_grads(total, given, 1, ["rev"], atol=DIFFERENCES, rtol=DIFFERENCES, eps=1e-6)


@pytest.mark.once
def test_far_from_every_source_gradients_are_finite():
    """As in an unresolved layer: nothing reaches a point between splats."""
    _, sources = scene(8 * POINTS_PER_BLOCK)
    points = 1.01 * sources.centers[:, :9]

    def total(variance):
        layer = dense_layer(sources, points, variance, KERNEL.depth * jnp.sqrt(variance))
        return jnp.sum(layer.values) + jnp.sum(layer.slopes)

    for variance in (1e-6, 1e-3):
        assert np.isfinite(jax.jit(jax.grad(total))(jnp.asarray(variance)))


@pytest.mark.once
def test_outside_its_plan_the_diffuser_reports_it():
    body, sources = scene(8 * POINTS_PER_BLOCK)
    plan = planned(ClusterDiffuser(), body)

    def needed(factor=1.0, stretch=1.0):
        moved = dataclasses.replace(sources, centers=stretch * sources.centers)
        return float(run(plan, moved, factor * jnp.asarray(VARIANCES))[1])

    assert max(needed(1.2), needed(0.82), needed(stretch=1.005)) <= 1
    assert min(needed(1.4), needed(0.7), needed(stretch=1.2)) > 1


@pytest.mark.once
def test_blocks_of_a_compact_order_are_small():
    points = bodies.unit(np.random.default_rng(1).normal(size=(4000, 3)))
    order = compact_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(4000))
    for size in (int(POINTS_PER_BLOCK * share) for share in (2, 1, 0.5, 0.25)):
        blocks = points[order[: 4000 // size * size]].reshape(-1, size, 3)
        even = np.sqrt(4 * np.pi * size / 4000)  # edge of a square with its share of the sphere
        extent = np.max(np.ptp(blocks, axis=1), axis=1) / even
        assert np.all(np.quantile(extent, [0.5, 1]) < [2, 5])
