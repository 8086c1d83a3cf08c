"""Environments and area lights: what samples stand for them, against integrals in closed form.
Relighting by spherical harmonics: a kept view against the picture that is rendered.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import (
    PLAIN,
    apart,
    assert_refused,
    camera_over,
    irradiance,
    joined,
    map_directions,
    sheet,
    sphere,
    two_gaussians,
    unit,
)
from jax.test_util import check_grads
from pictures import write_picture

import splatjax as sj
from splatjax.scene import (
    DiskLight,
    HarmonicLight,
    RectangleLight,
    SphereLight,
    even_directions,
    spherical_harmonics,
)

BARE = sj.Material(two_gaussians(), eta=1.0, specular=0.0)
GLOSSY = sj.Material(two_gaussians(), specular=1.0, roughness=0.4)
SINGLE = sj.SingleScattering(sj.Medium([0.1, 0.02, 0.5], [0.9, 0.98, 0.5], 1.3))
CAMERA = sj.Camera.look_at([0, 0, 60], [0, 0, 0], fov=24, width=24, height=24)
SHADOWS = sj.splatting.ShadowSettings(resolution=512)
TILES = sj.RenderSettings(
    diffuser=sj.diffusion.DenseDiffuser(), shadows=SHADOWS, sample_shadows=SHADOWS
)
# Root mean square, and largest error of the irradiance over its largest value, by count.
SAMPLED = {16: (0.05, 0.15), 64: (0.015, 0.045), 256: (0.004, 0.012)}
BODY = joined(sphere(1500, 10.0), sphere(400, 3.0, (4.0, 6.0, 12.0)))


def harmonics(rows: int = 64) -> np.ndarray:
    """Radiance of the bands 0, 1 and 2, one in each channel."""
    d = map_directions(rows)
    first = 1 + d @ np.asarray([0.6, 0.5, -0.3])
    return np.stack([np.ones(first.shape), first, 1 + d[..., 0] * d[..., 1]], axis=-1)


def render(light, body: sj.Splats, material=BARE, camera=CAMERA, settings=PLAIN) -> sj.Frame:
    return sj.render(sj.Scene(body, (light,), material), camera, settings)


def received(light, body: sj.Splats) -> np.ndarray:
    return irradiance(sj.Scene(body, (light,), BARE)).T


@pytest.mark.once
@pytest.mark.parametrize("is_even", [False, True])
@pytest.mark.parametrize("count", SAMPLED)
def test_irradiance_on_a_ball_is_that_of_the_harmonic_bands(count, is_even):
    """pi, 2 pi / 3 and pi / 4 times the radiance of each band, to the sampling error."""
    body = sphere(600)
    samples = {"directions": even_directions(count)} if is_even else {"count": count}
    light = sj.EnvironmentLight(harmonics(), **samples, cast_shadows=False)
    n = np.asarray(body.normals, float)
    first = np.pi + 2 * np.pi / 3 * n @ np.asarray([0.6, 0.5, -0.3])
    exact = [np.full(len(n), np.pi), first, np.pi + np.pi / 4 * n[:, 0] * n[:, 1]]
    error = (received(light, body) - np.stack(exact, axis=-1)) / np.max(exact)
    root_mean_square, largest = SAMPLED[count]
    assert np.sqrt(np.mean(error**2)) < root_mean_square
    assert np.max(np.abs(error)) < largest


@pytest.mark.long
@pytest.mark.once
def test_an_environment_of_one_pixel_is_a_directional_light():
    image = np.zeros((32, 64, 3))
    image[9, 40] = [100, 200, 300]
    toward, strip = map_directions(32)[9, 40], np.diff(np.cos(np.pi * np.asarray([10, 9]) / 32))
    lamp = sj.DirectionalLight(-toward, image[9, 40] * strip * np.pi / 32)
    ours, lamps = (render(light, BODY, GLOSSY) for light in (sj.EnvironmentLight(image), lamp))
    assert np.max(apart(ours.diffuse, lamps.diffuse)[""]) < 2e-3
    assert float(np.sum(ours.specular) / np.sum(lamps.specular)) == pytest.approx(1, abs=0.05)
    assert apart(ours.shadow, lamps.shadow)[""] < 5e-3


@pytest.mark.once
def test_an_environment_is_the_sum_of_its_samples_in_every_layer():
    """Its shadow is theirs, weighted by the light that each would bring to the sheet."""
    body = joined(sheet(6.0, 0.4), sphere(150, 2.0, (-1.0, 2.0, 4.0)))
    material = dataclasses.replace(BARE, single_scattering=SINGLE)
    sky = sj.EnvironmentLight(np.random.default_rng(1).uniform(size=(4, 8, 3)) ** 4, count=6)
    lamps = [sj.DirectionalLight(each.direction, each.irradiance) for each in sky.samples()]
    camera = sj.Camera.look_at([0, -30, 30], [0, 0, 0], fov=14, width=24, height=24)
    ours, theirs = (
        sj.render(sj.Scene(body, lights, material), camera, PLAIN) for lights in (sky, lamps)
    )
    for layer in ("diffuse", "single_scattering", "irradiance", "albedo", "beauty"):
        assert apart(getattr(ours, layer), getattr(theirs, layer))[""] < 1e-5
    brought = [max(-float(s.direction[2]), 0) * float(np.sum(s.irradiance)) for s in sky.samples()]
    shadow = np.tensordot(brought, theirs.shadow, 1) / np.sum(brought)
    is_sheet = np.asarray((ours.normal[..., 2] > 0.999) & (ours.position[..., 2] < 0.1))
    np.testing.assert_allclose(ours.shadow[0][is_sheet], shadow[is_sheet], atol=1e-2)
    assert np.min(shadow[is_sheet]) < 0.5 < 0.99 < np.max(shadow[is_sheet])


@pytest.mark.once
@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_a_turned_map_is_a_body_turned_back(up):
    """Where z is up, the middle of the map is -y."""
    sine, cosine = np.sin(np.radians(50)), np.cos(np.radians(50))
    about_y = np.asarray([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
    x, y = np.asarray([1.0, 0.0, 0.0]), np.asarray(up)
    rotation = np.stack([x, y, np.cross(x, y)], axis=1) @ about_y
    back = dataclasses.replace(BODY, normals=np.asarray(BODY.normals, float) @ rotation)
    straight = sj.EnvironmentLight(harmonics(), cast_shadows=False)
    turned = received(dataclasses.replace(straight, rotation=50.0, up=up), BODY)
    np.testing.assert_allclose(turned, received(straight, back), rtol=1e-4, atol=1e-2)


@pytest.mark.once
def test_the_camera_sees_the_map_behind_a_body():
    """`1 + a . d` along the ray of every pixel, where the body does not cover it."""
    camera = sj.Camera.look_at([5, 40, 30], [0, 0, 0], fov=100, width=24, height=16)
    camera = dataclasses.replace(camera, principal_point=[0.625, 0.375])
    light = sj.EnvironmentLight(harmonics(128), 50.0, count=4, cast_shadows=False)
    frame = render(light, sphere(400), camera=camera)
    pixels = np.mgrid[:16, :24][::-1].reshape(2, -1).T + 0.5
    rays = np.column_stack([(pixels - [15, 6]) / 16, np.full(384, float(camera.focal_length))])
    x, y, z = unit(rays @ np.asarray(camera.rotation, float)).T
    sine, cosine = np.sin(np.radians(50)), np.cos(np.radians(50))
    turned = cosine * x - sine * z, y, sine * x + cosine * z
    seen = (1 + np.asarray([0.6, 0.5, -0.3]) @ np.stack(turned)).reshape(16, 24)
    open_share = 1 - np.asarray(frame.coverage)
    assert 100 < np.sum(open_share > 0.99) < 380
    found = (light.behind(frame, camera) - frame.beauty)[..., 1]
    np.testing.assert_allclose(found, open_share * seen, atol=2e-3)


EVEN = even_directions(24)


def under_two(image, rotation=0.0, strength=1.0) -> sj.Scene:
    sky = sj.EnvironmentLight(image, rotation, directions=EVEN)
    return sj.Scene(BODY, (sky, sj.DirectionalLight([0.3, -0.2, -1], strength)), BARE)


@pytest.mark.long
@pytest.mark.once
def test_kept_shadows_serve_other_strengths_images_and_rotations():
    first = under_two(np.ones((8, 16, 3)), strength=[1, 1, 1])
    plan = sj.make_plan(first, CAMERA, PLAIN)
    kept = sj.transfer(first, plan, PLAIN)
    for image, rotation, most in ((np.full((8, 16, 3), 0.3), 0, 1e-5), (harmonics(8), 70, 0.05)):
        scene = under_two(image, rotation, [0.1, 2, 3])
        light, exact = (sj.illuminate(scene, plan, PLAIN, light=given) for given in (kept, None))
        apart_by = np.abs(light.irradiance.entering - exact.irradiance.entering)
        assert np.max(apart_by) < most * np.max(exact.irradiance.entering)
        frames = (sj.render(scene, CAMERA, PLAIN, plan, light=each) for each in (kept, exact))
        assert apart(*(frame.beauty for frame in frames))[""] < most
    one = sj.Scene(BODY, first.lights[0], BARE)
    for refused in (sj.render, sj.diffusion_basis):
        assert_refused(
            partial(refused, one, CAMERA, PLAIN, sj.make_plan(one, CAMERA, PLAIN), light=kept),
            r"light has visibility .* scene",
        )


def test_light_with_kept_shadows_has_its_derivatives(float64):
    plan = sj.make_plan(under_two(harmonics(8)), CAMERA, PLAIN)
    kept = sj.transfer(under_two(harmonics(8)), plan, PLAIN)
    factors = np.random.default_rng(3).normal(size=(3, BODY.count))

    def weighed(image, rotation):
        light = sj.illuminate(under_two(image, rotation), plan, PLAIN, light=kept)
        return jnp.vdot(factors, light.irradiance.entering[:, : BODY.count])

    check_grads(jax.jit(weighed), (jnp.asarray(harmonics(8)), 20.0), 1, ["rev"], rtol=1e-6)


PLACE, FACING = np.asarray([400.0, 300.0, 1200.0]), unit([-400.0, -300.0, -1200.0])
ACROSS = np.cross(FACING, [0.0, 1.0, 0.0])
FAR = {
    "rectangle": RectangleLight(
        PLACE, [1, 2, 3], [2 * unit(ACROSS), unit(np.cross(FACING, ACROSS))]
    ),
    "disk": DiskLight(PLACE, [1, 2, 3], FACING, 1.0),
    "sphere": SphereLight(PLACE, [1, 2, 3], 1.0),
}


@pytest.mark.long
@pytest.mark.once
@pytest.mark.parametrize(
    "kind",
    ["rectangle", *(pytest.param(each, marks=pytest.mark.long) for each in ("disk", "sphere"))],
)
def test_a_far_area_light_is_a_point_light(kind):
    area = 2 if kind == "rectangle" else np.pi
    point = sj.PointLight(PLACE, area * np.asarray([1.0, 2.0, 3.0]))
    area_light, lamp = (render(light, BODY, GLOSSY) for light in (FAR[kind], point))
    assert apart(area_light.diffuse, lamp.diffuse)[""] < 2e-3
    assert apart(area_light.specular, lamp.specular)[""] < 2e-2
    assert np.max(lamp.specular) > 0.1 * np.max(lamp.diffuse)


@pytest.mark.once
def test_a_rectangle_that_fills_the_sky_is_mirrored_with_its_radiance():
    """A sheet under it reflects as under an environment of that radiance."""
    edges, few = [[4e3, 0, 0], [0, -4e3, 0]], {"count": 4, "cast_shadows": False}
    big = RectangleLight([0, 0, 100], 1.0, edges, **few)
    sky = sj.EnvironmentLight(np.ones((8, 16, 1)), **few)
    camera = camera_over(2.0, 8, slant=20.0)
    found, expected = (
        np.asarray(render(light, sheet(5.0, 1.0), GLOSSY, camera).specular) for light in (big, sky)
    )
    np.testing.assert_allclose(found, expected, rtol=0.05)


@pytest.mark.long
@pytest.mark.once
def test_a_soft_shadow_is_the_fraction_of_the_rectangle_that_is_seen():
    """Behind the edge x = 0 of a sheet 30 mm above, under a rectangle of 40 mm at 200 mm."""
    body = joined(sheet(14.0, 0.25), sheet(8.0, 0.25, center=(-8.125, 0.0, 30.0)))
    light = RectangleLight([0, 0, 200], 1.0, [[40, 0, 0], [0, -40, 0]])
    camera = sj.Camera.look_at([25, 0, 20], [0, 0, 0], fov=10, width=48, height=48)
    frame = render(light, body, settings=TILES, camera=camera)
    x, shadow = np.asarray(frame.position)[24, :, 0], np.asarray(frame.shadow)[0, 24]
    exact = np.clip((20 + x * (200 - 30) / 30) / 40, 0, 1)
    assert np.min(exact) < 0.1 < 0.9 < np.max(exact)
    assert np.max(np.abs(shadow - exact)) < 0.035  # a sheet ends a radius late


@pytest.mark.once
@pytest.mark.long
def test_another_environment_of_the_size_compiles_nothing_and_keeps_the_plan(compiled):
    # Edge-on and face-on it needs other capacities.
    body, sun = sheet(8.0, 0.25, normal=(1.0, 0.0, 0.2)), sj.scene.sun_and_sky(height=32)
    first = sj.Scene(body, sj.EnvironmentLight(sun, count=8), BARE)
    plan = sj.make_plan(first, CAMERA, TILES)
    before = sj.render(first, CAMERA, TILES, plan)
    dim = np.asarray(0.1 * sun)
    compiled.clear()
    for way in np.linspace(10.0, 350.0, 7):
        scene = sj.Scene(body, sj.EnvironmentLight(dim, way, count=8), BARE)
        frame = sj.render(scene, CAMERA, TILES, plan)
        assert float(frame.overflow) == 0
        assert not np.array_equal(frame.beauty, before.beauty)
    assert compiled == []


@pytest.mark.once
def test_maps_of_merged_splats_let_in_the_light_that_full_maps_do():
    """A small ball beside a large one: eight splats to a disc, and a sixteenth of the pixels."""
    scene = sj.Scene(BODY, sj.EnvironmentLight(harmonics(), count=8), BARE)
    shadows = sj.splatting.ShadowSettings
    fine, coarse = (
        dataclasses.replace(TILES, sample_shadows=each)
        for each in (
            shadows(resolution=256),
            shadows(resolution=64, compared=2, merged_spacing=6.0),
        )
    )
    full, found = irradiance(scene, fine), irradiance(scene, coarse)
    assert sj.make_plan(scene, CAMERA, coarse).shadows[0].splats_per_disc == 8
    assert np.sqrt(np.mean((found - full) ** 2)) < 0.04 * np.mean(full)
    assert np.mean(found) == pytest.approx(np.mean(full), rel=0.02)


@pytest.mark.once
def test_skies_have_the_irradiance_that_they_say():
    body = sheet(1.0, 1.0, normal=(0.0, 1.0, 0.0))
    sky = sj.EnvironmentLight(sj.scene.overcast_sky(), count=1024, cast_shadows=False)
    assert received(sky, body) == pytest.approx(np.pi, rel=3e-3)
    azimuth, height = np.radians(-40), np.radians(35)
    sun = [np.sin(azimuth) * np.cos(height), np.sin(height), np.cos(azimuth) * np.cos(height)]
    for image in (sj.scene.studio(), sj.scene.sun_and_sky(height=64)):
        light = sj.EnvironmentLight(image, count=1024, cast_shadows=False)
        towards = received(light, sheet(1.0, 1.0, normal=sun))
        assert np.all((towards > 2.5) & (towards < 3.8))


environment = partial(partial, sj.EnvironmentLight)
NAN = np.where(np.arange(24).reshape(2, 4, 3) == 18, np.nan, 1.0)
REFUSED = [
    (environment(np.ones((4, 4, 3))), "EnvironmentLight.image has 4 rows and 4 columns"),
    (environment(NAN), r"EnvironmentLight.image .*replace.* 1 of 24 .* nan at \[1, 2, 0\]"),
    (environment(-np.ones((2, 4, 3))), "EnvironmentLight.image .*clip.* -1"),
    (environment(np.ones((2, 4, 3), np.uint8)), "EnvironmentLight.image .*uint8.*floating"),
    (environment(np.ones((2, 4, 3)), count=0), "EnvironmentLight.count .*got 0"),
    (environment(np.ones((2, 4, 3)), up=(0, 0, 0)), "EnvironmentLight.up .*not zero"),
    (environment(np.ones((2, 4, 3)), directions=[[0, 0, 0]]), "EnvironmentLight.directions .*zero"),
    (lambda: RectangleLight([0] * 3, 1, [[1, 0, 0], [2, 0, 0]]), "RectangleLight.edges .*area"),
    (lambda: SphereLight([0, 0, 0], 1, 0), "SphereLight.radius .*positive"),
    (lambda: HarmonicLight(np.zeros((5, 3))), "HarmonicLight.coefficients has 5 rows"),
]


@pytest.mark.once
@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_lights_that_cannot_be_are_refused_by_name(call, message):
    assert_refused(call, message)


@pytest.mark.once
def test_environments_are_read_and_large_ones_averaged(tmp_path):
    image = harmonics(1040)
    path = write_picture(tmp_path / "map.hdr", image)
    light = sj.io.load_environment(path, rotation=30.0, count=16)
    assert light.image.shape == (260, 520, 3)
    assert (float(light.rotation), light.count) == (30.0, 16)
    assert float(jnp.mean(light.image)) == pytest.approx(np.mean(image), rel=0.01)  # 8-bit mantissa
    bad = write_picture(tmp_path / "bad.exr", np.ones((4, 6, 3)))
    assert_refused(
        lambda: sj.io.load_environment(bad), r"bad\.exr: EnvironmentLight.image has 4 rows"
    )


SCATTERED_ONCE = sj.Material(two_gaussians(), specular=0.5, single_scattering=SINGLE)
TWO_BALLS = joined(sphere(500, 10.0), sphere(100, 3.0, (4.0, 6.0, 12.0)))
HARMONIC = {64: 0.03, 256: 0.004}  # largest error of the irradiance, by count


DARK = HarmonicLight(np.zeros((9, 3)), count=12)


@pytest.mark.once
def test_a_kept_view_is_the_picture_with_its_gradient():
    """In the pixels and the rotation of an environment, and under light of both signs."""
    rng = np.random.default_rng(0)
    image, factors = jnp.asarray(rng.uniform(size=(8, 16, 3))), rng.normal(size=(24, 24, 3))
    scene = sj.Scene(TWO_BALLS, DARK, SCATTERED_ONCE)
    plan = sj.make_plan(scene, CAMERA, PLAIN)
    kept = sj.transfer(scene, plan, PLAIN)
    basis = sj.relighting_basis(scene, CAMERA, PLAIN, plan, light=kept)

    def rendered(light):
        scene = sj.Scene(TWO_BALLS, light, SCATTERED_ONCE)
        return sj.render(scene, CAMERA, PLAIN, plan, light=kept).beauty

    def weighed(picture):
        def of(image, rotation):
            beauty = picture(HarmonicLight.of(sj.EnvironmentLight(image, rotation), 2, count=12))
            return jnp.vdot(factors, beauty), beauty

        return jax.jit(jax.value_and_grad(of, (0, 1), has_aux=True))(image, 40.0)

    assert max(apart(weighed(basis.beauty), weighed(rendered)).values()) < 2e-5
    few = np.pad(image[0, :4], ((0, 5), (0, 0)))
    assert np.array_equal(*(basis.beauty(HarmonicLight(each)) for each in (few, few[:4])))
    assert_refused(
        lambda: basis.beauty(HarmonicLight(np.zeros((16, 3)))),
        r"light has 16 harmonics, and the basis .* for 9",
    )


@pytest.mark.once
@pytest.mark.parametrize("count", HARMONIC)
def test_irradiance_on_a_ball_is_that_of_its_bands(count):
    """pi, 2 pi / 3, pi / 4 and 0 times the radiance, for each harmonic up to the third band."""
    body = sphere(300)
    factor = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0], [1, 3, 5, 7])
    exact = factor * np.asarray(spherical_harmonics(body.normals, 3))
    gaussians = sj.SumOfGaussians([1.0], np.ones((1, 16)))
    light = HarmonicLight(np.eye(16), count=count, cast_shadows=False)  # one for each channel
    scene = sj.Scene(body, light, sj.Material(gaussians, eta=1.0, specular=0.0))
    assert np.max(np.abs(irradiance(scene).T - exact)) < HARMONIC[count]


@pytest.mark.once
def test_visibility_from_given_directions_serves_every_environment():
    """Kept for one image and rotation, it is that of others."""
    images = np.random.default_rng(1).uniform(size=(2, 8, 16, 3))
    directions = sj.scene.even_directions(12)
    scenes = [
        sj.Scene(TWO_BALLS, sj.EnvironmentLight(image, turn, directions=directions), SCATTERED_ONCE)
        for image, turn in zip(images, (0.0, 70.0), strict=True)
    ]
    plan = sj.make_plan(scenes[0], CAMERA, PLAIN)
    kept = sj.transfer(scenes[0], plan, PLAIN)
    again, anew = (
        sj.render(scenes[1], CAMERA, PLAIN, plan, light=light).beauty for light in (kept, None)
    )
    np.testing.assert_allclose(again, anew, atol=1e-6)
    assert float(jnp.max(anew)) > 0.1
    for others in (-directions, None):
        changed = sj.EnvironmentLight(images[1], directions=others, count=12)
        scene = sj.Scene(TWO_BALLS, changed, SCATTERED_ONCE)
        assert_refused(
            lambda scene=scene: sj.render(scene, CAMERA, PLAIN, plan, light=kept),
            "lights in other directions",
        )


@pytest.mark.once
def test_a_harmonic_light_of_one_channel_is_gray():
    light = HarmonicLight([[1.0], [0.3], [-0.2], [0.1]], count=64, cast_shadows=False)
    gaussians = sj.SumOfGaussians([1.0], np.ones((1, 3)))
    scene = sj.Scene(sphere(300), light, sj.Material(gaussians, eta=1.0, specular=0.0))
    found = irradiance(scene)
    np.testing.assert_array_equal(found, np.broadcast_to(found[:1], found.shape))
    np.testing.assert_allclose(np.mean(found), np.pi / np.sqrt(4 * np.pi), rtol=0.01)


def test_an_environment_of_one_harmonic_has_its_coefficient():
    """Turned by 90 degrees about y, the harmonics of z and x are those of x and -z."""
    eye = np.eye(4)[:, [0, 2, 3]]
    image = 1 + HarmonicLight(eye).radiance(jnp.asarray(map_directions(128)))
    even = np.sqrt(4 * np.pi) * np.eye(9)[:, :1]
    for rotation, expected in ((0.0, eye), (90.0, np.eye(4)[:, [0, 3, 2]] * [1, 1, -1])):
        light = HarmonicLight.of(sj.EnvironmentLight(image, rotation), 2)
        np.testing.assert_allclose(
            light.coefficients, even + np.pad(expected, ((0, 5), (0, 0))), atol=2e-3
        )
