"""Energy, white, interfaces, limits, and what silhouettes cover; single scattering as a term of its
own.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import (
    PLAIN,
    TILED,
    assert_close,
    bumpy,
    camera_over,
    directions,
    sheet,
    sphere,
    two_gaussians,
    with_albedo,
)

import splatjax as sj
from splatjax.render import _checks

EXITANCE_TOLERANCE = 1e-3
TILES = dataclasses.replace(TILED, diffuser=sj.diffusion.DenseDiffuser())


def lamp(
    irradiance=(1.0, 1.0, 1.0), direction=(0.0, 0.0, -1.0), cast_shadows=False
) -> sj.DirectionalLight:
    return sj.DirectionalLight(direction, irradiance, cast_shadows)


def assert_all_nan(*arrays) -> None:
    assert all(np.all(np.isnan(array)) for array in arrays)


@pytest.mark.once
@pytest.mark.parametrize("color", ["of the material", "without scattering", "of the splats"])
def test_exitance_over_irradiance_is_the_total_reflectance_or_the_albedo(color):
    splats, gaussians = sheet(30.0, 1.0), sj.load_material("skin1").gaussians
    material = sj.Material(gaussians, eta=1.0, specular=0.0)
    reflectance = gaussians.total_reflectance()
    if color == "without scattering":
        material = material.opaque()
    elif color == "of the splats":
        material, reflectance = material.white(), (0.8, 0.4, 0.1)
        splats = with_albedo(splats, np.tile(reflectance, (splats.count, 1)))
    scene = sj.Scene(splats, lamp((np.pi,) * 3), material)
    radiance = np.asarray(sj.render(scene, camera_over(8.0, 32), PLAIN).beauty)[8:-8, 8:-8]
    np.testing.assert_allclose(
        radiance, np.broadcast_to(reflectance, radiance.shape), rtol=EXITANCE_TOLERANCE
    )


# Lights of radiance 1 from everywhere, and the least and most that a white ball may show: a sum
# over lights is coarse where the lobe is narrow, at the rim.
FURNACES = {
    "environment": (
        lambda: sj.EnvironmentLight(np.ones((8, 16)), cast_shadows=False),
        *(0.95, 1.05),
    ),
    "lamps": (
        lambda: [lamp((4 * np.pi / 512,) * 3, way) for way in directions(512, jitter=0.0)],
        *(0.98, 1.007),
    ),
}


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.parametrize("lights", ["environment", pytest.param("lamps", marks=pytest.mark.long)])
def test_white_furnace(lights):
    lights, least, most = FURNACES[lights]
    white = sj.Material(two_gaussians().white(), specular=1.0, roughness=0.6)
    camera = sj.Camera.look_at([0, 0, 400], [0, 0, 0], fov=16, width=32, height=32)
    frame = sj.render(sj.Scene(sphere(4000, 50.0), lights(), white), camera, PLAIN)
    covered = np.asarray(frame.coverage) > 0.999
    radiance = np.asarray(frame.beauty)[covered]
    assert covered.sum() > 600
    assert least < radiance.min() < radiance.max() < most
    assert np.mean(radiance) == pytest.approx(1, abs=0.015)
    assert np.max(frame.specular) > 0.1


@pytest.mark.once
def test_light_is_added_linearly_and_layers_add_up_to_the_picture():
    splats, material = sphere(1500, 50.0), sj.Material(two_gaussians())
    bright, colored, none = (1.0, 2.0, 3.0), (3.0, 1.0, 0.5), (0.0, 0.0, 0.0)
    pictures = []
    for one, other in ((bright, colored), (bright, none), (none, colored)):
        lights = lamp(one, (-1.0, 0.0, -0.2), cast_shadows=True), lamp(other, (0.5, -1.0, -0.7))
        frame = sj.render(sj.Scene(splats, lights, material), camera_over(60.0, 24), PLAIN)
        pictures.append(frame.beauty)
        total = np.einsum("kc,khwc->hwc", frame.weights, frame.layers)
        sums = total, frame.diffuse + frame.specular
        assert_close((frame.diffuse, frame.beauty), sums, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(pictures[0], pictures[1] + pictures[2], atol=2e-6)


@pytest.mark.once
def test_the_index_and_not_the_lobe_decides_what_enters_and_leaves():
    splats, light = sheet(16.0, 1.0), lamp((np.pi,) * 3, (0.0, -0.8, -0.6))

    def diffuse(**surface):
        scene = sj.Scene(splats, (light,), sj.Material(two_gaussians(), **surface))
        return np.asarray(sj.render(scene, camera_over(6.0, 8), PLAIN).diffuse)[4, 4]

    bare = diffuse(eta=1.5, specular=0.0)
    np.testing.assert_array_equal(diffuse(eta=1.5, specular=1.0), bare)
    # Smooth, the sheet takes in what Fresnel's term leaves and sends back more along the normal.
    reflected, mean = 0.04 + 0.96 * 0.4**5, 0.04 + 0.96 / 21
    expected = (1 - reflected) * 0.96 / (1 - mean)
    smooth = diffuse(eta=1.5, roughness=0.05) / diffuse(eta=1.0)
    np.testing.assert_allclose(smooth, expected, rtol=5e-3)
    assert np.all(bare < 0.99 * diffuse(eta=1.0, specular=0.0))


@pytest.mark.once
def test_no_splats_and_no_lights_give_an_empty_and_a_black_picture():
    material, camera = sj.Material(two_gaussians()), camera_over(5.0, 16)
    nothing = sj.Splats(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros(0), jnp.zeros(0))
    empty = sj.render(sj.Scene(nothing, (lamp(),), material), camera, PLAIN)
    assert np.all(np.isinf(empty.depth))
    assert not np.any(empty.coverage) | np.any(empty.beauty)
    _checks._warn_once.cache_clear()
    with pytest.warns(UserWarning, match="no light"):
        dark = sj.render(sj.Scene(sheet(5.0, 1.0), (), material), camera, PLAIN)
    assert np.all(dark.beauty == 0)
    assert dark.shadow.shape == (0, 16, 16)


@pytest.mark.once
def test_a_plan_holds_for_splats_that_move_a_little_and_else_poisons_the_picture():
    """Over a tile's edge, and away from the eye: what is seen then was not seen when it was
    planned.
    """
    camera, material = camera_over(5.0, 32), sj.Material(two_gaussians())
    scene = sj.Scene(sheet(1.0, 0.25), (lamp(),), material)
    plan = sj.make_plan(scene, camera, TILED)
    for offset in ([0.1, 0.1, 0.0], [-0.1, 0.1, 0.1], [0.0, -0.1, -0.1]):
        centers = scene.splats.centers + jnp.asarray([offset])
        moved = eqx.tree_at(lambda s: s.splats.centers, scene, centers)
        assert float(sj.render(moved, camera, TILED, plan).overflow) == 0
    wider = eqx.tree_at(
        lambda s: s.material.gaussians.variances, scene, 2 * material.gaussians.variances
    )
    frame = sj.render(wider, camera, TILED, plan)
    assert float(frame.overflow) > 1
    assert_all_nan(frame.beauty, frame.coverage)


@pytest.mark.once
def test_a_plan_for_too_few_splats_poisons_the_picture_and_its_derivative():
    """For half as many as are in front."""
    scene = sj.Scene(sheet(6.0, 1.0), lamp(), sj.Material(two_gaussians()))
    camera = camera_over(5.0, 16)
    plan = sj.make_plan(scene, camera, TILES)
    half = dataclasses.replace(plan.raster, splats=plan.raster.splats // 2)
    short = dataclasses.replace(plan, raster=half)

    @jax.jit
    @jax.value_and_grad
    def total(radii):
        moved = eqx.tree_at(lambda s: s.splats.radii, scene, radii)
        return jnp.sum(sj.render(moved, camera, TILES, short).beauty)

    picture, slope = total(scene.splats.radii)
    assert np.isnan(picture)
    assert np.any(np.isnan(slope))  # where a pixel sees a splat: no step can be taken


@pytest.mark.once
def test_a_light_that_has_come_among_the_splats_needs_another_plan():
    """Its map was planned as one frustum around them all."""
    splats, camera = sheet(3.0, 1.0), camera_over(2.0, 8)

    def scene(height: float):
        light = sj.PointLight([0.0, 0.0, height], [1, 1, 1])
        return sj.Scene(splats, light, sj.Material(two_gaussians()))

    plan = sj.make_plan(scene(20.0), camera, PLAIN)
    assert float(sj.render(scene(12.0), camera, PLAIN, plan).overflow) == 0
    for height in (1.0, 0.0):
        frame = sj.render(scene(height), camera, PLAIN, plan)
        assert float(frame.overflow) > 1
        assert_all_nan(frame.beauty)


COLORS = (0.25, 0.5, 1.0)


def with_single_scattering(eta=1.3):
    single = sj.SingleScattering(sj.Medium([0.1, 0.02, 0.5], [0.9, 0.98, 0.5], eta))
    gaussians = sj.SumOfGaussians([1.0, 4.0], [[0.1, 0.2, 0.05], [0.1, 0.3, 0.02]])
    return sj.Material(gaussians, eta=eta, specular=0.0, single_scattering=single)


def picture(with_single_scattering):
    splats = sheet(3.0, 0.2)
    splats = with_albedo(splats, np.tile(COLORS, (splats.count, 1)))
    light = sj.DirectionalLight([0.6, 0.0, -0.8], [1.0, 2.0, 3.0], cast_shadows=False)
    camera = sj.Camera.look_at([0, 3, 4], [0, 0, 0], fov=2, width=4, height=4)
    return sj.render(sj.Scene(splats, (light,), with_single_scattering), camera, PLAIN)


@pytest.mark.once
def test_it_is_its_formula_and_part_of_the_beauty():
    """The albedo colors it as it colors the rest."""
    lit, entered = with_single_scattering(), 0.8 * np.asarray([1.0, 2.0, 3.0])
    frame = picture(lit)
    reflected = lit.single_scattering.reflected(jnp.asarray(0.8), jnp.asarray(0.8))
    enters = 1 - sj.shading.directional_albedo(
        jnp.asarray(0.8), sj.shading.fresnel_f0(lit.eta), lit.roughness
    )
    expected = np.asarray(reflected * enters) * entered * COLORS
    np.testing.assert_allclose(frame.single_scattering[2, 2], expected, rtol=1e-3)
    parts = frame.diffuse + frame.specular + frame.single_scattering
    np.testing.assert_allclose(frame.beauty, parts, rtol=1e-6)
    plain = picture(lit.surface_of(lit.gaussians))
    assert plain.single_scattering is None
    np.testing.assert_allclose(plain.diffuse, frame.diffuse, rtol=1e-5)


def test_white_returns_all():
    material = with_single_scattering()
    strength = material.white().single_scattering.strength
    found = material.white().total_reflectance(), strength * material.total_reflectance()
    assert_close(found, (np.ones(3), np.ones(3)), rtol=1e-5)


@pytest.mark.parametrize("eta", [1.0, 1.3])
def test_no_more_leaves_than_came_however_the_light_grazes(eta):
    """What scatters once and what diffuses add up to one at most, and to one where nothing is
    absorbed or reflected.
    """
    mu = jnp.asarray([1.0, 0.5, 0.2, 0.05, 0.0])
    for absorbing in (0.0, 0.002, 0.1):
        single = sj.SingleScattering(sj.Medium([absorbing], [1 - absorbing], eta))
        rest = (0.95 if absorbing else 1.0) * (1 - single.total_reflectance())
        lit = sj.Material(sj.SumOfGaussians([1.0], rest[None]), single_scattering=single)
        for each in (lit, lit.white()):
            diffused = each.gaussians.total_reflectance()[None] * each.diffuse_fraction(mu)
            leaving = each.single_scattering.directional_albedo(mu) + diffused
            assert np.all(leaving <= 1 + 2e-3)
            if absorbing == 0:
                np.testing.assert_allclose(leaving, 1, atol=2e-3)
        np.testing.assert_allclose(lit.diffuse_fraction(mu[:1]), 1, atol=2e-3)


@pytest.mark.once
def test_a_scaled_body_in_scaled_light_gives_the_same_picture():
    """No length is absolute, from 0.7 mm to 66 m: a bumpy body in its own shadow, under a lamp far
    away and one near, and a softbox.
    """
    body = with_albedo(bumpy(900), np.full((900, 3), 0.7))

    def picture(scale: float) -> sj.Frame:
        lamp = sj.PointLight(scale * np.asarray([-12.0, 12.0, 20.0]), 400 * scale**2)
        softbox = sj.scene.RectangleLight.facing(
            scale * np.asarray([20.0, 5, 14]), (0, 0, 0), 8 * scale, 8 * scale, 5, count=4
        )
        lights = sj.DirectionalLight((0.9, -0.3, -0.4), 2), lamp, softbox
        gaussians = sj.SumOfGaussians(scale**2 * jnp.asarray([1.0, 8.0]), [[0.5] * 3, [0.4] * 3])
        camera = sj.Camera.look_at(
            scale * np.asarray([3.0, 2, 40]), (0, 0, 0), fov=35, width=32, height=32
        )
        scene = sj.Scene(body.scaled(scale), lights, sj.Material(gaussians, specular=0.5))
        return sj.render(scene, camera, PLAIN)

    usual = picture(1.0)
    shadow = np.asarray(usual.shadow)
    assert np.mean(shadow < 0.5) > 0.01
    for scale in (0.03, 3000.0):
        scaled = picture(scale)
        np.testing.assert_allclose(scaled.beauty, usual.beauty, atol=2e-3)
        np.testing.assert_allclose(scaled.shadow, shadow, atol=1e-2)
