"""Layers narrower than the splats pass to the surface, smoothly in the variance."""

import bodies
import jax
import jax.numpy as jnp
import numpy as np

from splatjax.diffusion import (
    DiffusionSettings,
    ExitOdds,
    handover_interval,
    irregularity,
    resolved_share,
)
from splatjax.diffusion._points import Points


def test_share_rises_smoothly_from_none_to_all():
    interval, area = jnp.asarray([1.2, 2.4]), jnp.asarray(0.25)
    variances = jnp.linspace(0.1, 1.5, 1401)
    share = jax.jit(jax.vmap(jax.value_and_grad(lambda v: resolved_share(v, area, interval))))
    values, slopes = (np.asarray(each) for each in share(variances))
    variances = np.asarray(variances)
    assert values[0] == 0
    assert values[-1] == 1
    assert np.all(values[variances < 0.3599] == 0)
    assert np.all(values[variances > 1.4401] == 1)
    assert np.all(slopes >= 0)
    assert np.all((values > 0) & (values < 1), where=(variances > 0.361) & (variances < 1.439))
    largest_bend = 6 / 1.08**2
    assert np.max(np.abs(np.diff(slopes))) < largest_bend * 1.01 * 1.4 / 1400, "the slope jumps"


def test_its_derivative_is_that_of_central_differences(float64):
    interval = jnp.asarray([0.4, 0.8])

    @jax.jit
    def share(v, area):
        return resolved_share(v, area, interval)

    v, area, step = jnp.asarray(0.1), jnp.asarray([0.3, 0.4, 0.5]), 1e-6
    found = jax.jacfwd(share)(v, area)
    differences = (share(v + step, area) - share(v - step, area)) / (2 * step)
    by_area = jax.grad(lambda a: jnp.sum(share(v, a)))(area)
    area_differences = (share(v, area + step) - share(v, area - step)) / (2 * step)
    np.testing.assert_allclose(np.asarray(found), np.asarray(differences), rtol=1e-7)
    np.testing.assert_allclose(np.asarray(by_area), np.asarray(area_differences), rtol=1e-7)


def test_irregularity_tells_grids_from_scattered_splats(dtype):
    grid = bodies.sheet(10.0, 0.5)
    rng = np.random.default_rng(4)
    jitter = jnp.asarray(rng.uniform(-0.125, 0.125, grid.centers.shape) * [1, 1, 0], dtype)
    jittered = bodies.splats(grid.centers + jitter, grid.normals, grid.radii, grid.areas)
    assert float(irregularity(grid)) < 1e-3
    assert float(irregularity(jittered)) > 0.1
    assert float(irregularity(bodies.sphere(1000))) > 0.1
    # The standard deviation over the mean, of every sixth splat: areas in other units change
    # nothing.
    body = bodies.sphere(379)
    centers = np.asarray(body.centers, float)
    apart = np.linalg.norm(centers[::6, None] - centers[None], axis=2) + 1e9 * np.eye(379)[::6]
    nearest = apart.min(axis=1)
    for areas in (body.areas, 9 * body.areas):
        scaled = bodies.splats(body.centers, body.normals, body.radii, areas)
        np.testing.assert_allclose(
            float(irregularity(scaled)), nearest.std() / nearest.mean(), rtol=1e-4
        )
    few = bodies.splats([[0.0, 0, 0]], [[0.0, 0, 1]], 1.0)
    assert float(irregularity(few)) == 0


def test_interval_is_that_of_the_settings_at_either_end(dtype):
    settings = DiffusionSettings()
    np.testing.assert_allclose(
        np.asarray(handover_interval(jnp.zeros((), dtype), settings)), settings.regular, rtol=1e-6
    )
    np.testing.assert_allclose(
        np.asarray(handover_interval(jnp.ones((), dtype), settings)), settings.scattered, rtol=1e-6
    )


def test_layers_pass_from_the_surface_to_the_integral():
    """Means and exits by the share that is carried: the surface's own irradiance, which leaves as
    it came, for the rest.
    """
    rng = np.random.default_rng(5)
    variances, interval = jnp.asarray([0.05, 0.5, 4.0]), jnp.asarray([0.4, 2.2])
    means, exits = (
        jnp.asarray(rng.uniform(size=(3, 2, 1, 7)), float),
        jnp.asarray(rng.uniform(0.4, 1.9, (3, 1, 1, 7)), float),
    )
    exits = exits.at[2, 0, 0, 3].set(0.0)  # no splat within reach
    weights, carried = (
        jnp.asarray([[0.2, 0.3], [0.3, 0.1], [0.4, 0.2]]),
        jnp.asarray([1.0, 1.0, 1.0]),
    )
    own, albedo = (jnp.asarray(rng.uniform(0.2, 1.0, (2, 1, 7)), float) for _ in range(2))
    area, once = jnp.asarray(rng.uniform(0.3, 1.0, (1, 7)), float), jnp.asarray([0.02, 0.05])
    points = Points(
        weights[:, :, None, None],
        variances[:, None, None, None],
        means,
        exits,
        carried,
        once[:, None, None],
        own,
        area,
        albedo,
    )
    layers, resolved = points.layers(interval, ExitOdds(), variances)
    share = np.asarray(
        resolved_share(variances[:, None, None, None], area[None, None], interval)
    ) * (np.asarray(exits) > 0)
    assert len(np.unique(share)) > 6
    np.testing.assert_allclose(resolved, share, atol=1e-6)
    mixed = share * np.asarray(means) + (1 - share) * np.asarray(own)[None]
    ways = jnp.asarray(share * np.asarray(exits) + (1 - share), float)
    gain = ExitOdds().gain(
        ways, variances, weights[:, :, None, None] * albedo[None], once[:, None, None] * albedo
    )
    np.testing.assert_allclose(layers, np.asarray(gain) * mixed, rtol=1e-5)
