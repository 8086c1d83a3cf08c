"""The camera: what stands where in the picture, and what is no view."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj

EYE, TARGET = jnp.asarray([30.0, 20.0, 50.0]), jnp.asarray([1.0, -2.0, 3.0])


def test_it_looks_at_the_target_and_up_is_up():
    camera = sj.Camera.look_at(EYE, TARGET)
    right, down, forward = np.asarray(camera.rotation)
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(camera.rotation), 1, rtol=1e-6)
    np.testing.assert_allclose(forward * np.linalg.norm(TARGET - EYE), TARGET - EYE, rtol=1e-5)
    assert abs(right[1]) < 1e-7
    assert down[1] < 0


def test_the_field_of_view_is_that_of_the_height():
    camera = sj.Camera.look_at(EYE, TARGET, fov=40.0, width=300, height=100)
    np.testing.assert_allclose(
        float(camera.focal_length) * 2 * np.tan(np.radians(20)), 1, rtol=1e-6
    )


@pytest.mark.parametrize("straight", [[0.0, -1.0, 0.0], [0.0, 7.0, 0.0]])
def test_no_picture_is_upright_when_it_looks_along_up(straight):
    with pytest.raises(
        ValueError, match=r"up is \[0.0, 1.0, 0.0\], along the line of sight; give another"
    ):
        sj.Camera.look_at(EYE, EYE + jnp.asarray(straight))
    camera = sj.Camera.look_at(EYE, EYE + jnp.asarray(straight), up=jnp.asarray([0.0, 0.0, -1.0]))
    assert np.all(np.isfinite(camera.rotation))


def test_nothing_is_seen_from_where_one_looks():
    with pytest.raises(
        ValueError, match=r"stands at \[30.0, 20.0, 50.0\], where it looks at; move one of them"
    ):
        sj.Camera.look_at(EYE, EYE)


def test_what_single_precision_cannot_square_is_no_place():
    with pytest.raises(ValueError, match=r"from the camera to its target it is .* give less"):
        sj.Camera.look_at(jnp.asarray([0.0, 0.0, 1e25]), jnp.zeros(3))
    for size in (1e-10, 1e12):
        assert np.all(np.isfinite(sj.Camera.look_at(size * EYE, jnp.zeros(3)).rotation))


@pytest.mark.parametrize(
    ("given", "said"),
    [({"fov": 180.0}, "fov must lie"), ({"width": 0}, "0 x 512"), ({"height": -1}, "x -1")],
)
def test_what_is_no_picture_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        sj.Camera.look_at(EYE, TARGET, **given)


def test_a_traced_place_is_trusted():
    made = jax.jit(lambda eye: sj.Camera.look_at(eye, TARGET))(EYE)
    np.testing.assert_allclose(made.rotation, sj.Camera.look_at(EYE, TARGET).rotation, atol=1e-6)
