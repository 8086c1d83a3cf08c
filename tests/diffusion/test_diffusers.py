"""Laws of the diffusion integral, and the fast diffuser against the plain one."""

from functools import cache

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from splatjax.diffusion._gathering import MeansAndExits

from splatjax.diffusion import ClusterDiffuser, DenseDiffuser, Kernels, Sources
from splatjax.splatting import DenseRasterizer, SplattingSettings

COUNT, SIZE = 3000, 64
VARIANCES = (1.0, 9.0, 20.0)
FOV = 32.0  # degrees; narrow enough that wide layers go through nodes
DEPTH = 0.75  # of a layer's source below its splat, in standard deviations
RESOLVED = (0.0, 0.0)  # an interval that hands no layer over
# All of the root mean square of a layer.
SUPPORT_ERROR = (
    5e-4  # beyond 4.5 standard deviations lie 4e-5 of the power; several times that in the dark
)
# Median, 99th percentile and maximum with default settings. The median is the product's goal; the
# others are those of a small picture, in which a layer changes much within two pixels of a
# silhouette.
MEDIAN, HIGH, LARGEST = 2e-3, 2e-2, 0.2
EXITS = 1.5  # times as much for the exits, of which a layer passes on the smaller part
OVERSHOOT = 1e-2  # continued slopes and moments may pass the extremes by this much of the range


def atlas_of(body, view):
    """The tiles that a view shows of a body, and what they show."""

    @jax.jit
    def look(body):
        nothing = jnp.zeros((0, body.count), body.centers.dtype)
        surfaces = bodies.drawn(body, nothing, view, SplattingSettings(), DenseRasterizer())
        both = surfaces.front, surfaces.behind
        return bodies.packed(
            jnp.stack([each.depth for each in both]),
            jnp.stack([each.weight_sum for each in both]),
            view,
        )

    return look(body)


@cache
def scene(x64: bool):
    """A bumpy body lit from the side, and the points that a view sees of it; in the precision under
    test.
    """
    body = bodies.bumpy(COUNT)
    atlas, points, covered = atlas_of(body, bodies.perspective(fov=FOV, width=SIZE, height=SIZE))
    side = jnp.maximum(body.normals @ jnp.asarray([0.8, 0.3, 0.52]), 0.0)
    texture = 0.5 + 0.4 * jnp.sin(0.9 * body.centers[:, 0]) * jnp.cos(0.7 * body.centers[:, 1])
    sources = Sources(body.centers.T, body.normals.T, body.areas, jnp.stack([side, texture]))
    return body, atlas, sources, points, covered


def in_front(x64: bool) -> np.ndarray:
    _, atlas, _, _, covered = scene(x64)
    return np.asarray(covered) & np.asarray(atlas.in_front)[:, None]


def kernels(factor=1.0):
    variances = factor * jnp.asarray(VARIANCES)
    return Kernels(variances, DEPTH * jnp.sqrt(variances))


def planned(body, atlas, **settings):
    return ClusterDiffuser(**settings).planned(body, kernels(), jnp.asarray(RESOLVED), [atlas])


def layers(diffuser, x64, irradiance=None):
    """Means, and last the exits, at the points of the front surface: `[gaussians, channels and one,
    points]`.
    """
    _, atlas, sources, points, covered = scene(x64)
    irradiance = sources.irradiance if irradiance is None else irradiance

    @jax.jit
    def run(irradiance):
        lit = Sources(sources.centers, sources.normals, sources.areas, irradiance)
        return diffuser.diffuse(lit, kernels(), points, covered, atlas)

    diffused = run(irradiance)
    assert float(diffused.needed) <= 1
    found = np.concatenate(
        [np.asarray(diffused.means), np.asarray(diffused.exits)[:, :, None]], axis=2
    ).transpose(1, 2, 0, 3)
    assert not np.any(found[:, :, ~np.asarray(covered)])
    return found[:, :, in_front(x64)]


@cache
def plain(x64):
    """The untruncated integral of the scene's irradiance, of a constant, of their sum, in one run;
    last the exits.
    """
    side, texture = scene(x64)[2].irradiance
    return layers(
        DenseDiffuser(),
        x64,
        jnp.stack([side, texture, jnp.full(COUNT, 0.37), 2 * side - 3 * texture]),
    )


