"""A picture with all its layers, and pass 4 alone."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from splatjax import splatting as _splatting
from splatjax.devices import Devices, laid_out
from splatjax.scene import Camera, Frame, Scene

from ._inputs import SAME, check_channels, in_one_dtype
from ._lighting import EnteringLight, let_light_in
from ._passes import (
    SeenSurfaces,
    bounds_over,
    cast_shadows,
    compose,
    five_passes,
    see_surfaces,
    spread_light,
)
from ._plan import check_count, plan_unless_traced
from ._records import Plan
from ._settings import RenderSettings
from ._sharded import of_all, over


def render(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings | None = None,
    plan: Plan | None = None,
    mesh: Mesh | None = None,
) -> Frame:
    r"""Render a picture with all its layers: shadow maps, visibility, attributes, diffusion,
    shading.

    **Arguments:**

    - `scene`: splats (mm), lights and material. Differentiable; which splats are visible is not.
    - `camera`: Differentiable.
    - `settings`: how each pass works.
    - `plan`: from `splatjax.plan`; needed under `jit`, `grad` and `vmap`, made here otherwise.
    - `mesh`: devices over which the splats are cut, whatever its axes: each holds a share, and
      their gradients (docs/devices.md). It is the plan's where that is given.

    **Returns:** a `Frame` in the dtype of `splats.centers`; the same on every device, and to
    rounding whatever the mesh.

    **Raises:** `ValueError` when a plan is needed and not given, or is for another mesh or another
    number of splats, or when the scene's channels disagree.
    """
    settings = RenderSettings() if settings is None else settings
    check_channels(scene)
    plan = plan_unless_traced(scene, camera, settings, plan, mesh)
    return _render(scene, camera, settings, plan)


@eqx.filter_jit
def _render(scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan) -> Frame:
    scene, camera = in_one_dtype(scene, camera)
    if plan.mesh is None:
        shaded, seen, resolved, needed = five_passes(scene, camera, settings, plan)
        return compose(shaded, seen, resolved, scene.material.gaussians.weights, needed)

    def share(devices: Devices, scene: Scene, plan: Plan, camera: Camera) -> Frame:
        shaded, seen, resolved, needed = five_passes(
            scene, camera, settings, plan, bounds_over(devices)
        )
        shaded, resolved = devices.everything((shaded, resolved))
        return compose(
            shaded,
            of_all(seen, devices),
            resolved,
            scene.material.gaussians.weights,
            devices.largest(needed),
        )

    return over(plan.mesh, share, scene, plan, camera)


def light_on_splats(
    scene: Scene, plan: Plan, settings: RenderSettings | None = None
) -> EnteringLight:
    r"""Give the light that enters at every splat: pass 1, and the irradiance.

    **Arguments:**

    - `scene`: Differentiable.
    - `plan`: from `splatjax.plan`.
    - `settings`: those of the plan.

    **Returns:** the irradiance, and what of it spreads: `source.T` is what `diffuse` asks for.

    **Raises:** `ValueError` when the channels disagree, or the plan is for another number of
    splats.
    """
    check_channels(scene)
    check_count(plan, scene)
    return _light_on_splats(scene, plan, RenderSettings() if settings is None else settings)


@eqx.filter_jit
def _light_on_splats(scene: Scene, plan: Plan, settings: RenderSettings) -> EnteringLight:
    (scene,) = in_one_dtype(scene)
    if plan.mesh is None:
        return let_light_in(scene, cast_shadows(scene, settings, plan))

    def share(devices: Devices, scene: Scene, plan: Plan) -> EnteringLight:
        return let_light_in(scene, cast_shadows(scene, settings, plan, bounds_over(devices)))

    found, count = (
        over(plan.mesh, share, scene, plan, found=PartitionSpec(None, Devices.of(plan.mesh).axes)),
        scene.splats.count,
    )
    if found.source.shape[1] == count:
        return found
    whole = laid_out(plan.mesh, found, jax.tree.map(lambda _: PartitionSpec(), found))
    return jax.tree.map(lambda rows: rows[:, :count], whole)


def diffuse(
    scene: Scene,
    irradiance: Float[Array, "splats channels"],
    camera: Camera,
    settings: RenderSettings | None = None,
    plan: Plan | None = None,
) -> Float[Array, "gaussians height width channels"]:
    r"""Diffuse any irradiance of the splats below the surface: pass 4 alone, the plain layers `L_k`
    (section 4.2).

    **Arguments:** as for `render`; of the scene only the splats' geometry and albedo and the
    material's Gaussians matter.

    - `irradiance`: that enters at each splat, in the channels of the material's weights.
      Differentiable.

    **Returns:** one layer per Gaussian on the front surface, 0 where there is none; NaN where the
    plan does not suffice. Weighted by `material.gaussians.weights` and summed they are the radiant
    exitance.

    **Raises:** `ValueError` when a plan is needed and not given, or when the channels disagree.
    """
    settings = RenderSettings() if settings is None else settings
    check_channels(scene)
    channels = scene.material.gaussians.weights.shape[1]
    if irradiance.shape[1] != channels:
        raise ValueError(
            f"irradiance has {irradiance.shape[1]} channels, material.gaussians.weights has "
            f"{channels}: {SAME}"
        )
    plan = plan_unless_traced(scene, camera, settings, plan)
    return _diffuse(scene, irradiance, camera, settings, plan)


@eqx.filter_jit
def _diffuse(scene: Scene, irradiance, camera: Camera, settings: RenderSettings, plan: Plan):
    scene, camera, irradiance = in_one_dtype(scene, camera, irradiance)
    if plan.mesh is None:
        layers, seen, needed = _layers(settings, scene, plan, camera, irradiance)
        return _front_picture(layers, seen, needed)

    def share(devices: Devices, scene: Scene, plan: Plan, camera: Camera, irradiance):
        layers, seen, needed = _layers(settings, scene, plan, camera, irradiance)
        return _front_picture(
            devices.everything(layers), of_all(seen, devices), devices.largest(needed)
        )

    return over(plan.mesh, share, scene, plan, camera, rows=(irradiance,))


def _layers(
    settings: RenderSettings,
    scene: Scene,
    plan: Plan,
    camera: Camera,
    irradiance: Float[Array, "splats channels"],
):
    """Give the plain layers in tiles, what is seen, and what room was needed over what there is."""
    splats, view = scene.splats, _splatting.PerspectiveView.of(camera)
    attributes = {"area": splats.areas[None], "source": irradiance.T}
    if splats.albedo is not None:
        attributes["albedo"] = splats.albedo.T
    seen = see_surfaces(splats, attributes, view, settings, plan)
    layers, needed = spread_light(scene, irradiance.T, seen, settings, plan)
    return layers.layers, seen, jnp.maximum(needed, seen.needed)


def _front_picture(
    layers: Float[Array, "tiles gaussians channels pixels"],
    seen: SeenSurfaces,
    needed: Float[Array, ""],
) -> Float[Array, "gaussians height width channels"]:
    return seen.poisoned_unless(needed <= 1).atlas.front_picture(layers.transpose(0, 1, 3, 2))
