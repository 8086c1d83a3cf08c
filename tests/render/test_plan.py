"""One plan for an animation: it holds for every camera and every light. Scenes that nobody means
are warned of, or refused before they are rendered.
"""

import dataclasses
import warnings
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from bodies import PLAIN, TILED, assert_close, assert_refused, joined, sheet, sphere, two_gaussians

import splatjax as sj
from splatjax.render import _checks
from splatjax.render._checks import check_scene

SETTINGS = sj.RenderSettings(diffuser=sj.diffusion.DenseDiffuser())  # which needs no plan
SMALL_MAPS = sj.RenderSettings(shadows=sj.splatting.ShadowSettings(resolution=64))


def scene_under(*lights: sj.scene.AbstractLight, splats: sj.Splats | None = None) -> sj.Scene:
    return sj.Scene(
        sheet(5.0, 1.0) if splats is None else splats, lights, sj.Material(two_gaussians())
    )


def lamp(*direction: float, cast_shadows: bool = True) -> sj.DirectionalLight:
    return sj.DirectionalLight(direction, [1, 1, 1], cast_shadows)


def point(height: float) -> sj.PointLight:
    return sj.PointLight([0.0, 0.0, height], [100, 100, 100], cast_shadows=False)


def of_four_gaussians() -> sj.Material:
    """The skin of six without the two narrowest: it is filled up by two."""
    skin = sj.load_material("skin")
    wide = sj.SumOfGaussians(skin.gaussians.variances[2:], skin.gaussians.weights[2:])
    return eqx.tree_at(lambda material: material.gaussians, skin, wide)


CAMERA = sj.Camera.look_at([0, 0, 20], [0, 0, 0], width=8, height=8)
SHADOWED = joined(sheet(5.0, 1.0), sheet(1.0, 0.5, center=(0.0, 0.0, 2.0)))
DIRECTIONS = [(0.0, 0.0, -1.0), (0.6, 0.0, -0.8), (-0.6, 0.1, -0.8)]


def test_a_plan_of_several_scenes_has_room_for_the_shadows_of_each():
    front, back = scene_under(lamp(0.0, 0.0, -1.0)), scene_under(lamp(0.0, 0.0, 1.0))

    def pairs(*scenes: sj.Scene) -> int:
        return sj.make_plan(scenes, CAMERA, SETTINGS).shadows[0].raster.pairs

    # No splat faces the lamp at the back.
    assert pairs(back) < pairs(front) == pairs(back, front) == pairs(front, back)


def under_lamp_at(z: float) -> sj.Scene:
    return scene_under(sj.PointLight(jnp.asarray([0.0, 0.0, z]), jnp.ones(3)))


def test_light_for_which_a_plan_does_not_suffice_is_nan():
    far, near = map(under_lamp_at, (30.0, 1.0))
    plan = sj.make_plan(far, CAMERA, SETTINGS)
    for scene, is_lost in ((far, False), (near, True)):
        light = sj.compute_irradiance(scene, plan, SETTINGS)
        assert np.all(np.isnan(light.source) == is_lost)


def test_a_lamp_among_the_splats_in_one_scene_has_six_faces_in_all():
    far, near = map(under_lamp_at, (30.0, 1.0))
    assert sj.make_plan([far, near], CAMERA, SETTINGS).shadows[0].cube
    assert not sj.make_plan([far, far], CAMERA, SETTINGS).shadows[0].cube


def diffused(irradiance) -> jax.Array:
    return sj.diffuse_irradiance(SCENE, irradiance, CAMERA, SETTINGS, planned())


SCENE, OTHER = (scene_under(lamp(0, 0, -1), splats=sheet(half, 1.0)) for half in (5.0, 4.0))


@cache
def planned() -> sj.Plan:
    return sj.make_plan(SCENE, CAMERA, SETTINGS)


