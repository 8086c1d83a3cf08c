"""Energy, white, interfaces, limits, and what silhouettes cover."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import camera_over, sheet, skin, sphere, two_gaussians

import splatjax as sj
from splatjax.diffusion import ClusterDiffuser, DenseDiffuser
from splatjax.io import load_material
from splatjax.splatting import DenseRasterizer, ShadowSettings

EXITANCE_TOLERANCE = 1e-3
PLAIN = sj.RenderSettings(
    shadows=ShadowSettings(resolution=32), rasterizer=DenseRasterizer(), diffuser=DenseDiffuser()
)
TILES = sj.RenderSettings(diffuser=DenseDiffuser())
EXACT = sj.RenderSettings(diffuser=ClusterDiffuser(error=0.0))


def lamp(
    irradiance=(1.0, 1.0, 1.0), direction=(0.0, 0.0, -1.0), cast_shadows=False
) -> sj.DirectionalLight:
    return sj.DirectionalLight(
        jnp.asarray(direction, float), jnp.asarray(irradiance, float), cast_shadows
    )


def matte(material: sj.Material) -> sj.Material:
    return eqx.tree_at(lambda m: m.specular, material, jnp.zeros_like(material.specular))


def middle(picture: jnp.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    return np.asarray(picture[height // 4 : -height // 4, width // 4 : -width // 4])


@pytest.mark.once
def test_exitance_over_irradiance_is_the_total_reflectance_of_marble():
    material = matte(load_material("marble"))
    scene = sj.Scene(sheet(1.0, 30.0), (lamp(),), material)
    frame = sj.render(scene, camera_over(8.0, 32))
    exitance = np.pi * middle(frame.diffuse)
    reflectance = np.asarray(material.gaussians.total_reflectance())
    np.testing.assert_allclose(
        exitance, np.broadcast_to(reflectance, exitance.shape), rtol=EXITANCE_TOLERANCE
    )
    held = np.asarray(sj.Dipole(sj.load_medium("marble")).total_reflectance())
    np.testing.assert_allclose(reflectance, held, rtol=EXITANCE_TOLERANCE)


@pytest.mark.once
def test_white_material_with_an_albedo_map_gives_the_albedo():
    for albedo in (
        [0.8, 0.4, 0.1],
        [1.0, 1.0, 1.0],
    ):  # and so a white diffuser that faces pi has radiance one
        splats = sheet(1.0, 20.0)
        colors = jnp.tile(jnp.asarray(albedo, float), (splats.count, 1))
        splats = eqx.tree_at(lambda s: s.albedo, splats, colors, is_leaf=lambda leaf: leaf is None)
        scene = sj.Scene(splats, (lamp((np.pi,) * 3),), matte(sj.Material(two_gaussians())).white())
        radiance = middle(sj.render(scene, camera_over(5.0, 32)).beauty)
        np.testing.assert_allclose(
            radiance, np.broadcast_to(albedo, radiance.shape), rtol=EXITANCE_TOLERANCE
        )


@pytest.mark.slow
@pytest.mark.once
def test_white_furnace():
    # A sum over lights is coarse where the lobe is narrow, at the rim: more pixels see steeper ones
    # there (1.009 at 64^2 with 512 lights; 1.0006 at 48^2 with 2048).
    count = 512
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    turn, across = np.pi * (1 + 5**0.5) * i, np.sqrt(1 - z * z)
    directions = np.stack([np.cos(turn) * across, np.sin(turn) * across, z], 1)
    # radiance 1 from everywhere: each light stands for its share of the sphere
    lights = tuple(lamp((4 * np.pi / count,) * 3, tuple(direction)) for direction in directions)
    scene = sj.Scene(sphere(4000), lights, sj.Material(skin().white()))
    camera = sj.Camera.look_at(
        jnp.asarray([0.0, 0.0, 400.0], float), jnp.zeros(3), fov=16.0, width=32, height=32
    )
    frame = sj.render(scene, camera)
    covered = np.asarray(frame.coverage) > 0.999
    radiance = np.asarray(frame.beauty)[covered]
    assert covered.sum() > 600
    assert radiance.max() <= 1.005
    assert radiance.min() >= 0.98


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.long
def test_energy_does_not_depend_on_how_finely_half_the_sheet_is_splatted():
    coarse, fine = sheet(0.4, 16.0), sheet(0.2, 16.0)
    # cells of the coarse sheet end at x = 0.2, and there those of the shifted fine one begin
    fine = eqx.tree_at(
        lambda s: s.centers, fine, fine.centers + jnp.asarray([[0.1, 0.1, 0.0]], float)
    )
    left, right = np.asarray(coarse.centers)[:, 0] < 0.1, np.asarray(fine.centers)[:, 0] > 0.25
    mixed = sj.Splats(
        *(
            jnp.concatenate([getattr(coarse, name)[left], getattr(fine, name)[right]])
            for name in ("centers", "normals", "radii", "areas")
        )
    )
    gaussians = sj.SumOfGaussians(jnp.asarray([2.0, 5.0], float), jnp.full((2, 1), 0.5, float))
    beam = sj.GaussianBeam(
        jnp.asarray([0.0, 0.0, 10.0], float),
        jnp.asarray([0.0, 0.0, -1.0], float),
        jnp.ones(1),
        jnp.ones(()),
    )
    camera = camera_over(5.0, 32)
    pictures = []
    for splats in (coarse, mixed):
        scene = sj.Scene(splats, (beam,), sj.Material(gaussians, specular=0.0))
        pictures.append(np.asarray(sj.render(scene, camera, EXACT).diffuse)[..., 0])
    seen = pictures[0] > 1e-2 * pictures[0].max()
    assert np.max(np.abs(pictures[1] / pictures[0] - 1)[seen]) < 0.01


@pytest.mark.once
def test_layers_add_up_to_the_diffuse_picture_and_that_to_beauty(bumpy_frame):
    frame = bumpy_frame
    total = np.einsum(
        "kc,khwc->hwc", np.asarray(frame.weights, np.float64), np.asarray(frame.layers, np.float64)
    )
    np.testing.assert_allclose(np.asarray(frame.diffuse), total, atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(frame.beauty), np.asarray(frame.diffuse + frame.specular), atol=1e-6
    )


@pytest.mark.once
def test_a_closed_surface_has_no_hole(bumpy_frame):
    coverage = np.asarray(bumpy_frame.coverage)
    y, x = np.mgrid[0 : coverage.shape[0], 0 : coverage.shape[1]] + 0.5
    radius = np.hypot(x - coverage.shape[1] / 2, y - coverage.shape[0] / 2)
    outline = radius[coverage > 0.5].max()
    assert np.all(coverage[radius < outline - 2] == 1)
    assert np.all(coverage[radius > outline + 2] == 0)


@pytest.fixture(scope="module")
def bumpy_frame() -> sj.Frame:
    """A sphere of skin lit from the side."""
    scene = sj.Scene(
        sphere(3000),
        (lamp((3.0, 3.0, 3.0), (-1.0, -0.3, -0.5), cast_shadows=True),),
        sj.Material(skin()),
    )
    camera = sj.Camera.look_at(
        jnp.asarray([0.0, 0.0, 400.0], float), jnp.zeros(3), fov=18.0, width=64, height=64
    )
    settings = sj.RenderSettings(shadows=ShadowSettings(resolution=256))
    return sj.render(scene, camera, settings)


@pytest.mark.once
def test_light_is_added_linearly():
    splats, material = sphere(1500), sj.Material(two_gaussians())
    camera = sj.Camera.look_at(
        jnp.asarray([0.0, 0.0, 400.0], float), jnp.zeros(3), fov=18.0, width=32, height=32
    )
    lit = (
        ((1.0, 2.0, 3.0), (3.0, 1.0, 0.5)),
        ((1.0, 2.0, 3.0), (0.0,) * 3),
        ((0.0,) * 3, (3.0, 1.0, 0.5)),
    )
    lights = [(lamp(one, (-1.0, 0.0, -0.2)), lamp(other, (0.5, -1.0, -0.7))) for one, other in lit]
    both, *single = (sj.render(sj.Scene(splats, each, material), camera).beauty for each in lights)
    np.testing.assert_allclose(np.asarray(both), np.asarray(single[0] + single[1]), atol=2e-6)


@pytest.mark.once
@pytest.mark.filterwarnings("ignore:the scene has no light")
def test_no_splats_and_no_lights_give_an_empty_and_a_black_picture():
    material = sj.Material(two_gaussians())
    camera = camera_over(5.0, 16)
    nothing = sj.Splats(jnp.zeros((0, 3)), jnp.zeros((0, 3)), jnp.zeros(0), jnp.zeros(0))
    empty = sj.render(sj.Scene(nothing, (lamp(),), material), camera)
    assert np.all(np.asarray(empty.coverage) == 0)
    assert np.all(np.asarray(empty.beauty) == 0)
    assert np.all(np.isinf(np.asarray(empty.depth)))
    dark = sj.render(sj.Scene(sheet(1.0, 5.0), (), material), camera)
    assert np.all(np.asarray(dark.beauty) == 0)
    assert dark.shadow.shape == (0, 16, 16)


@pytest.mark.once
def test_a_plan_that_does_not_suffice_poisons_the_picture_and_says_so():
    material = sj.Material(two_gaussians())
    camera = camera_over(5.0, 32)
    scene = sj.Scene(
        sheet(0.25, 1.0), (lamp(),), material
    )  # that of the test of splats that move: one program
    plan = sj.make_plan(scene, camera)
    wider = eqx.tree_at(
        lambda s: s.material.gaussians.variances, scene, scene.material.gaussians.variances * 2
    )
    frame = sj.render(wider, camera, plan=plan)
    assert float(frame.overflow) > 1
    assert np.all(np.isnan(np.asarray(frame.beauty)))
    assert np.all(np.isnan(np.asarray(frame.coverage)))


@pytest.mark.once
def test_a_plan_for_too_few_splats_poisons_all_that_is_made_of_them_and_its_derivative():
    scene, camera = (
        sj.Scene(sheet(1.0, 6.0), (lamp(),), sj.Material(two_gaussians())),
        camera_over(5.0, 16),
    )
    plan = sj.make_plan(scene, camera, TILES)
    short = dataclasses.replace(plan, raster=dataclasses.replace(plan.raster, splats=1))
    frame, slope = jax.value_and_grad(
        lambda radii: jnp.sum(
            sj.render(
                eqx.tree_at(lambda s: s.splats.radii, scene, radii), camera, TILES, short
            ).beauty
        )
    )(scene.splats.radii)
    assert np.isnan(float(frame))
    assert np.any(np.isnan(np.asarray(slope)))  # where a pixel sees the splat: no step can be taken
    jacobian = sj.picture_jacobian(scene, camera, TILES, short)
    assert float(jacobian.frame.overflow) > 1
    assert np.all(np.isnan(np.asarray(jacobian.weights)))
    ones = jnp.ones((scene.splats.count, 3))
    assert np.all(np.isnan(sj.diffuse_irradiance(scene, ones, camera, TILES, short)))
    assert float(sj.render(scene, camera, TILES, plan).overflow) == 0


@pytest.mark.once
def test_a_plan_holds_for_splats_that_move_a_little():
    """Over a tile's edge, and away from the eye: what is seen then was not seen when it was
    planned.
    """
    camera = camera_over(5.0, 32)
    small = sheet(0.25, 1.0)
    material = sj.Material(two_gaussians())
    plan = sj.make_plan(sj.Scene(small, (lamp(),), material), camera)
    for offset in ([0.1, 0.1, 0.0], [-0.1, 0.1, 0.1], [0.0, -0.1, -0.1]):
        moved = eqx.tree_at(lambda s: s.centers, small, small.centers + jnp.asarray([offset]))
        assert (
            float(sj.render(sj.Scene(moved, (lamp(),), material), camera, plan=plan).overflow) == 0
        )


@pytest.mark.once
def test_a_light_that_has_come_among_the_splats_needs_another_plan():
    """Its map was planned as one frustum around them all."""
    splats, camera = sheet(1.0, 3.0), camera_over(2.0, 8)

    def scene(height: float):
        light = sj.PointLight(jnp.asarray([0.0, 0.0, height]), jnp.ones(3))
        return sj.Scene(splats, (light,), sj.Material(two_gaussians()))

    plan = sj.make_plan(scene(20.0), camera, PLAIN)
    assert float(sj.render(scene(12.0), camera, PLAIN, plan).overflow) == 0
    for height in (1.0, 0.0):
        frame = sj.render(scene(height), camera, PLAIN, plan)
        assert float(frame.overflow) > 1
        assert np.all(np.isnan(np.asarray(frame.beauty)))


def test_channels_that_disagree_are_refused():
    scene = sj.Scene(sheet(1.0, 3.0), (lamp((1.0, 1.0)),), sj.Material(skin()))
    with pytest.raises(ValueError, match=r"lights\[0\] has 2 channels"):
        sj.render(scene, camera_over(2.0, 8))
