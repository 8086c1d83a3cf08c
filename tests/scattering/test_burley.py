"""Normalized diffusion: the published curves, and that energy adds up."""

import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.scattering import Burley, DiffuseMeanFreePath, DiffuseTransmission, Searchlight

# Christensen and Burley 2015, worked out by hand.
PUBLISHED = {
    Searchlight(): {0.1: 4.151, 0.8: 1.05, 1.0: 0.906},
    DiffuseTransmission(): {0.1: 3.515, 0.5: 1.715, 1.0: 1.04},
    DiffuseMeanFreePath(): {0.13: 3.66, 0.33: 3.5, 0.93: 16.46},
}


@pytest.mark.parametrize("scaling", PUBLISHED, ids=lambda scaling: type(scaling).__name__)
def test_scaling_is_as_published(scaling):
    albedo, expected = (
        jnp.asarray(list(each), float) for each in (PUBLISHED[scaling], PUBLISHED[scaling].values())
    )
    np.testing.assert_allclose(scaling(albedo), expected, rtol=1e-5)
    burley = Burley(albedo, jnp.full_like(albedo, 2.0), scaling)
    np.testing.assert_allclose(burley.length_scale(), 2 / np.asarray(expected), rtol=1e-5)


def test_what_leaves_within_a_radius_is_the_integral_of_the_profile():
    """`2 pi r R(r)` by the midpoint rule in the logarithm: near the axis it is a constant."""
    burley = Burley(jnp.asarray([0.2, 0.9]), jnp.asarray([1.0, 1.5]))
    assert isinstance(burley.scaling, Searchlight)
    edges = np.geomspace(1e-4, 90.0, 4001)
    middle = jnp.asarray(np.sqrt(edges[1:] * edges[:-1]), float)
    ring = (
        2
        * np.pi
        * np.asarray(middle * middle)[:, None]
        * np.asarray(burley(middle), float)
        * np.log(edges[1] / edges[0])
    )
    within = np.asarray(burley.reflectance_within(jnp.asarray(edges, float)), float)
    np.testing.assert_allclose(within[0] + np.cumsum(ring, axis=0), within[1:], atol=2e-5)
    np.testing.assert_allclose(within[-1], burley.total_reflectance(), rtol=1e-5)
    np.testing.assert_allclose(burley.reflectance_within(jnp.zeros(1)), 0, atol=1e-7)


def test_albedos_beyond_the_physics_are_refused():
    one = jnp.ones(1)
    Burley(jnp.asarray([0.0, 1.0]), jnp.ones(2))
    for albedo, path, name in (
        (-0.01, 1.0, "albedo"),
        (1.01, 1.0, "albedo"),
        (0.5, 0.0, "free_path"),
    ):
        with pytest.raises(ValueError, match=name):
            Burley(albedo * one, path * one)
