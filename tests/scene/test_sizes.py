"""Splats in another size."""

import jax.numpy as jnp
import numpy as np

import splatjax as sj


def test_a_scaled_body_has_its_shape_and_the_square_of_its_area():
    bust = sj.bust(500)
    small = bust.scaled(0.25)
    np.testing.assert_allclose(small.centers, 0.25 * bust.centers, rtol=1e-6)
    np.testing.assert_array_equal(small.normals, bust.normals)
    np.testing.assert_array_equal(small.albedo, bust.albedo)
    np.testing.assert_allclose(
        small.radii / jnp.sqrt(small.areas), bust.radii / jnp.sqrt(bust.areas), rtol=1e-5
    )
    np.testing.assert_allclose(small.areas.sum(), bust.areas.sum() / 16, rtol=1e-5)
