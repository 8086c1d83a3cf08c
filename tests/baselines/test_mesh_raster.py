"""What a pixel sees of triangles: the right one, at the right place, with the right derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import hits
from jax.test_util import check_grads
from planes import plane

import splatjax as sj
from splatjax import baselines
from splatjax.splatting import PerspectiveView

SIZE = 24
CAMERA = sj.Camera.look_at(
    jnp.asarray([6.0, -9.0, 18.0]), jnp.zeros(3), fov=40.0, width=SIZE, height=SIZE
)


def seen_from(camera, corners):
    landing = baselines.Landing.in_view(corners, PerspectiveView.of(camera))
    return landing, baselines.see_faces(landing, baselines.capacity_for(landing))


@pytest.fixture
def corners():
    mesh = plane(1.0)
    return jnp.asarray(mesh.corners(), float)


@pytest.mark.once
def test_a_slanted_plane_is_seen_where_its_rays_meet_it_and_has_no_cracks(corners):
    landing, seen = seen_from(CAMERA, corners)
    positions = baselines.interpolate(corners, seen, baselines.barycentrics(landing, seen))
    expected, covered = hits(CAMERA), np.asarray(seen.covered)
    assert np.array_equal(covered, np.abs(expected).max(axis=2) < 12)
    assert 0.5 < np.mean(covered) < 1
    np.testing.assert_allclose(np.asarray(positions)[covered], expected[covered], atol=2e-4)
    assert float(seen.needed) <= 1
    assert float(baselines.see_faces(landing, 100).needed) > 1


@pytest.mark.once
def test_the_nearest_face_hides_the_others_and_backs_and_faces_before_the_eye_are_not_drawn(
    corners,
):
    nearer = corners + jnp.asarray([0.0, 0.0, 2.0])[None, None]
    back = corners[:, ::-1] + jnp.asarray([0.0, 0.0, 4.0])[None, None]
    behind = corners[:1].at[0, 0].set(jnp.asarray([6.0, -9.0, 30.0]))
    _, seen = seen_from(CAMERA, jnp.concatenate([corners, nearer, back, behind]))
    faces = np.asarray(seen.faces)[np.asarray(seen.covered)]
    assert np.all(faces < 2 * len(corners))
    assert np.asarray(seen.faces)[SIZE // 2, SIZE // 2] >= len(corners)


@pytest.mark.once
def test_faces_cover_a_texture_without_gaps_mirrored_or_not():
    mesh = plane(1.0)
    for uvs in (mesh.uvs, mesh.uvs * [-1.0, 1.0] + [1.0, 0.0]):
        landing = baselines.Landing.in_texture(jnp.asarray(uvs, float), 40)
        covered = np.asarray(baselines.see_faces(landing, baselines.capacity_for(landing)).covered)
        assert np.array_equal(covered, np.pad(np.ones((36, 36), bool), 2))


@pytest.mark.slow
def test_attributes_have_the_derivatives_that_differences_say(float64, corners):
    _, seen = seen_from(CAMERA, corners)
    values = jnp.sin(corners) + 2.0

    @jax.jit
    def picture(corners, values, focal_length):
        camera = sj.Camera(CAMERA.position, CAMERA.rotation, focal_length, SIZE, SIZE)
        landing = baselines.Landing.in_view(corners, PerspectiveView.of(camera))
        return jnp.sum(
            jnp.sin(baselines.interpolate(values, seen, baselines.barycentrics(landing, seen)))
        )

    check_grads(
        picture,
        (corners, values, CAMERA.focal_length.astype(float)),
        order=1,
        modes=["fwd", "rev"],
        rtol=1e-6,
        atol=1e-6,
    )
