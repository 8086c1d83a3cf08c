"""The weight of a fragment, and the coverage that a sum of weights makes."""

import jax
import jax.numpy as jnp
import numpy as np

from splatjax import splatting
from splatjax.splatting import _kernel

coverage, fragment_weight = (
    jax.jit(splatting.coverage, static_argnums=1),
    jax.jit(splatting.fragment_weight),
)
fast_fragment_weight, fragment_weight_derivative = map(
    jax.jit, (_kernel.fast_fragment_weight, _kernel.fragment_weight_derivative)
)
weight_slope = jax.jit(jax.grad(lambda q: jnp.sum(fragment_weight(q))))

POLYNOMIAL_ERROR = 2e-6  # 6e-7 of the fit, and rounding of seven float32 steps


def squared_radii(count=401):
    return jnp.linspace(0.0, 1.0, count)


def test_weight_is_the_gaussian_of_the_formula_tapered_at_the_rim():
    q = np.linspace(0, 1, 401)
    expected = np.exp(-4 * q) - np.exp(-4.0) * (5 - 4 * q)
    np.testing.assert_allclose(np.asarray(fragment_weight(squared_radii())), expected, atol=3e-7)


def test_weight_and_its_derivative_vanish_at_the_rim_and_only_there(x64):
    rounding = 1e-15 if x64 else 1e-7
    rim = jnp.ones(1)
    assert abs(float(fragment_weight(rim)[0])) < rounding
    assert abs(float(weight_slope(rim)[0])) < 4 * rounding
    inside = np.asarray(fragment_weight(squared_radii()))[:-4]
    assert np.all(inside > 0)
    assert np.all(np.diff(inside) < 0)


def test_fast_weight_is_the_weight():
    q = squared_radii()
    fast = np.asarray(fast_fragment_weight(q))
    assert np.max(np.abs(fast - np.asarray(fragment_weight(q)))) < POLYNOMIAL_ERROR
    assert np.all(fast >= 0)


def test_derivative_from_the_weight_is_the_derivative():
    q = squared_radii()
    np.testing.assert_allclose(
        fragment_weight_derivative(q, fragment_weight(q)), weight_slope(q), atol=2e-6
    )


def test_coverage_is_a_smooth_step():
    full = 0.15
    sums = jnp.linspace(0.0, 0.4, 321)
    values = np.asarray(coverage(sums, full))
    slopes = np.asarray(jax.jit(jax.grad(lambda s: jnp.sum(coverage(s, full))))(sums))
    sums = np.asarray(sums)
    assert values[0] == 0
    assert np.all(values[sums >= full] == 1)
    assert np.all(np.diff(values) >= 0)
    assert slopes[0] == 0
    assert np.all(slopes[sums > full] == 0)
    np.testing.assert_allclose(float(coverage(jnp.asarray(full / 2), full)), 0.5, rtol=1e-6)
    assert (
        np.max(np.abs(np.diff(slopes))) < 6 / full**2 * (0.4 / 320) * 1.01
    )  # no jump: bounded by its own slope
