"""Layers of the splats, blended and continued to points of the surface."""

from functools import cache

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.diffusion import (
    EscapeNormalization,
    LayersAtPoints,
    LayerValues,
    PlainMean,
    Sources,
    continue_from_splats,
    continue_to_points,
    dense_layer,
    resolved_fraction,
)
from splatjax.gaussians import SumOfGaussians
from splatjax.splatting import DenseRasterizer, SplattingSettings

COUNT, RADIUS, SIZE = 3000, 10.0, 24
SPACING = RADIUS * (4 * np.pi / COUNT) ** 0.5
# Median, 99th percentile and maximum of the error of a blended layer, of its root mean square.
GOAL = 2e-3, 1e-2, 3e-2


@cache
def blended_and_exact():
    """Return a function of a variance: the layer blended at the pixels of a picture, and computed
    there.
    """
    body = bodies.sphere(COUNT, RADIUS, jitter=0.0)
    view = bodies.perspective(fov=20.0, width=SIZE, height=SIZE)
    settings = SplattingSettings()
    plan = DenseRasterizer().make_plan([body], [view], settings)
    x, y, z = body.centers.T
    shadowed = jnp.where(x + 2 * jnp.sin(y) > 0, jnp.maximum(z / RADIUS, 0), 0)
    light = jnp.stack([shadowed, 0.7 + 0.3 * jnp.sin(1.5 * x) * jnp.sin(y)])
    sources = Sources(body.centers.T, body.normals.T, body.areas, light)

    @jax.jit
    def evaluate(variance):
        depth = EscapeNormalization().depth * jnp.sqrt(variance)
        layer = dense_layer(sources, sources.centers, variance, depth)
        rows = continue_from_splats(layer, sources.centers)
        rows = jnp.concatenate([rows.values, rows.slopes.reshape(9, -1), sources.centers])
        front = bodies.drawn(body, rows, view, settings, plan).front
        pixels = jnp.mgrid[:SIZE, :SIZE][::-1].astype(rows.dtype) + 0.5
        points = view.unproject(*pixels, front.depth).reshape(3, -1)
        values, slopes, centers = jnp.split(front.attributes.reshape(15, -1), [3, 12])
        blended = LayerValues(values, slopes.reshape(3, 3, -1))
        exact = dense_layer(sources, points, variance, depth)
        found, _ = continue_to_points(blended, None, centers, points, channels=2)
        return found, exact.values

    return evaluate


@pytest.mark.parametrize("width", [1.4, 2.0, 3.7])
def test_blended_layers_of_evenly_spread_splats_meet_the_goal(width):
    both = blended_and_exact()(jnp.asarray((width * SPACING) ** 2))
    for ours, theirs in zip(*(np.asarray(each) for each in both), strict=True):
        error = np.abs(ours - theirs) / np.sqrt(np.mean(theirs**2))
        found = *np.quantile(error, [0.5, 0.99]), error.max()
        assert np.all(np.asarray(found) < GOAL), (width, found)


def test_a_linear_layer_is_continued_exactly_whatever_the_weights():
    """Half of the slope of each splat, and half of the mean slope from the mean center."""
    rng = np.random.default_rng(3)
    centers, point = rng.normal(size=(3, 40)), rng.normal(size=(3, 1))
    weights, slope = rng.uniform(size=(40, 1)), rng.normal(size=(2, 3))
    slopes = np.broadcast_to(slope[:, :, None], (2, 3, 40))
    layer = LayerValues(*(jnp.asarray(each, float) for each in (10 + slope @ centers, slopes)))
    centers, point, weights = (jnp.asarray(each, float) for each in (centers, point, weights))
    rows = continue_from_splats(layer, centers)
    blended = jax.tree.map(lambda leaf: leaf @ (weights / jnp.sum(weights)), rows)
    mean_center = centers @ (weights / jnp.sum(weights))
    found, _ = continue_to_points(blended, None, mean_center, point, channels=1)
    np.testing.assert_allclose(found, 10 + slope @ np.asarray(point), rtol=1e-4)
    # Far away it stays between 0 and twice the middle, and its derivative is that of the limit.
    for way in (1, -1):
        far = mean_center + 1e3 * way * jnp.asarray(slope[:1].T, float)
        found, derivative = continue_to_points(blended, blended, mean_center, far, channels=1)
        middle = 10 + slope[:1] @ np.asarray(mean_center)
        np.testing.assert_allclose(found[:1], 2 * middle if way > 0 else 0, rtol=1e-4)
        np.testing.assert_array_equal(derivative, found)


def layers_at_points(kernel):
    """Layers of which the last is in reach of no splat at one of the points."""
    rng = np.random.default_rng(5)
    variances, weights = jnp.asarray([0.05, 0.5, 4.0]), [[0.2, 0.3], [0.3, 0.1], [0.4, 0.2]]
    rows = rng.uniform(0.4, 1.4, (3, 3, 7))
    rows[2, -1, 3] = 0
    slopes = rng.normal(size=(3, 3, 7))
    source, albedo = rng.uniform(0.2, 1.0, (2, 2, 7))
    area = rng.uniform(0.3, 1.0, 7)
    layers, slopes = (list(jnp.asarray(each, float)) for each in (rows, slopes))
    given = (jnp.asarray(each, float) for each in (source, area, albedo))
    interval = jnp.asarray([0.4, 2.2])
    at = LayersAtPoints.of(variances, layers, slopes, *given, interval, kernel)
    return at, SumOfGaussians(variances, jnp.asarray(weights))


def test_unresolved_layers_are_the_irradiance_of_the_surface():
    """In between, the mass is counted by the fraction that is resolved."""
    at, gaussians = layers_at_points(EscapeNormalization())
    once = jnp.asarray([0.02, 0.05])
    layers, resolved = eqx.filter_jit(at.weigh)(gaussians, once)
    share = resolved_fraction(at.variances[:, None], at.area[None], at.interval)
    share = jnp.where(at.mass > 0, share, 0.0)
    assert len(np.unique(share)) > 6
    np.testing.assert_allclose(resolved, share, atol=1e-6)
    mixed = share[:, None] * at.means + (1 - share)[:, None] * at.irradiance[None]
    gain = at.kernel.gain(
        (share * at.mass + 1 - share)[:, None],
        at.variances,
        gaussians.weights[:, :, None] * at.albedo[None],
        once[:, None] * at.albedo,
    )
    np.testing.assert_allclose(layers, gain * mixed, rtol=1e-5)


@pytest.mark.parametrize("kernel", [PlainMean(), EscapeNormalization()])
def test_the_jacobian_of_the_exitance_is_its_derivative(float64, kernel):
    """Weights and variances by automatic differentiation of the exitance, which follows the means
    and the mass by their derivatives.
    """
    at, gaussians = layers_at_points(kernel)
    of_weights, of_variances = eqx.filter_jit(at.exitance_jacobian)(gaussians, jnp.zeros(2))
    expected = eqx.filter_jit(jax.jacrev(lambda given: at.exitance(given)))(gaussians)
    rows = jnp.stack([expected.weights[c, :, :, c] for c in (0, 1)], axis=1).transpose(2, 1, 0)
    np.testing.assert_allclose(of_weights, rows, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(of_variances, expected.variances.transpose(2, 0, 1), atol=1e-10)