def test_plain_integral_keeps_constants_lies_between_the_extremes_and_is_linear(x64):
    _, _, sources, _, _ = scene(x64)
    found = plain(x64)
    assert found.shape[2] > 700
    np.testing.assert_allclose(found[:, 2], 0.37, rtol=1e-5)
    np.testing.assert_allclose(found[:, 3], 2 * found[:, 0] - 3 * found[:, 1], atol=1e-5)
    for channel, values in enumerate(np.asarray(sources.irradiance)):
        assert found[:, channel].min() >= values.min() - 1e-6
        assert found[:, channel].max() <= values.max() + 1e-6


def test_plain_integral_is_the_formula(x64):
    _, _, sources, points, _ = scene(x64)
    x = np.asarray(points, float).transpose(1, 0, 2)[:, in_front(x64)][:, ::97]
    centers, normals, areas, irradiance = (
        np.asarray(each, float) for each in jax.tree.leaves(sources)
    )
    for k, variance in enumerate(VARIANCES):
        below = centers - DEPTH * np.sqrt(variance) * normals
        squared = np.sum((x[:, :, None] - below[:, None]) ** 2, axis=0)
        weight = areas * np.exp(-squared / (2 * variance))
        expected = (weight @ irradiance.T) / weight.sum(1, keepdims=True)
        np.testing.assert_allclose(plain(x64)[k, :2, ::97], expected.T, rtol=1e-5, atol=1e-6)
        flat = 2 * np.pi * variance * np.exp(-(DEPTH**2) / 2)
        np.testing.assert_allclose(plain(x64)[k, -1, ::97], weight.sum(1) / flat, rtol=1e-5)


@pytest.mark.parametrize(
    "approximation", [pytest.param("support alone", marks=pytest.mark.long), "default"]
)
def test_fast_diffuser_is_the_plain_one_within_its_stated_error(float32, approximation, x64):
    body, atlas, sources, _, _ = scene(x64)
    exact = approximation == "support alone"
    diffuser = planned(body, atlas, **({"error": 0.0} if exact else {}))
    assert diffuser.layers is not None
    if not exact:
        assert max(layer.level for layer in diffuser.layers) >= 2, "nothing is merged"
        assert sum(layer.nodes is not None for layer in diffuser.layers) >= 2, "no nodes"
    side, texture = sources.irradiance
    found = layers(diffuser, x64, jnp.stack([side, texture, jnp.full(COUNT, 0.37)]))
    np.testing.assert_allclose(found[:, 2], 0.37, rtol=1e-5, err_msg="constants are kept")
    for k in range(len(VARIANCES)):
        for channel in (0, 1, -1):
            ours, expected = found[k, channel], plain(x64)[k, channel]
            error = np.abs(ours - expected) / np.sqrt(np.mean(expected**2))
            if exact:
                assert error.max() < SUPPORT_ERROR, (k, channel)
            else:
                median, high = np.quantile(error, [0.5, 0.99])
                more = EXITS if channel == -1 else 1.0
                assert median < MEDIAN, (k, channel, median)
                assert high < more * HIGH, (k, channel, high)
                assert error.max() < more * LARGEST, (k, channel, error.max())
            if channel == -1:
                continue
            values = np.asarray(sources.irradiance[channel])
            slack = 1e-6 if exact else OVERSHOOT * np.ptp(values)
            assert ours.min() >= values.min() - slack
            assert ours.max() <= values.max() + slack


def thin_sheet(thickness=0.6):
    """Two faces, the front one lit: splats, and their sources."""
    front, back = (
        bodies.sheet(13.0, 0.75, normal=(0, 0, side), center=(0, 0, side * thickness / 2))
        for side in (1.0, -1.0)
    )
    splats = bodies.joined(front, back)
    x, y, z = splats.centers.T
    light = jnp.where(z > 0, 0.6 + 0.4 * jnp.sin(0.5 * x) * jnp.cos(0.4 * y), 0.0)
    return splats, Sources(splats.centers.T, splats.normals.T, splats.areas, light[None])


