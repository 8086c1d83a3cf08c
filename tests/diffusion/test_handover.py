"""Layers narrower than the splats pass to the surface, smoothly in the variance."""

import bodies
import jax
import jax.numpy as jnp
import numpy as np

from splatjax.diffusion import DiffusionSettings, handover_interval, irregularity, resolved_share


def test_share_rises_smoothly_from_none_to_all():
    interval, area = jnp.asarray([1.0, 2.0]), jnp.asarray(0.25)
    variances = jnp.linspace(0.1, 1.5, 1401)
    share = jax.jit(jax.vmap(jax.value_and_grad(lambda v: resolved_share(v, area, interval))))
    values, slopes = (np.asarray(each) for each in share(variances))
    variances = np.asarray(variances)
    assert values[0] == 0
    assert values[-1] == 1
    assert np.all(values[variances < 0.25] == 0)
    assert np.all(values[variances > 1.0] == 1)
    assert np.all(slopes >= 0)
    largest_bend = 6 / 0.75**2
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
    few = bodies.splats([[0.0, 0, 0]], [[0.0, 0, 1]], 1.0)
    assert float(irregularity(few)) == 0


def test_interval_is_that_of_the_settings_at_either_end(dtype):
    settings = DiffusionSettings()
    np.testing.assert_allclose(np.asarray(handover_interval(jnp.zeros((), dtype), settings)), settings.regular, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(handover_interval(jnp.ones((), dtype), settings)), settings.scattered, rtol=1e-6)
