"""The inverse Hankel transform: known transforms, precision, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from splatjax.scattering import inverse_hankel_transform

ROUNDING = 1e-13
"""Of the value at the origin; 1e-15 is reached."""


def source(r, depth, sigma):
    """What `exp(-depth sqrt(k^2 + sigma^2))` transforms to: a point source seen from a plane
    (Sommerfeld).
    """
    d = np.hypot(r, depth)
    return depth * (1 + sigma * d) * np.exp(-sigma * d) / (2 * np.pi * d**3)


@pytest.mark.parametrize("sigma", [0.0, 1e-3, 0.1, 3.0])
def test_transform_of_a_point_source(float64, sigma):
    depth = np.array([0.2, 1.0])
    r = np.concatenate([[0.0], np.geomspace(1e-3, 300, 60)])

    def transform(k):
        return jnp.exp(-jnp.sqrt(k * k + sigma**2) * jnp.broadcast_to(jnp.asarray(depth), k.shape))

    found = np.asarray(inverse_hankel_transform(transform, jnp.asarray(r), jnp.asarray(depth)))
    expected = source(r[:, None], depth, sigma)
    # Near the axis to all digits; farther out what is left of them after r^-1.
    scale = source(0.0, depth, sigma) * depth / np.maximum(r[:, None], depth)
    assert np.max(np.abs(found - expected) / scale) < ROUNDING


def test_transform_of_a_gaussian(float64):
    variance, r = np.array([0.3, 7.0]), np.linspace(0, 3, 20)

    def transform(k):
        return jnp.exp(-0.5 * k * k * jnp.broadcast_to(jnp.asarray(variance), k.shape))

    found = inverse_hankel_transform(transform, jnp.asarray(r), jnp.sqrt(jnp.asarray(variance)))
    expected = np.exp(-(r[:, None] ** 2) / (2 * variance)) / (2 * np.pi * variance)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_in_the_precision_of_the_run(dtype):
    r = jnp.asarray([0.0, 0.01, 0.3, 3.0, 20.0], dtype)
    found = inverse_hankel_transform(lambda k: jnp.exp(-k), r, jnp.ones(1, dtype))[:, 0]
    assert found.dtype == dtype
    np.testing.assert_allclose(
        found, source(np.asarray(r), 1.0, 0.0), atol=200 * jnp.finfo(dtype).eps
    )


def test_derivatives(float64):
    def value(r, sigma):
        return inverse_hankel_transform(
            lambda k: jnp.exp(-jnp.sqrt(k * k + sigma**2)), r, jnp.ones(1)
        )

    check_grads(
        jax.jit(value), (jnp.asarray([0.02, 0.3, 4.0]), jnp.asarray(0.4)), order=1, rtol=1e-6
    )
    # At the axis a round function is flat; beside it the series has the slope of the source.
    slope = jax.jacfwd(lambda r: value(r, 0.0))
    assert slope(jnp.asarray(0.0))[0] == 0
    near, exact = 0.01, -3 * 0.01 / (2 * np.pi * (1 + 1e-4) ** 2.5)
    np.testing.assert_allclose(slope(jnp.asarray(near))[0], exact, rtol=1e-10)