def test_the_two_faces_of_a_thin_sheet_are_not_merged(float32):
    """Their sources lie below each, on either side of the other: one cluster for both is off by a
    twentieth.
    """
    body, sources = thin_sheet()
    atlas, points, covered = atlas_of(body, bodies.perspective(fov=FOV, width=SIZE, height=SIZE))
    wide = Kernels(jnp.asarray([9.0]), jnp.asarray([DEPTH * 3.0]))
    diffuser = ClusterDiffuser().planned(body, wide, jnp.asarray(RESOLVED), [atlas])
    assert diffuser.layers[0].nodes is not None
    ours, plain = (
        jax.jit(lambda *given, each=each: each.diffuse(*given))(
            sources, wide, points, covered, atlas
        )
        for each in (diffuser, DenseDiffuser())
    )
    shown = np.asarray(covered & atlas.in_front[:, None])
    for found, expected in (
        (ours.means[:, 0, 0], plain.means[:, 0, 0]),
        (ours.exits[:, 0], plain.exits[:, 0]),
    ):
        found, expected = np.asarray(found)[shown], np.asarray(expected)[shown]
        error = np.abs(found - expected) / np.sqrt(np.mean(expected**2))
        assert np.median(error) < 2 * MEDIAN
        assert np.quantile(error, 0.99) < HIGH


def test_far_from_every_source_gradients_are_finite(x64):
    """As in a layer that is handed over: nothing reaches a point between splats."""
    _, atlas, sources, points, covered = scene(x64)
    narrow = jnp.asarray([1e-6, 1e-3])

    def total(kernels):
        found = DenseDiffuser().diffuse(sources, kernels, points[:9], covered[:9], atlas)
        return jnp.sum(found.exits) + jnp.sum(found.means)

    gradient = jax.jit(jax.grad(total))(Kernels(narrow, DEPTH * jnp.sqrt(narrow)))
    assert all(np.all(np.isfinite(np.asarray(leaf))) for leaf in jax.tree.leaves(gradient))


def test_where_nothing_gathers_there_is_neither_a_mean_nor_an_exit(dtype):
    sums = jnp.asarray(
        [[1.0, 0.0], [2.0, 0.0], [4.0, 0.0], [7.0, 9.0]], dtype
    )  # of two channels, and one row more
    values, rest = MeansAndExits(channels=2, moments=False).split(sums, jnp.zeros((3, 2), dtype))
    np.testing.assert_array_equal(values, [[0.25, 0.0], [0.5, 0.0], [4.0, 0.0]])
    np.testing.assert_array_equal(rest, [[7.0, 9.0]])


def test_outside_its_plan_the_diffuser_says_so(float64, x64):
    body, atlas, sources, points, covered = scene(x64)
    diffuser = planned(body, atlas)
    run = jax.jit(lambda d, k: d.diffuse(sources, k, points, covered, atlas).needed)
    assert float(run(diffuser, kernels(1.2))) <= 1
    assert float(run(diffuser, kernels(1.4))) > 1
    assert float(run(diffuser, kernels(0.7))) > 1


def test_a_nearer_camera_needs_more_than_planned(float64, x64):
    body, atlas, sources, points, covered = scene(x64)
    from_afar, _, _ = atlas_of(body, bodies.perspective(fov=120.0, width=SIZE, height=SIZE))
    diffuser = planned(body, from_afar, error=0.0)
    assert (
        float(
            jax.jit(lambda k: diffuser.diffuse(sources, k, points, covered, atlas).needed)(
                kernels()
            )
        )
        > 1
    )


def test_a_diffuser_without_clusters_and_one_for_other_layers_say_what_to_do(x64):
    body, atlas, sources, points, covered = scene(x64)
    with pytest.raises(ValueError, match="plan"):
        ClusterDiffuser().diffuse(sources, kernels(), points, covered, atlas)
    with pytest.raises(ValueError, match="3 Gaussians, not 2"):
        planned(body, atlas).diffuse(
            sources, jax.tree.map(lambda leaf: leaf[:2], kernels()), points, covered, atlas
        )
