"""The specular lobe: reciprocity, horizon, gradients."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from splatjax.shading import albedo_root, fresnel_f0, specular_lobe


def unit(vectors):
    vectors = np.asarray(vectors, float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def random_directions(count, seed):
    vectors = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    vectors[:, 2] = np.abs(vectors[:, 2])
    return vectors


def lobe(normal, wi, wo, f0=0.028, specular=0.18, roughness=0.3, dtype=None):
    normal, wi, wo, f0, specular, roughness = (
        jnp.asarray(x, dtype) for x in (normal, wi, wo, f0, specular, roughness)
    )
    return specular_lobe(normal, wi, wo, f0=f0, specular=specular, roughness=roughness)


UP = [[0.0, 0.0, 1.0]]


def test_fresnel_of_skin_and_of_no_interface(dtype):
    np.testing.assert_allclose(float(fresnel_f0(jnp.asarray(1.4, dtype))), 1 / 36, rtol=1e-6)
    assert float(fresnel_f0(jnp.asarray(1.0, dtype))) == 0


def test_helmholtz_reciprocity(dtype):
    wi, wo = random_directions(64, 3), random_directions(64, 4)
    there, back = lobe(UP, wi, wo, dtype=dtype), lobe(UP, wo, wi, dtype=dtype)
    np.testing.assert_allclose(np.asarray(there), np.asarray(back), rtol=1e-5)


def test_peak_is_that_of_the_formula(dtype):
    # Head on, |wi + wo|^2 = 4 and cos a = 1: f = specular F0 / (4 pi m^2).
    value = lobe(UP, UP, UP, dtype=dtype)
    np.testing.assert_allclose(float(value[0]), 0.18 * 0.028 / (4 * np.pi * 0.09), rtol=1e-5)


def test_fresnel_is_evaluated_at_the_half_vector(dtype):
    # A mirror pair at 60 degrees: H.V = 1/2 and H = N.
    s, c = np.sin(np.pi / 3), np.cos(np.pi / 3)
    value = lobe(UP, [[s, 0, c]], [[-s, 0, c]], f0=0.04, specular=1.0, roughness=0.5, dtype=dtype)
    fresnel = 0.04 + 0.96 * 0.5**5
    np.testing.assert_allclose(float(value[0]), fresnel / (np.pi * 0.25) / (4 * c * c), rtol=1e-5)


def test_one_light_serves_many_points(dtype):
    normals = random_directions(6, 5).reshape(2, 3, 3)
    value = lobe(
        normals,
        np.reshape(UP, (1, 1, 3)),
        np.reshape(UP, (1, 1, 3)),
        roughness=np.full((2, 3), 0.4),
        dtype=dtype,
    )
    assert value.shape == (2, 3)


DEGENERATE = {
    "light below": ([0.3, 0.0, -0.5], [0.0, 0.0, 1.0]),
    "camera below": ([0.0, 0.0, 1.0], [0.3, 0.1, -0.2]),
    "light on the horizon": ([1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),
    "both on the horizon, opposite": ([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]),
    "opposite": ([0.6, 0.0, 0.8], [-0.6, 0.0, -0.8]),
    "just above, opposite": ([1.0, 0.0, 1e-6], [-1.0, 0.0, 1e-6]),
    "just above, the same": ([1.0, 0.0, 1e-6], [1.0, 0.0, 1e-6]),
    "just above, across": ([1.0, 0.0, 1e-20], [0.0, 1.0, 1e-20]),
    "head on": ([0.0, 0.0, 1.0], [0.0, 0.0, 1.0]),
}


@jax.jit
@partial(jax.value_and_grad, argnums=tuple(range(6)))
def total_and_slopes(normal, wi, wo, f0, specular, roughness):
    return jnp.sum(specular_lobe(normal, wi, wo, f0=f0, specular=specular, roughness=roughness))


@pytest.mark.parametrize("place", DEGENERATE)
@pytest.mark.parametrize("roughness", [0.0, 0.05, 1.0])
def test_degenerate_places_are_finite(place, roughness, dtype):
    wi, wo = (unit([direction]) for direction in DEGENERATE[place])
    value, slopes = total_and_slopes(
        *(jnp.asarray(x, dtype) for x in (UP, wi, wo, 0.028, 0.18, roughness))
    )
    assert np.isfinite(float(value))
    assert float(value) >= 0
    assert all(np.all(np.isfinite(np.asarray(slope))) for slope in slopes)
    if "below" in place or "horizon" in place:
        assert float(value) == 0
        assert all(np.all(np.asarray(slope) == 0) for slope in slopes)


def test_gradients_of_the_lobe(float64):
    wi, wo = jnp.asarray(random_directions(8, 6)), jnp.asarray(random_directions(8, 7))
    normal = jnp.asarray(unit(random_directions(8, 8) + np.asarray([0, 0, 3.0])))

    def value(normal, wi, wo, f0, specular, roughness):
        return specular_lobe(normal, wi, wo, f0=f0, specular=specular, roughness=roughness)

    scalars = (jnp.asarray(0.05), jnp.asarray(0.5), jnp.asarray(0.4))
    check_grads(jax.jit(value), (normal, wi, wo, *scalars), order=2, rtol=1e-5)


def test_root_of_albedo_and_its_floor(dtype):
    albedo = jnp.asarray([0.0, 1e-5, 1e-4, 0.25, 1.0], dtype)
    np.testing.assert_allclose(
        np.asarray(albedo_root(albedo)), [0.01, 0.01, 0.01, 0.5, 1.0], rtol=1e-6
    )
    slopes = jax.grad(lambda a: jnp.sum(albedo_root(a)))(albedo)
    np.testing.assert_allclose(np.asarray(slopes), [0, 0, 0, 1.0, 0.5], rtol=1e-6)
