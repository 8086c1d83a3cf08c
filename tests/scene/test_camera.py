"""The camera: directions, field of view, and views along up."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj

EYE, TARGET = np.asarray([30.0, 20.0, 50.0]), np.asarray([1.0, -2.0, 3.0])


def test_it_looks_at_the_target_upright():
    camera = sj.Camera.look_at(EYE, TARGET, fov=40.0, width=300, height=100)
    right, down, forward = np.asarray(camera.rotation)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(camera.rotation), 1, rtol=1e-6)
    np.testing.assert_allclose(forward * np.linalg.norm(TARGET - EYE), TARGET - EYE, rtol=1e-5)
    assert abs(right[1]) < 1e-7
    assert down[1] < 0
    # The field of view is that of the height.
    np.testing.assert_allclose(2 * camera.focal_length * np.tan(np.radians(20)), 1, rtol=1e-6)
    traced = jax.jit(lambda eye: sj.Camera.look_at(eye, TARGET))(jnp.asarray(EYE))
    np.testing.assert_allclose(traced.rotation, camera.rotation, atol=1e-6)


@pytest.mark.parametrize("straight", [[0.0, -1.0, 0.0], [0.0, 7.0, 0.0]])
def test_a_view_along_up_needs_another_up(straight):
    with pytest.raises(ValueError, match=r"up is \[0.0, 1.0, 0.0\]"):
        sj.Camera.look_at(EYE, EYE + straight)
    camera = sj.Camera.look_at(EYE, EYE + straight, up=[0, 0, -1])
    assert np.all(np.isfinite(camera.rotation))


@pytest.mark.parametrize("size", [1e-10, 1e12])
def test_any_distance_that_single_precision_can_square_is_a_view(size):
    assert np.all(np.isfinite(sj.Camera.look_at(size * EYE, [0, 0, 0]).rotation))
