"""How parts of a scene move: rotations, lights, and surfaces along their normals."""

import dataclasses

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import splatjax as sj
from splatjax.inverse._observation import PicturedScene
from splatjax.inverse._parts import rotation

FLAT = bodies.sheet(5.0, 0.5, jitter=0.2)
CAMERA = sj.Camera.look_at([3, 0, 9], [1, 1, 0], width=4, height=4)


def moved_by(part, splats: sj.Splats, x) -> sj.Splats:
    return part.moved(PicturedScene(splats, CAMERA, ()), x, part.prepared(splats)).splats


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.05, 0.0999, 0.1001, 1.0, 3.0])
def test_a_rotation_is_that_of_its_vector(length, x64):
    vector = length * np.asarray([2.0, -1.0, 2.0]) / 3
    found = jax.jit(rotation)(jnp.asarray(vector))
    np.testing.assert_allclose(
        found, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14 if x64 else 1e-6
    )


def test_a_rotation_has_a_derivative_where_there_is_none():
    slope = np.asarray(jax.jit(jax.jacobian(rotation))(jnp.zeros(3)))
    for axis in np.eye(3):
        np.testing.assert_allclose(slope @ axis, np.cross(axis, np.eye(3)).T, atol=1e-7)


@pytest.mark.once
def test_lights_move_each_in_its_own_way():
    beam = sj.GaussianBeam([1, 2, 3], [0, 0, -2], power=[4, 5], variance=1)
    lights = sj.PointLight([1, 2, 3], intensity=[4, 5]), beam
    pictured = PicturedScene(bodies.sphere(20), CAMERA, lights)
    places = sj.inverse.LightPlaces(turn=0.1, shift=2.0)
    x = jax.tree.map(jnp.ones_like, places.coordinates(pictured))
    lamp, beam = places.moved(pictured, x, None).lights
    np.testing.assert_allclose([lamp.position, beam.origin], [[3, 4, 5]] * 2)
    turned = Rotation.from_rotvec([0.1, 0.1, 0.1]).apply([0, 0, -2])
    np.testing.assert_allclose(beam.direction, turned, rtol=1e-5)
    x = (jnp.asarray([0.0, 1.0]), jnp.asarray([2.0, 0.0]))
    lamp, beam = sj.inverse.LightStrengths(step=0.5).moved(pictured, x, None).lights
    expected = [[4, 5 * np.exp(0.5)], [4 * np.exp(1), 5]]
    np.testing.assert_allclose([lamp.intensity, beam.power], expected, rtol=1e-6)


@pytest.mark.once
def test_a_camera_turns_around_the_body():
    middle, part = jnp.asarray([0.5, -1.0, 0.3]), sj.inverse.CameraPoses(turn=0.2, shift=0.5)
    pictured = PicturedScene(bodies.sphere(20), CAMERA, ())
    turned, shifted = (
        part.moved(pictured, jnp.asarray(x), middle).camera
        for x in ([[1.0, -2.0, 0.5], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    )
    assert float(jnp.linalg.norm(turned.position - CAMERA.position)) > 1
    was, now = (camera.rotation @ (middle - camera.position) for camera in (CAMERA, turned))
    np.testing.assert_allclose(now, was, atol=1e-5)
    np.testing.assert_allclose(shifted.position - CAMERA.position, [0.5, 1, 1.5], atol=1e-6)
    np.testing.assert_allclose(shifted.rotation, CAMERA.rotation, atol=1e-6)


@pytest.mark.once
def test_an_albedo_stays_between_0_and_1():
    """A coordinate moves the logit by half."""
    albedo = np.linspace(0.0, 1.0, 40).reshape(20, 2)
    splats = bodies.with_albedo(bodies.sphere(20), albedo)
    part = sj.inverse.AlbedoMap(step=0.5)
    moved = {by: moved_by(part, splats, jnp.full((20, 2), by)).albedo for by in (-1e3, 0, 1, 1e3)}
    assert all(jnp.all((values >= 0) & (values <= 1)) for values in moved.values())
    for by, inner in ((0, slice(1, -1)), (1, slice(10, 11))):
        expected = 1 / (1 + (1 / albedo[inner] - 1) * np.exp(-0.5 * by))
        np.testing.assert_allclose(moved[by][inner], expected, rtol=1e-5 if by else 1e-4)


@pytest.mark.once
def test_normals_and_areas_follow_a_paraboloid():
    x, y, zero = np.asarray(FLAT.centers).T
    heights = 0.3 + 0.1 * x - 0.05 * y + 0.02 * x * x + 0.03 * x * y - 0.01 * y * y
    normals = np.stack([-0.1 - 0.04 * x - 0.03 * y, 0.05 - 0.03 * x + 0.02 * y, zero + 1], axis=1)
    stretch = np.linalg.norm(normals, axis=1)
    part = sj.inverse.NormalOffsets(step=1.0, smoothness=1e-3, deviation=1.0)  # next to no blur
    moved = moved_by(part, FLAT, jnp.asarray(heights, float))
    np.testing.assert_allclose(moved.centers[:, 2], heights, atol=1e-6)
    np.testing.assert_allclose(moved.normals, normals / stretch[:, None], atol=1e-4)
    np.testing.assert_allclose(moved.areas, FLAT.areas * stretch, rtol=1e-4)


@pytest.mark.once
def test_a_ball_that_grows_stays_a_ball():
    ball = bodies.sphere(400)
    part = sj.inverse.NormalOffsets(step=0.5, smoothness=2.0, deviation=1.0)
    moved = moved_by(part, ball, jnp.full(400, 2.0))
    np.testing.assert_allclose(jnp.linalg.norm(moved.centers, axis=1), 11.0, rtol=1e-5)
    np.testing.assert_allclose(jnp.sum(moved.normals * ball.normals, axis=1), 1.0, atol=1e-4)
    np.testing.assert_allclose(moved.areas, 1.21 * ball.areas, rtol=2e-2)
    np.testing.assert_allclose(moved.radii, 1.1 * ball.radii, rtol=1e-2)


@pytest.mark.once
def test_offsets_are_means_of_coordinates_over_the_same_side_of_a_sheet():
    """The prior: coordinates that make offsets of its deviation cost one each."""
    behind = dataclasses.replace(FLAT, centers=FLAT.centers - 0.2 * FLAT.normals)
    behind = dataclasses.replace(behind, normals=-FLAT.normals)
    both = bodies.joined(FLAT, behind)
    part = sj.inverse.NormalOffsets(step=0.1, smoothness=1.0, deviation=0.3)
    noise = jnp.asarray(np.random.default_rng(4).normal(size=both.count), float)
    x = noise.at[FLAT.count :].set(0.0)
    before, after, of_noise = (moved_by(part, both, each) for each in (0 * x, x, noise))
    offsets = np.abs(after.centers - before.centers)[:, 2]
    assert 0 < np.max(offsets) < 0.1 * np.max(np.abs(x))
    np.testing.assert_array_equal(offsets[FLAT.count :], 0)
    np.testing.assert_allclose(after.normals[FLAT.count :], behind.normals, atol=1e-6)
    expected = np.sum((of_noise.centers - before.centers) ** 2) / 0.3**2
    found = jnp.sum(part.prior_residuals(noise, part.prepared(both)) ** 2)
    np.testing.assert_allclose(found, expected, rtol=0.15)
