"""One plan for an animation: it holds for every camera and every light."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from scenes import sheet, two_gaussians

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.scene import AbstractLight

SETTINGS = sj.RenderSettings(diffuser=DenseDiffuser())  # which needs no plan


def scene_under(*lights: AbstractLight, splats: sj.Splats | None = None) -> sj.Scene:
    return sj.Scene(
        sheet(1.0, 5.0) if splats is None else splats, lights, sj.Material(two_gaussians())
    )


def lamp(*direction: float, cast_shadows: bool = True) -> sj.DirectionalLight:
    return sj.DirectionalLight(jnp.asarray(direction, float), jnp.ones(3), cast_shadows)


def camera_at(z: float) -> sj.Camera:
    return sj.Camera.look_at(jnp.asarray([0.0, 0.0, z]), jnp.zeros(3), width=8, height=8)


@pytest.mark.once
def test_a_plan_of_several_scenes_has_room_for_the_shadows_of_each():
    camera = camera_at(20.0)
    steep, grazing = scene_under(lamp(0.0, 0.0, -1.0)), scene_under(lamp(0.99, 0.0, -0.14))
    alone = [
        sj.make_plan(scene, camera, SETTINGS).shadows[0].raster.bins for scene in (steep, grazing)
    ]
    assert alone[0].pairs > alone[1].pairs
    for scenes in ([steep, grazing], [grazing, steep]):
        together = sj.make_plan(scenes, camera, SETTINGS).shadows[0].raster.bins
        assert together == alone[0]


@pytest.mark.once
def test_a_lamp_among_the_splats_in_one_scene_has_six_faces_in_all():
    far, near = (
        scene_under(sj.PointLight(jnp.asarray([0.0, 0.0, z]), jnp.ones(3))) for z in (30.0, 1.0)
    )
    assert sj.make_plan([far, near], camera_at(20.0), SETTINGS).shadows[0].cube
    assert not sj.make_plan([far, far], camera_at(20.0), SETTINGS).shadows[0].cube


def test_scenes_that_differ_in_more_than_their_lights_are_refused():
    camera, scene = camera_at(20.0), scene_under(lamp(0.0, 0.0, -1.0))
    with pytest.raises(ValueError, match=r"scenes\[1\] has other splats"):
        sj.make_plan(
            [scene, scene_under(lamp(0.0, 0.0, -1.0), splats=sheet(1.0, 4.0))], camera, SETTINGS
        )
    for other in (scene_under(), scene_under(lamp(0.0, 0.0, -1.0, cast_shadows=False))):
        with pytest.raises(ValueError, match=r"lights of the same kinds.*scenes\[2\]"):
            sj.make_plan([scene, scene, other], camera, SETTINGS)


def test_a_mesh_needs_renderers_that_can_be_cut_and_a_plan_of_its_own():
    mesh, camera, scene = jax.make_mesh((1,), ("splats",)), camera_at(20.0), scene_under()
    with pytest.raises(ValueError, match="DenseDiffuser"):
        sj.make_plan(scene, camera, SETTINGS, mesh=mesh)
    with pytest.raises(ValueError, match="the plan is for one device"):
        sj.render(scene, camera, SETTINGS, sj.make_plan(scene, camera, SETTINGS), mesh=mesh)


def test_a_plan_for_other_splats_is_refused():
    camera, scene = camera_at(20.0), scene_under()
    plan = sj.make_plan(scene, camera, SETTINGS)
    calls = (
        lambda scene, plan: sj.render(scene, camera, SETTINGS, plan),
        lambda scene, plan: sj.diffusion_basis(scene, camera, SETTINGS, plan),
        lambda scene, plan: sj.picture_jacobian(scene, camera, SETTINGS, plan),
        lambda scene, plan: sj.compute_irradiance(scene, plan, SETTINGS),
    )
    other = scene_under(splats=sheet(1.0, 4.0))
    for call in calls:
        with pytest.raises(
            ValueError,
            match=rf"for {scene.splats.count} splats, and the scene has {other.splats.count}",
        ):
            call(other, plan)


def test_a_batch_whose_arrays_are_not_stacked_is_refused():
    mesh = jax.make_mesh((1,), ("views",))
    with pytest.raises(ValueError, match=r"\['b'\] has none"):
        sj.map_over(
            mesh,
            lambda one, each: each["a"],
            jnp.zeros(()),
            {"a": jnp.zeros(4), "b": jnp.zeros(())},
        )


class Sky(AbstractLight):
    """A light of someone's own: the same from every side."""

    radiance: jax.Array
    cast_shadows: bool = eqx.field(static=True, default=False)

    def incidence(self, points):
        up = jnp.zeros_like(points).at[..., 2].set(1.0)
        return up, jnp.broadcast_to(self.radiance, points.shape)


def test_a_light_of_ones_own_shines_without_shadows_and_is_told_so_with_them():
    camera = camera_at(20.0)
    shown = sj.render(scene_under(Sky(jnp.full(3, 2.0))), camera, settings=SETTINGS)
    lit = sj.render(scene_under(lamp(0, 0, -2, cast_shadows=False)), camera, settings=SETTINGS)
    assert jnp.allclose(shown.beauty, 2 * lit.beauty, rtol=1e-5)
    with pytest.raises(
        ValueError, match="Sky: no shadow map is known for it; give one with cast_shadows=False"
    ):
        sj.make_plan(scene_under(Sky(jnp.ones(3), cast_shadows=True)), camera, SETTINGS)
