"""Plans: the static sizes and orders that `jit`, `grad` and loops need, computed once."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding
from jaxtyping import Array, Bool, Float, Int

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax._chunking import Result
from splatjax._combination import DeviceMesh
from splatjax._records import check_class, is_traced
from splatjax.cache import kept
from splatjax.gaussians import pad_gaussians
from splatjax.scene import (
    AbstractLight,
    AbstractLightSample,
    Camera,
    DistantStratum,
    Scene,
    Splats,
    light_kinds,
    lights_by_kind,
)

from ._checks import check_channels, check_planned, check_scene, in_one_dtype
from ._lighting import ShadowPlan, plan_views
from ._parts import cut_and_order
from ._settings import RenderSettings

# Directions on the whole sphere, for which the shadow maps of any environment are planned.
_DIRECTIONS = [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z]


class Plan(eqx.Module):
    r"""The static sizes and orders that `jit`, `grad` and loops need; made by `make_plan` from
    concrete arrays.

    Capacities are static, indices are arrays. A picture that exceeds a capacity is NaN, and
    `overflow` is the ratio of needed to planned capacity.

    **Attributes:**

    - `order`: the compact order in which the splats of each device are rendered; the last one is
      repeated to complete a block.
    - `exists`: false for the repeated splats.
    - `shadows`: the capacity of the shadow maps of each group of lights of a kind; `None` for
      lights without shadows.
    - `diffusion`: the clusters and neighbors of the splats.
    - `interval`: standard deviations per spacing between which a layer becomes resolved.
    - `splatting`: the settings of passes 2 and 3, with the coverage of these splats.
    - `raster`: the capacity for the views of the cameras.
    - `sightlines`: the visibility between splats; `None` without bounces.
    - `mesh`: the devices of the splats; `None` for one. Static.
    - `splats`, `gaussians`: number of splats, and of Gaussians. Static.
    - `lights`: the kinds of lights. Static.
    """

    order: Int[Array, " places"]
    exists: Bool[Array, " places"]
    shadows: tuple[ShadowPlan | None, ...]
    diffusion: _diffusion.AbstractDiffusionPlan
    interval: Float[Array, "2"]
    splatting: _splatting.SplattingSettings
    raster: _splatting.AbstractRasterPlan
    sightlines: _splatting.Sightlines | None
    mesh: Mesh | None = eqx.field(static=True)
    splats: int = eqx.field(static=True)
    gaussians: int = eqx.field(static=True)
    lights: tuple[str, ...] = eqx.field(static=True)

    def specs(self, combination: DeviceMesh) -> "Plan":
        """Specify the arrays that are replicated, and those that are divided over the devices."""
        return eqx.tree_at(
            lambda plan: (
                *(plan.order, plan.exists, *plan.diffusion.shares()),
                *([] if plan.sightlines is None else [plan.sightlines.seen]),
            ),
            jax.tree.map(lambda _: PartitionSpec(), self),
            replace_fn=lambda _: combination.shares,
        )


@kept
def make_plan(
    scenes: Scene | Sequence[Scene],
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings = RenderSettings(),
    mesh: Mesh | None = None,
) -> Plan:
    r"""Plan a picture: choose the array sizes that JAX must know before it compiles.

        plan = make_plan(scene, camera)  # once, outside of jit and grad
        frame = eqx.filter_jit(lambda scene: render(scene, camera, plan=plan))(scene)
        assert frame.overflow == 0  # otherwise the picture is NaN: make a new plan

    How many splats fall on a tile, or near a splat, depends on the scene, but under `jit` the sizes
    of arrays must be fixed. A plan fixes them, with some to spare, together with the order of the
    splats.

    **Arguments:** concrete arrays, so call it outside of `jit` and `grad`.

    - `scenes`: one, or several that differ only in their lights: the same splats and material,
      lights of the same kinds in the same order.
    - `cameras`: one or several, whose pictures have one size.
    - `settings`: the settings of the pictures.
    - `mesh`: devices over which the splats are divided for rendering; the plan is made on one.

    **Returns:** a `Plan` for every one of the scenes with every camera. It also serves scenes that
    differ from these by

    - lights of any strength and color, and any environment;
    - variances within a factor of 1.25;
    - movements of splats against each other by less than a tenth of the width of a layer.

    A light that casts shadows from another place may need a new plan.

    **Raises:** `ValueError` for incompatible cameras or scenes, or a rasterizer or diffuser that
    does not work over a mesh.
    """
    cameras = list(cameras) if isinstance(cameras, Sequence) else [cameras]
    scenes = list(scenes) if isinstance(scenes, Sequence) else [scenes]
    check_planned(scenes, cameras)
    check_class("settings", settings, RenderSettings)
    if is_traced((scenes, cameras)):
        raise ValueError("make_plan needs concrete arrays; call it outside of jit, grad and vmap")
    (scene, *other_scenes), cameras = _on_one_device((scenes, cameras))
    scene, other_scenes, cameras = in_one_dtype(scene, other_scenes, cameras)
    # The view of each camera, and that of the largest picture that shares its program.
    views = [_splatting.PerspectiveView.padded(camera) for camera in cameras]
    views += [
        view.enlarged(camera)
        for view, camera in zip(views, cameras, strict=True)
        if (view.width, view.height) != (camera.width, camera.height)
    ]
    parts, order, exists = cut_and_order(scene.splats, mesh)
    # Only the rasterizer plans device by device; the others, for the splats of all.
    splats = parts[0] if mesh is None else jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
    bounds, interval, splatting = _measure(splats, settings)
    gaussians = scene.material.gaussians
    raster = settings.rasterizer.make_plan(parts, views, settings.splatting)
    plan = Plan(
        order=order,
        exists=exists,
        shadows=tuple(
            _plan_shadows(group, parts, bounds, settings)
            for group in _groups([scene.lights for scene in (scene, *other_scenes)])
        ),
        diffusion=settings.diffuser.make_plan(
            splats, pad_gaussians(gaussians).variances, settings.kernel, interval, len(parts)
        ),
        interval=interval,
        splatting=splatting,
        raster=raster.fitted(splats, views, splatting, len(parts)),
        sightlines=_splatting.Sightlines.build(splats, settings.sightlines)
        if settings.bounces
        else None,
        mesh=mesh,
        splats=scene.splats.count,
        gaussians=len(gaussians.variances),
        lights=light_kinds(scene.lights),
    )
    if mesh is None:
        return plan
    specs = plan.specs(DeviceMesh.of(mesh))
    return jax.tree.map(
        lambda leaf, spec: jax.device_put(leaf, NamedSharding(mesh, spec)), plan, specs
    )


def check_plan(plan: Plan, scene: Scene, mesh: Mesh | None = None, is_lit: bool = True) -> None:
    """Raise `ValueError` for a plan that was made for other splats, another number of Gaussians,
    other kinds of lights, or another mesh.
    """
    check_class("plan", plan, Plan)
    for name, planned, count in (
        ("splats", plan.splats, scene.splats.count),
        ("Gaussians", plan.gaussians, len(scene.material.gaussians.variances)),
    ):
        if planned != count:
            raise ValueError(
                f"the plan is for {planned} {name}, and the scene has {count}; make another plan"
            )
    if is_lit and plan.lights != (kinds := light_kinds(scene.lights)):
        raise ValueError(
            f"the plan is for lights of the kinds {list(plan.lights)}, and the scene has "
            f"{list(kinds)}; make another plan"
        )
    if mesh is not None and plan.mesh != mesh:
        raise ValueError(
            f"the plan is for {plan.mesh or 'one device'}, not for {mesh}; make it with "
            "splatjax.make_plan(..., mesh=mesh)"
        )


def check_lit(scene: Scene, plan: Plan, settings: RenderSettings) -> None:
    """Check the arguments of passes 1 and 4 without a camera."""
    for name, value, kind in (
        ("scene", scene, Scene),
        ("plan", plan, Plan),
        ("settings", settings, RenderSettings),
    ):
        check_class(name, value, kind)
    check_channels(scene)
    check_plan(plan, scene)


def check_linear_in_weights(settings: RenderSettings, plan: Plan) -> None:
    """Raise `ValueError` for bounces, with which a picture is not linear in the weights, and for a
    plan without separate layers.
    """
    if not plan.diffusion.separate:
        layers = getattr(settings.diffuser, "layers", _diffusion.ClusterDiffuser())
        raise ValueError(
            f"the plan is for {type(settings.diffuser).__name__}, which has no separate layers; "
            f"make it with settings of diffuser={layers}"
        )
    if settings.bounces:
        raise ValueError(
            f"settings.bounces is {settings.bounces}, and each bounce depends on the material's "
            "weights; give bounces=0, or differentiate splatjax.render in reverse mode"
        )


def plan_unless_traced(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    plan: Plan | None,
    mesh: Mesh | None = None,
    is_lit: bool = True,
) -> Plan:
    """Check the scene and the plan, or make a plan if none is given.

    **Raises:** `ValueError` for a plan of other splats or another mesh, or when none is given under
    `jit`, `grad` or `vmap`.
    """
    check_class("settings", settings, RenderSettings)
    check_scene(scene, camera, is_lit)
    if plan is not None:
        check_plan(plan, scene, mesh, is_lit)
        return plan
    if is_traced((scene, camera)):
        raise ValueError(
            "plan is None, and under jit, grad or vmap a plan is needed: make one outside, "
            "plan=splatjax.make_plan(scene, camera, settings)"
        )
    return make_plan(scene, camera, settings, mesh)


def _on_one_device(tree: Result) -> Result:
    """Gather arrays from several devices and processes, for planning."""

    def gathered(leaf):
        if not isinstance(leaf, jax.Array) or isinstance(leaf.sharding, SingleDeviceSharding):
            return leaf
        array = leaf if leaf.is_fully_addressable else process_allgather(leaf, tiled=True)
        return jnp.asarray(np.asarray(array))

    return jax.tree.map(gathered, tree)


@eqx.filter_jit
def _measure(splats: Splats, settings: RenderSettings):
    """Compute the bounds of the splats, the interval in which layers become resolved, and the
    settings with the weight sum that covers a pixel.
    """
    uneven, area = _diffusion.unevenness(splats), jnp.sum(splats.areas)
    square = jnp.sum(jnp.where(splats.areas > 0, splats.radii**2, 0.0))
    discs = jnp.where(area > 0, square / jnp.where(area > 0, area, 1.0), 1.0)
    bounds = _splatting.Bounds.of(splats, DeviceMesh())
    return bounds, settings.kernel.interval(uneven), settings.splatting.measured(uneven, discs)


def _groups(lights: Sequence[tuple[AbstractLight, ...]]) -> list[list[AbstractLightSample]]:
    """Return the samples in every scene, for each group of lights that are rendered together."""
    by_kind = [lights_by_kind(of_scene) for of_scene in lights]
    kinds = [
        [[(index, jax.tree.structure(sample)) for index, sample in group] for group in groups]
        for groups in by_kind
    ]
    for i, kinds_of_scene in enumerate(kinds):
        if kinds_of_scene != kinds[0]:
            raise ValueError(
                "scenes of one plan must have lights of the same kinds in the same order, and the "
                f"lights of scenes[{i}] differ"
            )
    return [
        [sample for group in of_scenes for _, sample in group]
        for of_scenes in zip(*by_kind, strict=True)
    ]


def _plan_shadows(
    lights: Sequence[AbstractLightSample],
    parts: Sequence[Splats],
    bounds: _splatting.Bounds,
    settings: RenderSettings,
) -> ShadowPlan | None:
    if not lights[0].cast_shadows:
        return None
    if isinstance(lights[0], DistantStratum):
        directions = jnp.asarray(_DIRECTIONS, lights[0].direction.dtype)
        lights = [
            dataclasses.replace(lights[0], direction=direction, shadow_towards=None)
            for direction in directions
        ]
    areas = np.concatenate([np.asarray(part.areas) for part in parts])
    spacing = float(np.sqrt(np.mean(areas[areas > 0]))) if np.any(areas > 0) else np.inf
    shadows = settings.shadows_of(lights[0]).for_spacing(spacing, bounds)
    merged = shadows.splats_per_disc(spacing, bounds)
    if merged > 1:
        parts = [_splatting.merge_splats(part, merged) for part in parts]
    of_lights, cube = plan_views(lights, bounds, shadows)
    views = [view for views in of_lights for view in views]
    raster = settings.rasterizer.for_shadows().make_plan(parts, views, settings.splatting)
    return ShadowPlan(raster, shadows, cube, merged)