NEED_THE_PLAN = [
    lambda scene: sj.render(scene, CAMERA, SETTINGS, planned()),
    lambda scene: sj.diffusion_basis(scene, CAMERA, SETTINGS, planned()),
    lambda scene: sj.picture_jacobian(scene, CAMERA, SETTINGS, planned()),
    lambda scene: sj.compute_irradiance(scene, planned(), SETTINGS),
]
NOT_PLANNED = [
    (OTHER, f"for {SCENE.splats.count} splats, and the scene has {OTHER.splats.count}"),
    (
        sj.Scene(SCENE.splats, SCENE.lights, sj.load_material("skin")),
        "2 Gaussians, and the scene has 6",
    ),
    (
        scene_under(sj.PointLight([0, 0, 30], 1.0), splats=SCENE.splats),
        r"kinds \['DirectionalLight'\], and the scene has \['PointLight'\]",
    ),
]
REFUSED = [
    (lambda: sj.make_plan([SCENE, OTHER], CAMERA, SETTINGS), r"scenes\[1\] has other splats"),
    (
        lambda: sj.make_plan([SCENE, SCENE, scene_under()], CAMERA, SETTINGS),
        r"lights of the same kinds.*scenes\[2\]",
    ),
    (
        lambda: sj.make_plan(
            [SCENE, SCENE, scene_under(lamp(0, 0, -1, cast_shadows=False))], CAMERA, SETTINGS
        ),
        r"lights of the same kinds.*scenes\[2\]",
    ),
    (
        lambda: sj.splatting.DenseRasterizer().make_plan(
            [SCENE.splats] * 2, [], SETTINGS.splatting
        ),
        "a DenseRasterizer works on one device",
    ),
    (
        lambda: sj.render(SCENE, CAMERA, SETTINGS, planned(), mesh=jax.make_mesh((1,), ("views",))),
        "the plan is for one device",
    ),
    *((partial(call, scene), message) for call in NEED_THE_PLAN for scene, message in NOT_PLANNED),
    (
        lambda: jax.grad(lambda camera: jnp.mean(sj.render(SCENE, camera).beauty))(CAMERA),
        "a plan is needed",
    ),
    (
        lambda: sj.map_over(
            jax.make_mesh((1,), ("views",)),
            lambda one, each: each["a"],
            jnp.zeros(()),
            {"a": jnp.zeros(4), "b": jnp.zeros(())},
        ),
        r"\['b'\]",
    ),
    (
        lambda: sj.make_plan(scene_under(Sky(jnp.ones(3), cast_shadows=True)), CAMERA, PLAIN),
        "Sky has no shadow map; give a light with cast_shadows=False",
    ),
    (
        lambda: sj.diffusion_basis(
            sj.Scene(
                SCENE.splats,
                SCENE.lights,
                sj.Material(
                    two_gaussians(),
                    single_scattering=sj.SingleScattering(sj.Medium([0.1] * 3, 1, 1.3)),
                ),
            ),
            CAMERA,
            PLAIN,
        ),
        r"scene\.material has single scattering",
    ),
    (
        lambda: sj.relighting_basis(SCENE, CAMERA, PLAIN),
        "scene.lights are DirectionalLight; give one HarmonicLight",
    ),
    (
        lambda: sj.render(
            SCENE, sj.Camera.look_at([0, 0, 50], [0, 0, 0], width=10**6, height=10**6)
        ),
        r"1000000 x 1000000 pixels .* 5e\+05 GB",
    ),
    *(
        (partial(diffused, rows), r"irradiance has shape .* \[\d+, 3\]; give a row for each splat")
        for rows in (np.ones((1, 3)), np.ones((len(SCENE.splats.radii), 2)), [1.0, 1.0, 1.0])
    ),
    (
        partial(diffused, np.full((len(SCENE.splats.radii), 3), -0.5)),
        "irradiance must be at least 0: add a constant.* -0.5",
    ),
    (
        lambda: sj.diffusion_basis(SCENE, CAMERA, SETTINGS, planned()).beauty(
            sj.SumOfGaussians([1.0], np.ones((1, 3)))
        ),
        r"gaussians.weights has shape \[1, 3\], not \[2, 3\]",
    ),
    (
        lambda: sj.diffusion_basis(
            SCENE,
            CAMERA,
            SETTINGS,
            planned(),
            derivative=True,
            light=sj.illuminate(SCENE, planned(), SETTINGS),
        ),
        r"light has no derivative; compute it by illuminate\(..., derivative=True\)",
    ),
    (
        lambda: sj.render(
            scene_under(lamp(0, 0.1, -1), splats=SCENE.splats),
            CAMERA,
            SETTINGS,
            planned(),
            light=sj.transfer(SCENE, planned(), SETTINGS),
        ),
        "lights in other directions",
    ),
    (
        lambda: jax.jit(lambda scene: sj.make_plan(scene, CAMERA, SETTINGS))(SCENE),
        "make_plan needs concrete arrays",
    ),
]
MISPLACED = [
    (lambda: sj.render(SCENE, CAMERA, planned()), "settings must be RenderSettings"),
    (lambda: sj.illuminate(SCENE, SETTINGS), "plan must be Plan"),
    (lambda: sj.render(SCENE, CAMERA, light=lamp(0, 0, -1)), "light must be SplatLight.*Transfer"),
]


