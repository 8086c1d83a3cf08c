"""The kernel of pass 4: where it ends, which layers are resolved, and the laws of its gain; sheets
against Monte Carlo. Layers of the splats, blended and continued to points of the surface.
"""

import dataclasses

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

import splatjax as sj
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
    unevenness,
)

KERNEL = EscapeNormalization()
IN_FLOAT32 = 5e-4  # of the polynomial, at the widest support
# Six Gaussians on the reflectance of half spaces of sigma_t = 1/mm, isotropic scattering, no change
# of index; albedo 0.9, 0.98 and 0.998. `fit_gaussians` on four million walks, non-negative, totals
# held.
VARIANCES = np.asarray([0.01265, 0.0577, 0.2458, 1.1161, 5.3668, 36.784])
WEIGHTS = np.asarray(
    [
        [0.02739, 0.03848, 0.08084],
        [0.05131, 0.05521, 0.05484],
        [0.08196, 0.09944, 0.10425],
        [0.12977, 0.16921, 0.17898],
        [0.08900, 0.20930, 0.25600],
        [0.03544, 0.09939, 0.20445],
    ]
)
# What a sheet of so many mm lets through of light from straight above, that which never met it left
# out: 400,000 walks. And by how much the Gaussians may be off.
THROUGH = {
    2.0: ([0.2198, 0.3138, 0.3433], 0.12),
    4.0: ([0.1096, 0.2290, 0.2828], 0.16),
    8.0: ([0.0156, 0.0880, 0.1627], 0.25),
}


# Path-traced by Mitsuba 3: radiance of spheres in even light over that of one of radius 400. Mean
# free path 1, albedo 0.9, 0.98 and 0.998, eta 1.4; and the Gaussians of that medium.
SPHERES = {
    10.0: [1.238, 1.270, 1.185],
    20.0: [1.114, 1.129, 1.132],
    40.0: [1.060, 1.062, 1.071],
}
SPHERE_GAUSSIANS = np.asarray(
    [
        [0.0805, 0.08782, 0.09922, 0.10319],
        [0.9814, 0.07519, 0.10586, 0.11242],
        [4.5161, 0.07515, 0.15165, 0.18258],
        [15.8463, 0.01959, 0.13114, 0.20317],
        [57.9639, 0.0, 0.03031, 0.14982],
        [254.0539, 0.0, 0.0, 0.05028],
    ]
)


@eqx.filter_jit
def gains(mass, weights, variances=VARIANCES, once=0.0, kernel=KERNEL):
    weights, variances = jnp.asarray(weights, float), jnp.asarray(variances, float)
    mass = jnp.broadcast_to(jnp.asarray(mass, float), variances.shape)[:, None]
    return kernel.gain(mass, variances, weights, jnp.full(weights.shape[1], once))


def returned(mass, weights, *given):
    return np.sum(weights * np.asarray(gains(mass, weights, *given)), axis=0)


WHITE = WEIGHTS / WEIGHTS.sum(axis=0)


@pytest.mark.parametrize("support", [3.75, 4.5])
def test_the_kernel_falls_to_zero_without_a_step(support, float64):
    kernel = KERNEL.truncated(np.array([support]))
    exponents = jnp.linspace(0, 12, 120_001)
    weight, fall = (np.asarray(each)[0] for each in kernel(exponents[None]))
    assert np.all(weight[exponents >= kernel.largest] == 0)
    assert np.all(np.diff(weight) <= 0)
    np.testing.assert_allclose(weight[:60_000], np.exp(-exponents[:60_000]), rtol=1e-12)
    integral = np.cumsum((fall[1:] + fall[:-1]) / 2) * 1e-4
    np.testing.assert_allclose(weight[0] - weight[1:], integral, atol=1e-5)
    # Its integral over a plane.
    power = np.sum(weight) * 1e-4
    np.testing.assert_allclose(kernel.integral(jnp.zeros(1)), power, rtol=1e-4)
    in_float32 = [each[0] for each in kernel(exponents[None].astype(jnp.float32))]
    bodies.assert_close(in_float32, (weight, fall), atol=IN_FLOAT32)


@pytest.mark.once
def test_what_lies_beyond_the_support_is_half_of_the_error():
    for error, share in ((2e-3, 1.0), (2e-3, 0.1), (1e-2, 1.0), (0.0, 1.0)):
        beyond = np.exp(-0.5 * KERNEL.support(error, share) ** 2)
        assert 0.6 < beyond / min(max(0.5 * error / share, 4e-5), 0.1) < 1.7


