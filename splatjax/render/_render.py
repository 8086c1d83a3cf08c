"""Pictures with all layers, the light of a body without a camera, and pass 4 alone."""

import dataclasses

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float

from splatjax._chunking import take_points
from splatjax._combination import lay_out
from splatjax._records import Numbers, as_floats, check_values, precision_of
from splatjax.cache import kept_jit
from splatjax.diffusion import Sources
from splatjax.scene import Camera, Frame, Scene
from splatjax.splatting import PerspectiveView, invalid_factor

from ._checks import check_shape
from ._devices import cut_frame, cut_to, on_devices, pad_scene, places_of, resize_visibility
from ._lighting import Irradiance, Transfer
from ._parts import splats_per_device
from ._passes import SplatLight
from ._plan import Plan, check_lit, plan_unless_traced
from ._settings import LightAtSplats, RenderSettings
from ._surface import compose


def render(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    plan: Plan | None = None,
    mesh: Mesh | None = None,
    light: SplatLight | Transfer | None = None,
) -> Frame:
    r"""Render a picture with all its layers: shadow maps, visibility, attributes, diffusion,
    shading.

        plan = make_plan(scene, camera)
        frame = render(scene, camera, plan=plan)
        mean = lambda scene: render(scene, camera, plan=plan).beauty.mean()
        gradient = eqx.filter_grad(mean)(scene)

    **Arguments:**

    - `scene`: splats (mm), lights and material. Differentiable; the choice of visible splats is
      not.
    - `camera`: position and size of the picture. Differentiable.
    - `settings`: settings of the passes, those of the plan.
    - `plan`: a plan from `splatjax.make_plan`, for this scene or a similar one. Required under
      `jit`, `grad` and `vmap`; otherwise made for each call.
    - `mesh`: devices over which the splats and their gradients are divided, of any axes
      (docs/devices.md). By default the mesh of the plan.
    - `light`: a precomputed result for the same settings and plan, to save time: from
      `splatjax.illuminate` (passes 1 and 4) for the same scene and another camera, or from
      `splatjax.transfer` (pass 1) for the same splats and lights of another strength.
      Differentiable.

    **Returns:** a `Frame` in the dtype of `splats.centers`. With a mesh, every device has the whole
    frame, equal to that without a mesh up to rounding. If the plan does not suffice, the picture is
    NaN and `overflow` is above 0.

    **Raises:** `ValueError` when a plan is needed and not given, or is for another mesh, other
    kinds of lights or another number of splats or Gaussians, when `light` is for other lights, or
    when the scene's channels disagree.
    """
    plan = plan_unless_traced(scene, camera, settings, plan, mesh)
    scene, plan, light, own_rows = pad_scene(scene, plan, light, camera)
    frame = _render(scene, PerspectiveView.padded(camera), settings, plan, light)
    return cut_frame(own_rows.frame(frame), camera)


@kept_jit
def _render(
    scene: Scene,
    view: PerspectiveView,
    settings: RenderSettings,
    plan: Plan,
    light: SplatLight | Transfer | None,
) -> Frame:
    def picture(passes, view, light=None):
        shaded, visible = passes.picture(
            view, lambda at: passes.light(at, kept=light), lambda shaded, *_: shaded
        )
        return compose(plan.diffusion.shown(passes.scene), shaded, visible)

    return on_devices(picture, scene, settings, plan, view, placed=light)


def illuminate(
    scene: Scene,
    plan: Plan,
    settings: RenderSettings = RenderSettings(),
    derivative: bool = False,
    light: Transfer | None = None,
) -> SplatLight:
    r"""Compute the light of a body and diffuse it: passes 1 and 4, which do not depend on the
    camera.

    Pass the result to `render` or `diffusion_basis` to render the same body with several cameras.

    **Arguments:**

    - `scene`: Differentiable.
    - `plan`: a plan from `splatjax.make_plan`.
    - `settings`: the settings of the plan.
    - `derivative`: as for `diffusion_basis`.
    - `light`: a result of `splatjax.transfer` with the same splats, settings and plan, for lights
      of the same kinds in the same order; no shadow map is then rendered. Differentiable.

    **Returns:** the light on the splats, in the order of the plan.

    **Raises:** `ValueError` when the channels disagree, or the plan is for another number of
    splats.
    """
    check_lit(scene, plan, settings)
    filled, plan, light, _ = pad_scene(scene, plan, light)
    return resize_visibility(_illuminate(filled, plan, settings, derivative, light), scene)


@kept_jit
def _illuminate(
    scene: Scene, plan: Plan, settings: RenderSettings, derivative: bool, light: Transfer | None
) -> SplatLight:
    def lit(passes, light=None):
        return passes.light(kept=light, derivative=derivative)

    return on_devices(lit, scene, settings, plan, by_splat=True, placed=light)