@pytest.mark.once
def test_a_light_without_shadows_may_move_beside_kept_visibility():
    def under(*fill):
        lights = [lamp(0, 0, -1), lamp(*fill, cast_shadows=False)]
        return sj.Scene(SCENE.splats, lights, SCENE.material)

    before, moved = under(0.5, 0, -1), under(-0.5, 0.2, -1)
    plan = sj.make_plan(before, CAMERA, SETTINGS)
    kept = sj.transfer(before, plan, SETTINGS)
    again, anew = (
        sj.render(moved, CAMERA, SETTINGS, plan, light=light).beauty for light in (kept, None)
    )
    np.testing.assert_allclose(again, anew, atol=1e-6)


@pytest.mark.parametrize(("call", "message"), MISPLACED)
def test_misplaced_arguments_are_refused_by_name(call, message, float64):
    assert_refused(call, message)


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_what_cannot_be_planned_or_rendered_is_refused_by_name(call, message):
    assert_refused(call, message)


class Sky(sj.scene.AbstractLightSample):
    """A light of someone's own: the same from every side."""

    radiance: jax.Array
    cast_shadows: bool = eqx.field(static=True, default=False)

    def incidence(self, points):
        up = jnp.zeros_like(points).at[..., 2].set(1.0)
        return up, jnp.broadcast_to(self.radiance, points.shape)


def test_a_light_of_ones_own_shines_without_shadows():
    shown = sj.render(scene_under(Sky(jnp.full(3, 2.0))), CAMERA, settings=PLAIN)
    lit = sj.render(scene_under(lamp(0, 0, -2, cast_shadows=False)), CAMERA, settings=PLAIN)
    assert jnp.allclose(shown.beauty, 2 * lit.beauty, rtol=1e-5)


def scene(splats: sj.Splats | None = None, lights=(lamp(0, 0, -1),)) -> sj.Scene:
    return scene_under(*lights, splats=sphere(2000) if splats is None else splats)


def camera(distance: float = 50.0) -> sj.Camera:
    return sj.Camera.look_at([0, 0, distance], [0, 0, distance - 1], width=8, height=8)


DISK = sj.scene.DiskLight([0, 0, 60], 3.0, [0, 0.1, 1], 5.0)
FLIPPED = eqx.tree_at(lambda splats: splats.normals, sphere(2000), replace_fn=lambda n: -n)


@pytest.mark.parametrize(
    ("wrong", "distance", "message"),
    [
        (scene(lights=[]), 50, "no light"),
        (scene(lights=[sj.PointLight([0, 0, 50], 0)]), 50, "no light"),
        (scene(FLIPPED), 50, "normals of the splats point into the body"),
        (scene(), 3, "camera is inside the body"),
        (scene(lights=[DISK]), 50, "light 1, a DiskLight, shines away"),
        (scene(sphere(2000, 0.2)), 50, "check the units"),
        (scene(sphere(2000, 20_000.0)), 50_000, "check the units"),
    ],
)
def test_a_scene_that_nobody_means_is_warned_of_once(wrong, distance, message):
    _checks._warn_once.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3):
            check_scene(wrong, camera(distance))
    assert [message in str(warning.message) for warning in caught] == [True]


