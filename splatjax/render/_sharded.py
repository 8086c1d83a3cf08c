"""The five passes with the splats cut over the devices of a mesh: each works on its splats, then on its strip of the picture."""

from functools import partial

import equinox as eqx
import jax
from jax.sharding import Mesh, PartitionSpec

from splatjax import splatting as _splatting
from splatjax.devices import Devices, laid_out
from splatjax.scene import Camera, Frame, Scene

from ._passes import SeenSurfaces, compose, five_passes
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
    bounds_of = partial(_splatting.bounds_over, devices=devices)
    shaded, seen, resolved, needed = five_passes(scene, camera, settings, plan, bounds_of)
    shaded, resolved = devices.everything((shaded, resolved))
    needed = devices.largest(needed)
    return compose(shaded, _of_all(seen, devices), resolved, scene.material.gaussians.weights, needed)


def _of_all(seen: SeenSurfaces, devices: Devices) -> SeenSurfaces:
    """Give what a picture is laid together by."""
    parts = seen.atlas.of_all(devices), devices.everything(seen.share)
    return eqx.tree_at(lambda each: (each.atlas, each.share), seen, parts)