def test_resolved_fraction_rises_smoothly_from_none_to_all(float64):
    interval, area = jnp.asarray([1.2, 2.4]), jnp.asarray(0.25)
    variances = jnp.linspace(0.1, 1.5, 1401)
    share = jax.value_and_grad(lambda variance: resolved_fraction(variance, area, interval))
    values, slopes = jax.jit(jax.vmap(share))(variances)
    assert np.all(values[variances < 0.3599] == 0)
    assert np.all(values[variances > 1.4401] == 1)
    assert np.all(slopes >= 0)
    assert np.all((values > 0) & (values < 1), where=(variances > 0.361) & (variances < 1.439))
    bend = 6 / 1.08**2
    assert np.max(np.abs(np.diff(slopes))) < bend * 1.01 * 1.4 / 1400, "the slope jumps"


@pytest.mark.once
def test_unevenness_distinguishes_grids_from_scattered_splats(dtype):
    assert float(unevenness(bodies.sheet(10.0, 0.5))) < 1e-3
    assert float(unevenness(bodies.sheet(10.0, 0.5, jitter=0.25))) > 0.1
    # The standard deviation over the mean, of every sixth splat: areas in other units change
    # nothing.
    body = bodies.sphere(379)
    nearest = cKDTree(body.centers).query(body.centers[::6], k=2)[0][:, 1]
    for areas in (body.areas, 9 * body.areas):
        found = float(unevenness(dataclasses.replace(body, areas=areas)))
        np.testing.assert_allclose(found, nearest.std() / nearest.mean(), rtol=1e-4)
    assert float(unevenness(bodies.splats([[0.0, 0, 0]], [[0.0, 0, 1]], 1.0))) == 0
    for uneven, interval in ((0.0, KERNEL.regular), (1.0, KERNEL.scattered)):
        found = KERNEL.interval(jnp.asarray(uneven, dtype))
        np.testing.assert_allclose(found, interval, rtol=1e-6)


@pytest.mark.once
@pytest.mark.parametrize("mass", [0.0, 0.4, 1.0])
def test_flat_pieces_and_open_edges_keep_their_mean(mass):
    np.testing.assert_array_equal(gains(mass, WEIGHTS), 1)
    np.testing.assert_array_equal(gains(mass + 2, WEIGHTS, VARIANCES, 0.0, PlainMean()), 1)


@pytest.mark.once
def test_what_absorbs_nothing_returns_all_whatever_the_shape():
    for mass in (3.0, np.linspace(1.1, 2.5, 6)):
        np.testing.assert_allclose(returned(mass, WHITE), 1, rtol=1e-5)
    once = 0.15  # of the light scatters once
    rest = (1 - once) * np.asarray([[0.4], [0.6]])
    np.testing.assert_allclose(returned(2.5, rest, [1.0, 4.0], once), 1 - once, rtol=1e-5)
    assert np.all(returned(2.5, rest, [1.0, 4.0]) > 1.01 * (1 - once))


@pytest.mark.once
def test_nothing_returns_more_than_it_receives_and_more_mass_lets_out_more():
    rng = np.random.default_rng(4)
    for _ in range(20):
        weights = rng.exponential(size=(6, 2))
        weights *= rng.uniform(0.1, 1, size=2) / weights.sum(0)
        assert np.all(returned(1 + 3 * rng.exponential(size=6), weights) <= 1 + 1e-5)
    out = [returned(mass, WEIGHTS) for mass in (1.0, 1.2, 1.5)]
    assert np.all(np.diff(out, axis=0) > 0.005)
    usual, darker = gains(2.0, WEIGHTS), gains(2.0, 0.5 * WEIGHTS)
    assert np.all(np.diff(usual, axis=0) >= 0), "wide layers travel farthest"
    assert np.all(darker > usual), "the darker gains more of what it would lose"
    # A layer wider than its body gains as the narrower ones.
    ours, theirs = (gains([1, 1, 1, 1.2, 1.5, mass], WEIGHTS) for mass in (0.3, 1.5))
    np.testing.assert_array_equal(ours, theirs)


def layers_at(point, body, light, variances, kernel) -> jax.Array:
    """Compute means and mass of the layers at a point: `[gaussians, 2]`."""
    sources = Sources(body.centers.T, body.normals.T, body.areas, light[None])
    points = jnp.asarray(point, float)[:, None]
    layer = jax.jit(lambda *given: dense_layer(sources, points, *given).values[:, 0])
    return jnp.stack(list(map(layer, variances, kernel.depths(variances))))


@pytest.mark.once
@pytest.mark.parametrize("radius", list(SPHERES))
def test_spheres_return_what_walks_do(radius):
    """Under even light, over what a flat surface returns."""
    variances, weights = SPHERE_GAUSSIANS[:, 0], SPHERE_GAUSSIANS[:, 1:]
    body, given = bodies.sphere(8000, radius), jnp.asarray(variances, float)
    _, mass = layers_at([0.0, 0.0, radius], body, jnp.ones(body.count), given, KERNEL).T
    mass = np.where(variances > 0.5 * float(body.areas[0]), mass, 1.0)
    gained = returned(mass, weights, variances) / weights.sum(0)
    np.testing.assert_allclose(gained, SPHERES[radius], rtol=0.065 if radius < 15 else 0.04)