@pytest.mark.parametrize(
    "right",
    [
        scene(),
        scene(sheet(10.0, 0.5)),
        scene(lights=[sj.scene.RectangleLight.facing([0, 0, 60], [0, 9, 0], 5, 5, 3.0)]),
        scene(sj.Splats(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))),
        eqx.tree_at(lambda s: s.material, scene(sphere(2000, 2000.0)), scene().material.opaque()),
    ],
)
def test_other_scenes_pass(right):
    check_scene(right, camera(50_000.0))
    jax.jit(lambda light: check_scene(scene(lights=[light]), camera()))(
        sj.DirectionalLight([0, 0, -1], 0)
    )


def test_splats_that_do_not_fit_are_refused_before_they_are_rendered(monkeypatch):
    monkeypatch.setattr(_checks, "_device_memory", lambda splats: 1e6)
    assert_refused(
        lambda: check_scene(scene(), camera()), r"2000 splats would take .* 0.001 GB are free"
    )


def torus_knot() -> trimesh.Trimesh:
    """A trefoil, 60 mm across: a torus bent along it."""
    torus = trimesh.creation.torus(10.0, 4.0, major_sections=128)
    x, y, z = torus.vertices.T
    t = np.arctan2(y, x)
    curve = [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)]
    along = [np.cos(t) + 4 * np.cos(2 * t), -np.sin(t) + 4 * np.sin(2 * t), -3 * np.cos(3 * t)]
    along = np.stack(along, -1) / np.linalg.norm(along, axis=0)[:, None]
    aside = trimesh.unitize(np.cross(along, [0, 0, 1]))
    across = np.hypot(x, y) - 10.0
    knot = 10 * np.stack(curve, -1) + across[:, None] * aside
    knot += z[:, None] * np.cross(aside, along)
    return trimesh.Trimesh(knot, torus.faces)


def test_other_bodies_lights_and_cameras_of_about_one_size_compile_nothing(compiled):
    skin, four = sj.load_material("skin"), of_four_gaussians()

    def render(
        body: sj.Splats,
        eye=(66, 4, 140),
        lights=(lamp(0.5, -0.5, -1.0),),
        material=skin,
        size=(64, 64),
    ):
        camera = sj.Camera.look_at(eye, (0, -9, 0), fov=30, width=size[0], height=size[1])
        scene = sj.Scene(body, (*lights, point(140.0)), material)
        return sj.render(scene, camera, SMALL_MAPS).beauty

    bust = sj.bust(2_000).scaled(0.2)
    larger, fewer = bust.scaled(1.05), jax.tree.map(lambda leaf: leaf[:1_930], bust)

    def with_maps_of_bust(mesh: trimesh.Trimesh) -> sj.Splats:
        mesh = sj.geometry.Mesh(mesh.vertices, mesh.faces, mesh.vertex_normals)
        body = sj.geometry.sample_mesh(mesh, 2_000)
        names = "centers", "normals", "radii", "areas"
        return dataclasses.replace(bust, **{name: getattr(body, name) for name in names})

    knot, torus, ball = map(
        with_maps_of_bust,
        (torus_knot(), trimesh.creation.torus(25.0, 9.0), trimesh.creation.icosphere(4, 18.0)),
    )
    first = render(bust)
    low, left, right = lamp(0.3, -0.2, -1.0), lamp(-0.5, -0.3, -1.0), lamp(0.5, -0.4, -0.9)
    compiled.clear()
    others = [
        render(knot),
        render(torus),
        render(ball),
        render(larger),
        render(fewer),
        render(bust, eye=(-60, 24, 140)),
        render(bust, lights=[lamp(-0.5, -0.3, -1.0)]),
        render(bust, material=four),
        render(bust, lights=[low, right]),
        render(bust, lights=[low, left, right]),
        render(bust, lights=[lamp(-1.0, 0.2, -0.4)]),
        # Lights are sorted by kind.
        render(bust, lights=[low, point(130.0), left]),
        render(bust, lights=[point(130.0), left, low, low]),
        render(bust, size=(59, 62)),
        render(bust, size=(57, 57)),
    ]
    assert compiled == []
    for i, other in enumerate(others):
        assert np.all(np.isfinite(other))
        assert not any(np.array_equal(other, before) for before in [first, *others[:i]])


