"""The five passes with the splats cut over the devices of a mesh: each works on its splats, then on its strip of the picture."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.devices import Devices, laid_out
from splatjax.scene import Camera, Frame, Scene

from ._lighting import let_light_in
from ._passes import SeenSurfaces, cast_shadows, compose, see_surfaces, shade, sources_of
from ._records import Plan
from ._settings import RenderSettings
from ._sharded_plan import filled_up, plan_specs


def render_over(mesh: Mesh, scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan) -> Frame:
    """Render with a plan that is made for a mesh. The picture is on every device; gradients go back to where the splats are."""
    devices = Devices.of(mesh)
    scene = Scene(filled_up(scene.splats, devices), scene.lights, scene.material)
    specs = jax.tree.map(lambda _: PartitionSpec(), (scene, camera, plan))
    specs = eqx.tree_at(lambda each: each[0].splats, specs, jax.tree.map(lambda _: devices.shares, scene.splats))
    specs = eqx.tree_at(lambda each: each[2], specs, plan_specs(plan, devices))
    # Without a check of what varies over devices: rules of our own derivatives, and loops, are not written for it.
    share = partial(_share, devices, settings)
    share = jax.shard_map(share, mesh=mesh, in_specs=specs, out_specs=PartitionSpec(), check_vma=False)
    return share(*laid_out(mesh, (scene, camera, plan), specs))


def _share(devices: Devices, settings: RenderSettings, scene: Scene, camera: Camera, plan: Plan) -> Frame:
    """Do what one device does."""
    view = _splatting.PerspectiveView.of(camera)
    light = cast_shadows(scene, settings, plan, lambda splats: _splatting.bounds_over(splats, devices))
    entering = let_light_in(scene, light)
    attributes = settings.lighting.attributes(scene, light, entering)
    seen = see_surfaces(scene.splats, attributes, view, settings, plan).lit(scene, light, settings)
    layers, needed = _diffusion.diffusion_layers(
        sources_of(scene.splats, entering.source),
        scene.material,
        seen.receivers(),
        plan.interval,
        seen.atlas,
        plan.diffuser,
        settings.diffusion.normalization,
    )
    shaded = shade(scene, view, light.groups, seen, layers)
    needed = devices.largest(jnp.max(jnp.stack([needed, seen.needed, light.needed])))
    shaded, resolved = devices.everything((shaded, layers.resolved))
    return compose(shaded, _of_all(seen, devices), resolved, scene.material.gaussians.weights, needed)


def _of_all(seen: SeenSurfaces, devices: Devices) -> SeenSurfaces:
    """Give what a picture is laid together by."""
    parts = seen.atlas.of_all(devices), devices.everything(seen.share)
    return eqx.tree_at(lambda each: (each.atlas, each.share), seen, parts)
