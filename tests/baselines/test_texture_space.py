"""Texture-space diffusion: on a flat plane it is splat diffusion, if it knows how the chart is
stretched. What a pixel sees of triangles; and the bust with its colors in textures.
"""

import dataclasses

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from planes import HALF, coordinates, gathered, painted, plane, splatted

import splatjax as sj
from splatjax import baselines

SIZE = 192
# The wider first: layers keep the order of the Gaussians.
TWO = sj.SumOfGaussians(
    jnp.asarray([3.0, 0.5], float), jnp.asarray([[0.5, 0.6, 0.7], [0.5, 0.4, 0.3]], float)
)
DULL = sj.Material(TWO, eta=1.0, specular=0.0)
FRONTAL = sj.DirectionalLight(jnp.asarray([0.0, 0.0, -1.0]), jnp.ones(3), cast_shadows=False)
STILL = baselines.TextureSpaceSettings(
    SIZE, baselines.StretchCorrected(), baselines.OpaqueParts(), sj.diffusion.PlainMean()
)
THIN = dataclasses.replace(
    STILL, thin_parts=baselines.TranslucentShadowMap(), kernel=sj.diffusion.EscapeNormalization()
)


@eqx.filter_jit
def diffused(mesh, settings, plan, uvs):
    light = baselines.mesh_light(mesh, (FRONTAL,), settings.shadows, plan.shadows)
    texels = baselines.rasterize_in_texture(mesh, settings.resolution, plan.texture)
    texture = baselines.diffuse_in_texture(mesh, texels, light, DULL, settings, plan.reaches)
    return baselines.look_up_layers(texture, uvs), texture.renormalized


@pytest.mark.once
@pytest.mark.parametrize(
    ("stretch", "correction", "least", "most"),
    [
        pytest.param(1.0, baselines.StretchCorrected(), 0, 2e-3, marks=pytest.mark.long),  # 1.4e-3
        (3.0, baselines.StretchCorrected(), 0, 1e-2),  # 7.6e-3: texels are 3 times as long
        (3.0, baselines.Uncorrected(), 5e-2, 1),  # 1.1e-1
    ],
)
def test_on_a_plane_it_is_splat_diffusion_if_stretch_is_corrected(stretch, correction, least, most):
    """Differences are of the peak, away from the edges."""
    settings = dataclasses.replace(STILL, stretch=correction)
    mesh = baselines.TexturedMesh.of(plane(stretch), painted(stretch, SIZE))
    plan = baselines.plan_texture_space(
        mesh, (FRONTAL,), DULL, bodies.camera_over(6.0, 8), settings
    )
    line = np.linspace(-HALF / 2, HALF / 2, 16)
    points = np.stack(np.meshgrid(line, line, [0.0]), axis=-1).reshape(-1, 3)
    ours, lost = diffused(mesh, settings, plan, jnp.asarray(coordinates(points, stretch), float))
    assert 0 < lost[1] < lost[0] < 0.2
    truth = splatted(points, TWO)
    assert least < np.max(np.abs(np.asarray(ours) - truth)) / np.max(truth) < most


SHEET = baselines.TexturedMesh.of(plane(2.0))
LIGHTS = (dataclasses.replace(FRONTAL, cast_shadows=True),)
OVER = bodies.camera_over(15.0, 32)


@pytest.mark.once
@pytest.mark.long
def test_constant_light_stays_constant_up_to_the_edges():
    settings = dataclasses.replace(THIN, resolution=64)
    plan = baselines.plan_texture_space(SHEET, LIGHTS, DULL, OVER, settings)
    found = baselines.render_texture_space(SHEET, LIGHTS, DULL, OVER, settings, plan)
    on_chart = np.asarray(found.texture.layers)[:, np.asarray(found.texture.valid) > 0]
    np.testing.assert_allclose(on_chart, 1.0, atol=1e-5)
    frame = found.frame
    covered = np.asarray(frame.coverage) > 0
    assert np.mean(covered) == pytest.approx(0.64, abs=0.04)
    np.testing.assert_allclose(np.asarray(frame.beauty)[covered], 1 / np.pi, rtol=1e-5)
    rebuilt = jnp.einsum("gyxc,gc->yxc", frame.layers, frame.weights)
    np.testing.assert_allclose(frame.diffuse, rebuilt, atol=1e-6)
    assert np.all(np.isinf(np.asarray(frame.depth)[~covered]))
    assert frame.overflow == 0
    # Beyond its capacity the picture is NaN.
    small = dataclasses.replace(plan, camera=10)
    frame = baselines.render_texture_space(SHEET, LIGHTS, DULL, OVER, settings, small).frame
    assert frame.overflow > 1
    assert np.all(np.isnan(np.asarray(frame.beauty)[np.asarray(frame.depth) < np.inf]))


LAMP = sj.PointLight([0.0, 0.0, 2.0], [1.0, 1.0, 1.0])
REFUSED = {
    "no texture coordinates": lambda: baselines.TexturedMesh.of(
        dataclasses.replace(plane(1.0), uvs=None)
    ),
    "0.05 to 1.95": lambda: baselines.TexturedMesh.of(
        dataclasses.replace(plane(1.0), uvs=plane(1.0).uvs * [1.0, 2.0] + [0.0, 0.05])
    ),
    r"lights\[0\] is 2 mm": lambda: baselines.plan_texture_space(SHEET, (LAMP,), DULL, OVER, THIN),
    "plan": lambda: jax.jit(
        lambda mesh: baselines.render_texture_space(mesh, LIGHTS, DULL, OVER).frame
    )(SHEET),
}