@pytest.mark.once
def test_a_picture_of_any_size_is_part_of_a_larger_one():
    """Pictures are rendered with further pixels, which are in no result."""
    scene = scene_under(lamp(0.5, -0.5, -1.0), point(140.0), splats=sj.bust(1_000).scaled(0.2))
    whole = sj.Camera.look_at((66, 4, 140), (0, -9, 0), fov=15, width=80, height=80)
    part = dataclasses.replace(
        whole,
        width=67,
        height=75,
        focal_length=whole.focal_length * 80 / 75,
        principal_point=(40 / 67, 40 / 75),
    )
    tiles = dataclasses.replace(TILED, diffuser=sj.diffusion.DenseDiffuser())
    frame, expected = (sj.render(scene, each, tiles) for each in (part, whole))
    assert frame.layers.shape[1:3] == frame.shadow.shape[1:] == frame.depth.shape == (75, 67)
    for name in ("beauty", "coverage", "normal"):
        cut = getattr(expected, name)[:75, :67]
        assert jnp.allclose(getattr(frame, name), cut, rtol=1e-4, atol=1e-4)


def test_lights_gaussians_and_pixels_that_fill_up_are_in_no_result():
    camera = dataclasses.replace(CAMERA, width=7)
    first, *others = (lamp(*direction) for direction in DIRECTIONS)
    scene = sj.Scene(SHADOWED, (first, point(20.0), *others), of_four_gaussians())
    plan = sj.make_plan(scene, camera, PLAIN)

    def render(scene, light=None):
        return sj.render(scene, camera, PLAIN, plan, light=light)

    exact = jax.jit(render)(scene)  # traced scenes have the lights that they are given
    light = sj.illuminate(scene, plan, PLAIN)
    closed_over = jax.jit(lambda factor: factor * render(scene).shadow)(jnp.ones(()))
    assert [len(rows) for rows in light.visibility if rows is not None] == [3]
    assert exact.shadow.shape == closed_over.shape == (4, 8, 7)
    assert float(jnp.min(jnp.max(jnp.abs(jnp.diff(exact.shadow, axis=0)), axis=(1, 2)))) > 0.1
    for frame in (render(scene), render(scene, light)):
        assert_close(frame, exact, rtol=1e-5, atol=1e-6)
    assert jnp.allclose(closed_over, exact.shadow, rtol=1e-5, atol=1e-6)
    jacobian = sj.picture_jacobian(scene, camera, PLAIN, plan)
    assert jnp.allclose(jacobian.frame.shadow, exact.shadow, rtol=1e-5, atol=1e-6)
    assert jacobian.weights.shape == jacobian.variances.shape == exact.layers.shape
    beauty = sj.diffusion_basis(scene, camera, PLAIN, plan).beauty(scene.material.gaussians)
    assert jnp.allclose(beauty, exact.beauty, rtol=1e-5, atol=1e-6)


def test_a_light_without_strength_has_its_shadow_and_its_derivative():
    *others, last = (lamp(*direction) for direction in DIRECTIONS)
    plan = sj.make_plan(scene_under(*others, last, splats=SHADOWED), CAMERA, PLAIN)

    def render(strength):
        scaled = sj.DirectionalLight(last.direction, strength * last.irradiance)
        return sj.render(scene_under(*others, scaled, splats=SHADOWED), CAMERA, PLAIN, plan)

    zero, one = jnp.zeros(()), jnp.ones(())
    dark, lit = render(zero), render(one)
    assert np.array_equal(dark.shadow, lit.shadow)
    change = jax.grad(lambda strength: jnp.sum(render(strength).beauty))(zero)
    assert float(change) == pytest.approx(float(jnp.sum(lit.beauty - dark.beauty)), rel=1e-4)
    assert float(change) > 1