@pytest.mark.parametrize("absorbed", [1e-4, 0.4])
def test_light_decays_in_a_sphere_as_the_diffusion_equation_has_it(absorbed, float64):
    """Of what a flat surface absorbs, a sphere returns as much whatever the Gaussians are, if they
    have the same total and decay rate.
    """
    leaves = 1 - absorbed
    for variances, shares in (([2.0], [1.0]), ([0.5, 2.0, 5.0], [0.3, 0.5, 0.2])):
        deviations, weights = np.sqrt(variances), leaves * np.asarray(shares)[:, None]
        rate = np.sqrt(absorbed / np.dot(shares, variances))
        for radius in np.geomspace(2.0, 1e4, 40):
            excess = 1 / (1 - KERNEL.depth * deviations / radius) - 1
            # The mass whose excess, rounded where it begins, is this one.
            mass = 1 + 0.5 * (excess + np.sqrt(excess * (excess + 0.04)))
            slower = (rate / np.tanh(rate * radius) - 1 / radius) / rate
            saved = (returned(mass, weights, variances)[0] - leaves) / absorbed
            truth = (leaves / (leaves + absorbed * slower) - leaves) / absorbed
            np.testing.assert_allclose(saved, truth, rtol=2e-5, atol=1e-6)


@pytest.mark.once
def test_layers_need_no_order_and_negative_weights_count_as_none():
    mass = np.linspace(1.1, 2.5, 6)
    turned = gains(mass[::-1], WEIGHTS[::-1], VARIANCES[::-1])
    np.testing.assert_allclose(turned[::-1], gains(mass, WEIGHTS), rtol=1e-6)
    ours, theirs = (gains(2.0, [[0.5], [x], [0.3]], [1.0, 2.0, 3.0]) for x in (-0.2, 0.0))
    np.testing.assert_allclose(ours, theirs, rtol=1e-6)


@pytest.mark.once
def test_gradients_at_the_corners_are_the_limits():
    """At weights of zero the limit from above, at no weights at all finite, at a mass of one
    rounded.
    """

    def out(w):
        weights = jnp.stack([w, jnp.asarray(0.4)])[:, None]
        return jnp.sum(weights * gains(2.0, weights, [1.0, 4.0]))

    step, zero = 2e-3, jnp.asarray(0.0)
    slope = (out(zero + step) - out(zero)) / step
    np.testing.assert_allclose(jax.grad(out)(zero), slope, rtol=1e-2)
    of_mass = jax.grad(lambda mass: jnp.sum(gains(mass, WEIGHTS)))
    assert of_mass(1.0) == 0 < of_mass(1.0001) < 0.05 * of_mass(1.2)
    of_weights = jax.grad(lambda weights: jnp.sum(gains(2.0, weights)))
    almost = np.asarray([0.5, 0.5, 0.0, 0.0, 0.0, np.finfo(np.float32).tiny])[:, None]
    for weights in (np.zeros((6, 1)), np.eye(6)[:, :1], almost):
        assert np.all(np.isfinite(of_weights(jnp.asarray(weights, float))))


def sheet_at_origin(thickness, half, spacing, light, variances, kernel) -> jax.Array:
    """Means and mass `[gaussians, 2]` in the middle of a wide sheet's upper face; `light` enters
    the upper and the lower face.
    """
    upper = bodies.sheet(half, spacing)
    lower = bodies.sheet(half, spacing, (0, 0, -1), (0, 0, -thickness))
    entering = jnp.repeat(jnp.asarray(light), upper.count)
    return layers_at(np.zeros(3), bodies.joined(upper, lower), entering, variances, kernel)


@pytest.mark.once
@pytest.mark.parametrize("thickness", list(THROUGH))
def test_sheets_let_through_what_walks_say(thickness):
    """Far better than the mean over the splats, which loses from a third to three quarters of
    it.
    """
    (truth, bound), spacing, off = THROUGH[thickness], 0.6, []
    # The others are too narrow for the splats, and do not reach through.
    resolved = spacing**2 < VARIANCES
    for kernel in (KERNEL, PlainMean()):
        given = thickness, 30.0, spacing, (0.0, 1.0), jnp.asarray(VARIANCES, float), kernel
        means, mass = np.where(resolved, sheet_at_origin(*given).T, [[0.0], [1.0]])
        layers = means[:, None] * np.asarray(gains(mass, WEIGHTS, VARIANCES, 0.0, kernel))
        off.append(np.abs(np.sum(WEIGHTS * layers, axis=0) / truth - 1)[np.greater(truth, 0.05)])
    assert np.all(off[0] < bound), off
    assert np.all(off[0] < 0.36 * off[1]), off


