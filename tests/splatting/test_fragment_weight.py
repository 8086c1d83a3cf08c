"""The weight of a fragment, and the coverage that a sum of weights makes."""

import jax
import jax.numpy as jnp
import numpy as np

from splatjax.splatting import _kernel, coverage, fragment_weight

POLYNOMIAL_ERROR = 2e-6  # 6e-7 of the fit, and rounding of seven float32 steps


def test_weight_is_the_gaussian_of_the_formula_tapered_at_the_rim(x64):
    q = np.linspace(0, 1, 401)
    slope = jax.jit(jax.grad(lambda q: jnp.sum(fragment_weight(q))))(jnp.asarray(q))
    weight = jax.jit(fragment_weight)(jnp.asarray(q))
    expected = np.exp(-4 * q) - np.exp(-4.0) * (5 - 4 * q)
    np.testing.assert_allclose(weight, expected, atol=3e-7)
    rounding = 1e-15 if x64 else 1e-7
    assert abs(float(weight[-1])) < rounding
    assert abs(float(slope[-1])) < 4 * rounding
    assert np.all(weight[:-4] > 0)
    assert np.all(np.diff(weight[:-4]) < 0)
    from_weight = jax.jit(_kernel.fragment_weight_derivative)(jnp.asarray(q), weight)
    np.testing.assert_allclose(from_weight, slope, atol=2e-6)
    fast = jax.jit(_kernel.fast_fragment_weight)(jnp.asarray(q))
    np.testing.assert_allclose(fast, weight, atol=POLYNOMIAL_ERROR)
    assert np.all(fast >= 0)


def test_coverage_is_a_smooth_step():
    full, sums = 0.15, jnp.linspace(0.0, 0.4, 321)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(lambda s: coverage(s, full))))(sums)
    assert values[0] == 0
    assert slopes[0] == 0
    assert np.all(values[sums >= full] == 1)
    assert np.all(slopes[sums > full] == 0)
    assert np.all(np.diff(values) >= 0)
    np.testing.assert_allclose(values[60], 0.5, rtol=1e-5)  # at half of `full`
    bend = 6 / full**2  # the slope has no jump: its change is bounded by its own derivative
    assert np.max(np.abs(np.diff(slopes))) < bend * (0.4 / 320) * 1.01