@pytest.mark.once
@pytest.mark.parametrize("message", REFUSED)
def test_bad_input_is_refused(message):
    bodies.assert_refused(REFUSED[message], message)


def slab(thickness: float) -> sj.geometry.Mesh:
    front, turn = plane(1.0), [-1.0, 1.0, -1.0]
    halved = front.uvs * [0.5, 1.0]
    pairs = (
        (front.vertices, front.vertices * turn - [0.0, 0.0, thickness]),
        (front.faces, front.faces + len(front.vertices)),
        (front.normals, front.normals * turn),
        (halved, halved + np.asarray([0.5, 0.0])),
    )
    return sj.geometry.Mesh(*map(np.concatenate, pairs))


@pytest.mark.once
@pytest.mark.long
def test_through_a_slab_comes_what_comes_through_splats():
    """Lit from behind: the share and the gain are those of two sheets of splats."""
    thickness, settings = 1.5, dataclasses.replace(THIN, resolution=96)
    mesh, camera = baselines.TexturedMesh.of(slab(thickness)), bodies.camera_over(3.0, 4)
    lights = (sj.DirectionalLight([0, 0, 1], jnp.ones(3)),)
    found = baselines.render_texture_space(mesh, lights, DULL, camera, settings).frame
    ours = np.pi * np.asarray(found.layers)[:, 2, 2]
    faces = bodies.sheet(11.7, 0.6), bodies.sheet(11.7, 0.6, (0, 0, -1), (0, 0, -thickness))
    body, kernel = bodies.joined(*faces), sj.diffusion.EscapeNormalization()
    light = jnp.maximum(jnp.tile(-body.normals[:, 2], (3, 1)), 0)
    sources = sj.diffusion.Sources(body.centers.T, body.normals.T, body.areas, light)
    means, mass = gathered(sources, TWO.variances, kernel, np.zeros((1, 3)))
    mass, weights = jnp.asarray(mass[:, None]), TWO.weights[..., None]
    gain = kernel.gain(mass, TWO.variances, weights, jnp.zeros((3, 1)))
    truth = np.asarray(gain * means)[..., 0]
    assert np.all(truth[0] > 0.05)
    np.testing.assert_allclose(ours, truth, atol=5e-3)


@pytest.mark.slow
@pytest.mark.long
def test_a_picture_has_the_derivatives_that_differences_say(float64):
    settings = dataclasses.replace(STILL, resolution=40)
    mesh = baselines.TexturedMesh.of(plane(1.4), painted(1.4, 24))
    camera = bodies.camera_over(6.0, 8)
    lights = (dataclasses.replace(FRONTAL, direction=jnp.asarray([0.3, 0.2, -1.0])),)
    plan = baselines.plan_texture_space(mesh, lights, DULL, camera, settings)
    pattern = jnp.sin(jnp.arange(8.0 * 8 * 3)).reshape(8, 8, 3)

    @jax.jit
    def seen(variances, albedo, direction, normals):
        painted = dataclasses.replace(mesh, albedo=albedo, normals=normals)
        material = sj.Material(sj.SumOfGaussians(variances, TWO.weights), specular=0.2)
        light = (dataclasses.replace(lights[0], direction=direction),)
        given = painted, light, material, camera, settings, plan
        return jnp.vdot(pattern, baselines.render_texture_space(*given).frame.beauty)

    given = TWO.variances, mesh.albedo, lights[0].direction, mesh.normals
    check_grads(seen, given, order=1, modes=["rev"], rtol=1e-5, atol=1e-5)


PIXELS = 24
CAMERA = sj.Camera.look_at(
    jnp.asarray([6.0, -9.0, 18.0]), jnp.zeros(3), fov=40.0, width=PIXELS, height=PIXELS
)


def seen_from(camera, corners):
    landing = baselines.Landing.in_view(corners, sj.splatting.PerspectiveView.of(camera))
    return landing, baselines.see_faces(landing, baselines.capacity_for(landing))


@pytest.fixture
def corners():
    return jnp.asarray(plane(1.0).corners(), float)


@pytest.mark.once
def test_a_slanted_plane_is_seen_where_its_rays_meet_it_and_has_no_cracks(corners):
    """It hides what is behind; backs, and faces before the eye, are not drawn."""
    farther = 0.5 * corners - jnp.asarray([[[0.0, 0.0, 2.0]]])
    back = corners[:, ::-1] + jnp.asarray([[[0.0, 0.0, 4.0]]])
    behind = corners[:1].at[0, 0].set(jnp.asarray([6.0, -9.0, 30.0]))
    corners = jnp.concatenate([farther, corners, back, behind])
    landing, seen = seen_from(CAMERA, corners)
    positions = baselines.interpolate(corners, seen, baselines.barycentrics(landing, seen))
    expected, covered = bodies.hits(CAMERA), np.asarray(seen.covered)
    assert np.array_equal(covered, np.abs(expected).max(axis=2) < 12)
    assert 0.5 < np.mean(covered) < 1
    np.testing.assert_allclose(np.asarray(positions)[covered], expected[covered], atol=2e-4)
    assert float(seen.needed) <= 1
    assert float(baselines.see_faces(landing, 100).needed) > 1


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
        camera = dataclasses.replace(CAMERA, focal_length=focal_length)
        landing = baselines.Landing.in_view(corners, sj.splatting.PerspectiveView.of(camera))
        shares = baselines.barycentrics(landing, seen)
        return jnp.sum(jnp.sin(baselines.interpolate(values, seen, shares)))

    given = corners, values, CAMERA.focal_length
    check_grads(picture, given, order=1, modes=["rev"], rtol=1e-6, atol=1e-6)