@pytest.mark.once
@pytest.mark.parametrize("interval", [(0.1, 0.2), (0.5, 3.0), (1.0, 5.0)])
def test_a_thin_white_sheet_returns_what_it_receives_whatever_is_resolved(interval):
    spacing, variances = 0.5, jnp.asarray([0.3, 1.0, 4.0])
    rows = sheet_at_origin(0.5, 10.0, spacing, (1.0, 1.0), variances, KERNEL)
    one, area = jnp.ones((1, 1)), jnp.full(1, spacing**2)
    given = one, area, one, jnp.asarray(interval), KERNEL
    at = LayersAtPoints.of(variances, jnp.arange(3), rows[:, :, None], None, *given)
    gaussians = sj.SumOfGaussians(variances, [[0.3], [0.3], [0.4]])
    assert np.any(at.weigh(gaussians, jnp.zeros(1))[1] > 0)
    darker = dataclasses.replace(gaussians, weights=0.5 * gaussians.weights)
    white, grey = at.exitance(gaussians), at.exitance(darker)
    np.testing.assert_allclose(white, 1, rtol=1e-4)
    assert 0.5 < float(grey[0, 0]) < 1


@pytest.mark.once
def test_a_linear_layer_is_continued_exactly_whatever_the_weights():
    """Half of the slope of each splat, and half of the mean slope from the mean center."""
    rng = np.random.default_rng(3)
    sizes = (3, 40), (3, 1), (2, 3)
    centers, point, slope = (jnp.asarray(rng.normal(size=size), float) for size in sizes)
    weights = jnp.asarray(rng.dirichlet(np.ones(40))[:, None], float)
    layer = LayerValues(10 + slope @ centers, jnp.repeat(slope[:, :, None], 40, axis=2))
    blended = jax.tree.map(lambda leaf: leaf @ weights, continue_from_splats(layer, centers))
    mean_center = centers @ weights
    found, _ = continue_to_points(blended, None, mean_center, point, channels=1)
    np.testing.assert_allclose(found, 10 + slope @ point, rtol=1e-4)
    # Far away it stays between 0 and twice the middle, and its derivative is that of the limit.
    middle = 10 + slope[:1] @ mean_center
    for way in (1, -1):
        far = mean_center + 1e3 * way * slope[:1].T
        found, derivative = continue_to_points(blended, blended, mean_center, far, channels=1)
        np.testing.assert_allclose(found[:1], 2 * middle if way > 0 else 0, rtol=1e-4)
        np.testing.assert_array_equal(derivative, found)


def layers_at_points(kernel):
    """Layers of which the last is in reach of no splat at one of the points."""
    rng = np.random.default_rng(5)
    gaussians = sj.SumOfGaussians([0.05, 0.5, 4.0], [[0.2, 0.3], [0.3, 0.1], [0.4, 0.2]])
    rows, slopes = rng.uniform(0.4, 1.4, (3, 3, 7)), rng.normal(size=(3, 3, 7))
    rows[2, -1, 3] = 0
    source, albedo = rng.uniform(0.2, 1.0, (2, 2, 7))
    order = np.asarray([1, 2, 0])  # any: the layers are sorted by their Gaussians
    given = rows[order], slopes[order], source, rng.uniform(0.3, 1.0, 7), albedo, [0.4, 2.2]
    given = (jnp.asarray(each, float) for each in given)
    return LayersAtPoints.of(gaussians.variances, jnp.asarray(order), *given, kernel), gaussians


@pytest.mark.once
def test_unresolved_layers_are_the_irradiance_of_the_surface():
    """In between, the mass is counted by the fraction that is resolved."""
    (at, gaussians), once = layers_at_points(EscapeNormalization()), jnp.asarray([0.02, 0.05])
    layers, resolved = eqx.filter_jit(at.weigh)(gaussians, once)
    share = resolved_fraction(at.variances[:, None], at.area[None], at.interval)
    share = jnp.where(at.mass > 0, share, 0.0)
    assert len(np.unique(share)) > 6
    np.testing.assert_allclose(resolved, share, atol=1e-6)
    share, albedo = share[:, None], at.albedo[None]
    mixed = share * at.means + (1 - share) * at.irradiance[None]
    mass, weights = share * at.mass[:, None] + 1 - share, gaussians.weights[:, :, None] * albedo
    gain = at.kernel.gain(mass, at.variances, weights, once[:, None] * at.albedo)
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