def transfer(scene: Scene, plan: Plan, settings: RenderSettings = RenderSettings()) -> Transfer:
    r"""Render the shadow maps of all lights, and return the visibility of each light from every
    splat.

    Pass the result to `render` or `illuminate`, for lights of other strengths and colors. An
    environment with given `directions` may also have another image of the same size, or another
    rotation:

        white = EnvironmentLight(np.ones((64, 128, 3)), directions=even_directions(128))
        kept = transfer(Scene(splats, [white], material), plan)
        frame = render(Scene(splats, [environment], material), camera, plan=plan, light=kept)

    **Arguments:** as for `illuminate`.

    **Returns:** a `Transfer`: 4 bytes for each splat and sample in float32. It is refused for
    lights in other directions or at other positions.

    **Raises:** `ValueError` as `illuminate` does.
    """
    check_lit(scene, plan, settings)
    filled, plan, *_ = pad_scene(scene, plan)
    kept = resize_visibility(_transfer(filled, plan, settings), scene)
    return dataclasses.replace(kept, places=places_of(scene.lights))


@kept_jit
def _transfer(scene: Scene, plan: Plan, settings: RenderSettings) -> Transfer:
    def shadows(passes):
        light = passes.visibility()
        return Transfer(light.visibility, light.needed)

    return on_devices(shadows, scene, settings, plan, by_splat=True)


def compute_irradiance(
    scene: Scene, plan: Plan, settings: RenderSettings = RenderSettings()
) -> Irradiance:
    r"""Compute the light that enters at every splat: pass 1, and the irradiance.

    **Arguments:** as for `illuminate`.

    **Returns:** the irradiance, and the part that spreads, `[channels, splats]` in the order of the
    scene: `source.T` is the argument of `diffuse_irradiance`. NaN where the plan does not suffice.

    **Raises:** `ValueError` as `illuminate` does.
    """
    check_lit(scene, plan, settings)
    return _compute_irradiance(scene, plan, settings)


@kept_jit
def _compute_irradiance(scene: Scene, plan: Plan, settings: RenderSettings) -> Irradiance:
    _, per_device = splats_per_device(scene.splats.count, plan.mesh)

    def entering(passes):
        light = passes.visibility()
        irradiance, *_, needed = passes.irradiance(light)
        needed = passes.combination.largest([jnp.maximum(light.needed, needed)])
        splat = jnp.where(passes.plan.exists, passes.plan.order, per_device)

        def in_scene_order(rows):
            dark = jnp.zeros((len(rows), per_device), rows.dtype)
            return invalid_factor(needed) * dark.at[:, splat].set(rows, mode="drop")

        return jax.tree.map(in_scene_order, irradiance)

    irradiance = on_devices(entering, scene, settings, plan, by_splat=True)
    if plan.mesh is not None:
        irradiance = lay_out(plan.mesh, irradiance, PartitionSpec())
    return jax.tree.map(lambda rows: rows[:, : scene.splats.count], irradiance)


def diffuse_irradiance(
    scene: Scene,
    irradiance: Numbers,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    plan: Plan | None = None,
) -> Float[Array, "gaussians height width channels"]:
    r"""Diffuse any irradiance of the splats below the surface: pass 4 alone, the plain layers `L_k`
    (section 4.2).

    **Arguments:** as for `render`; only the splats' geometry and albedo and the material's
    Gaussians are used.

    - `irradiance`: the light that enters each splat, [splats, channels], in the channels of the
      material, at least 0: pass 4 limits layers to positive values. For light of both signs,
      diffuse `irradiance + c`, and subtract the layers of `c`. Differentiable.

    **Returns:** one layer per Gaussian on the front surface, 0 where no surface is visible, and NaN
    if the plan does not suffice. Their sum weighted by `material.gaussians.weights` is the radiant
    exitance.

    **Raises:** `ValueError` when a plan is needed and not given, or for irradiance of another shape
    or below 0.
    """
    irradiance = as_floats(irradiance, precision_of([irradiance, scene]), "irradiance")
    shape = scene.splats.count, scene.material.channels
    check_shape("irradiance", irradiance, shape, "give a row for each splat, with all channels")
    check_values("irradiance", irradiance, "at least 0: add a constant to it", lambda x: x >= 0)
    plan = plan_unless_traced(scene, camera, settings, plan, is_lit=False)
    return _diffuse_irradiance(scene, irradiance, camera, settings, plan)


@kept_jit
def _diffuse_irradiance(
    scene: Scene, irradiance, camera: Camera, settings: RenderSettings, plan: Plan
):
    dark = Scene(scene.splats, (), scene.material)
    plain = dataclasses.replace(settings, lighting=LightAtSplats())

    def diffuse(passes, camera, irradiance):
        splats, material = passes.scene.splats, passes.scene.material
        source, gaussians = irradiance.T, material.gaussians

        def light_at(chosen):
            sources, diffusion = Sources.of(splats, source), passes.plan.diffusion
            diffused = diffusion.diffuse(
                sources, gaussians.variances, settings.kernel, passes.combination, chosen
            )
            seen = take_points(source, chosen)
            return SplatLight(
                visibility=[],
                irradiance=Irradiance(entering=seen, source=seen),
                layers=diffused.layers,
                derivative=None,
                added_source=None,
                needed=diffused.needed,
            )

        def read(shaded, layers, samples):
            return layers.weigh(gaussians, material.single_scattering_albedo())[0]

        layers, visible = passes.picture(PerspectiveView.padded(camera), light_at, read)
        return jnp.moveaxis(cut_to(camera, visible.front_picture(layers)), 2, 0)

    return on_devices(diffuse, dark, plain, plan, camera, rows=(irradiance,))
