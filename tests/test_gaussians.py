"""Laws of the shared basis."""

import jax
import jax.numpy as jnp
import numpy as np

from splatjax.gaussians import SumOfGaussians, gaussian
from splatjax.scattering import L2_QUADRATURE, at_own_radii, integrated_reflectance


def test_gaussian_is_smooth_at_the_origin(dtype):
    offset = jnp.zeros(3, dtype)
    gradient = jax.grad(lambda x: gaussian(jnp.asarray(0.5, dtype), jnp.sum(x * x)))(offset)
    np.testing.assert_array_equal(np.asarray(gradient), 0.0)


def test_sum_of_gaussians_is_a_profile_whose_weights_are_energies(dtype):
    profile = SumOfGaussians([0.04, 1.0], [[0.2, 0.1], [0.5, 0.3]])
    assert profile(jnp.zeros((4, 5), dtype)).shape == (4, 5, 2)
    np.testing.assert_allclose(np.asarray(profile.total_reflectance()), [0.7, 0.4], rtol=1e-6)
    np.testing.assert_allclose(np.asarray(profile.white().total_reflectance()), 1.0, rtol=1e-6)
    r = np.asarray([[0.0, 0.1], [0.5, 2.0]])
    for wider in (0.0, 0.3):
        expected = sum(
            np.exp(-(r**2) / (2 * v))[..., None] / (2 * np.pi * v) * np.asarray(weights)
            for v, weights in ((0.04 + wider, [0.2, 0.1]), (1.0 + wider, [0.5, 0.3]))
        )
        np.testing.assert_allclose(
            profile.blurred(wider)(jnp.asarray(r, dtype)), expected, rtol=1e-5
        )
    np.testing.assert_allclose(np.asarray(profile.length_scale()), [0.2, 0.2], rtol=1e-6)


def test_the_norm_of_a_gaussian_is_integrated_whatever_its_width(float64):
    """The integral of r G(v, r)^2 is 1 / (8 pi^2 v), beside a Gaussian of any other scale."""
    for narrow in (1e-6, 1e-2, 1.0):
        profile = SumOfGaussians([narrow, 1.0], [0.0, 1.0])
        r, dr = L2_QUADRATURE.radii(profile)
        norm = jnp.sum(dr * r * at_own_radii(profile, r) ** 2)
        np.testing.assert_allclose(norm, 1 / (8 * np.pi**2), rtol=1e-12)
        np.testing.assert_allclose(integrated_reflectance(profile), 1, rtol=1e-12)
