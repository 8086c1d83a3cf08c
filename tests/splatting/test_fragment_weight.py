"""The weight of a fragment, and the coverage that a sum of weights makes."""

import jax
import jax.numpy as jnp
import numpy as np

from splatjax.splatting import coverage, fragment_weight
from splatjax.splatting._kernel import fast_fragment_weight, fragment_weight_derivative

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
    assert abs(float(jax.grad(lambda q: jnp.sum(fragment_weight(q)))(rim)[0])) < 4 * rounding
    inside = squared_radii()[:-4]
    assert bool(jnp.all(fragment_weight(inside) > 0))
    assert bool(jnp.all(jnp.diff(fragment_weight(inside)) < 0))


def test_fast_weight_is_the_weight():
    q = squared_radii()
    assert float(jnp.max(jnp.abs(fast_fragment_weight(q) - fragment_weight(q)))) < POLYNOMIAL_ERROR
    assert bool(jnp.all(fast_fragment_weight(q) >= 0))


def test_derivative_from_the_weight_is_the_derivative():
    q = squared_radii()
    automatic = jax.grad(lambda q: jnp.sum(fragment_weight(q)))(q)
    np.testing.assert_allclose(np.asarray(fragment_weight_derivative(q, fragment_weight(q))), np.asarray(automatic), atol=2e-6)


def test_coverage_is_a_smooth_step():
    full = 0.15
    sums = jnp.linspace(0.0, 0.4, 321)
    values = coverage(sums, full)
    slopes = jax.grad(lambda s: jnp.sum(coverage(s, full)))(sums)
    assert float(values[0]) == 0
    assert bool(jnp.all(values[sums >= full] == 1))
    assert bool(jnp.all(jnp.diff(values) >= 0))
    assert float(slopes[0]) == 0
    assert bool(jnp.all(slopes[sums > full] == 0))
    np.testing.assert_allclose(float(coverage(jnp.asarray(full / 2), full)), 0.5, rtol=1e-6)
    assert float(jnp.max(jnp.abs(jnp.diff(slopes)))) < 6 / full**2 * (0.4 / 320) * 1.01  # no jump: bounded by its own slope
