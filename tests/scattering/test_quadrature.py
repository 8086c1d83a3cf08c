"""Radial integrals of what is known in closed form."""

import jax.numpy as jnp
import numpy as np

from splatjax.gaussians import SumOfGaussians
from splatjax.scattering import L2_QUADRATURE, at_own_radii, integrated_reflectance

FLOAT64 = 1e-12
ROUNDING = {"float32": 3e-6, "float64": FLOAT64}
"""Sums of some hundred terms."""


def test_sum_of_weights_is_the_integral(dtype):
    profile = SumOfGaussians(
        jnp.asarray([0.01, 0.3, 40.0], dtype),
        jnp.asarray([[0.3, 0.1], [0.2, 0.5], [0.1, 0.0]], dtype),
    )
    tolerance = ROUNDING[jnp.dtype(dtype).name]
    np.testing.assert_allclose(
        integrated_reflectance(profile), profile.total_reflectance(), rtol=tolerance
    )


def test_norm_of_a_gaussian(float64):
    """The integral of r G(v, r)^2 is 1 / (8 pi^2 v), whatever the ratio of v to the profile's own
    scale.
    """
    for narrow in (1e-6, 1e-2, 1.0):
        profile = SumOfGaussians(jnp.asarray([narrow, 1.0]), jnp.asarray([[0.0], [1.0]]))
        r, dr = L2_QUADRATURE.radii(profile)
        norm = jnp.sum(dr * r * at_own_radii(profile, r) ** 2)
        np.testing.assert_allclose(norm, 1 / (8 * np.pi**2), rtol=FLOAT64)


def test_each_channel_has_its_own_radii(dtype):
    profile = SumOfGaussians(
        jnp.asarray([0.5, 2.0], dtype), jnp.asarray([[0.3, 0.1], [0.2, 0.5]], dtype)
    )
    r = jnp.asarray([[0.1, 0.2], [1.0, 3.0]], dtype)
    own = at_own_radii(profile, r)
    np.testing.assert_array_equal(own[:, 0], profile(r[:, 0])[:, 0])
    np.testing.assert_array_equal(own[:, 1], profile(r[:, 1])[:, 1])
