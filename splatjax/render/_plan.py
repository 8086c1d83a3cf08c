"""What `jit`, `grad` and loops need to know of shapes, found once."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.scene import AbstractLight, Camera, Scene, Splats, StackedLights, stack_lights

from ._inputs import in_one_dtype
from ._records import Plan, ShadowPlan, ShadowsWanted, Wanted, shadow_views, stands_among
from ._settings import RenderSettings
from ._sharded_plan import on_one_device, plan_over


def plan(
    scenes: Scene | Sequence[Scene],
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings | None = None,
    mesh: Mesh | None = None,
) -> Plan:
    r"""Find the capacities and orders that rendering a scene with these cameras needs.

    **Arguments:** concrete, not traced.

    - `scenes`: one, or several that differ in their lights alone: the same splats and material,
      lights of the same kinds in the same order.
    - `cameras`: all have pictures of one size.
    - `mesh`: devices over which the splats are cut when rendering; planned on one.

    **Returns:** a `Plan` that serves every scene with every camera, and scenes and materials near
    these: variances within a factor of 1.25, splats that have moved among each other by less than a
    tenth of a layer's width, light of any strength and color. A light that casts shadows from
    elsewhere may need more room.

    **Raises:** `ValueError` when cameras or scenes do not fit together.
    """
    return _plan(scenes, cameras, RenderSettings() if settings is None else settings, mesh)


def _plan(
    scenes: Scene | Sequence[Scene],
    cameras: Camera | Sequence[Camera],
    settings: RenderSettings,
    mesh: Mesh | None,
) -> Plan:
    cameras = [cameras] if isinstance(cameras, Camera) else list(cameras)
    scenes = [scenes] if isinstance(scenes, Scene) else list(scenes)
    if not cameras or not scenes:
        raise ValueError(
            f"a plan needs a scene and a camera at least, not {len(scenes)} scenes and "
            f"{len(cameras)} cameras"
        )
    scene, *others = scenes if mesh is None else on_one_device(scenes)
    cameras = cameras if mesh is None else on_one_device(cameras)
    scene, others, cameras = in_one_dtype(scene, others, cameras)
    if len({(camera.width, camera.height) for camera in cameras}) != 1:
        sizes = sorted({(camera.width, camera.height) for camera in cameras})
        raise ValueError(f"cameras of one plan must have pictures of one size, not {sizes}")
    for i, other in enumerate(others, 1):
        if not eqx.tree_equal((scene.splats, scene.material), (other.splats, other.material)):
            raise ValueError(
                f"scenes of one plan may differ in their lights alone, but scenes[{i}] has other "
                "splats or material"
            )
    groups = _groups([each.lights for each in (scene, *others)])
    views = [_splatting.PerspectiveView.of(camera) for camera in cameras]
    bounds = _splatting.Bounds.of(scene.splats)
    interval = _diffusion.handover_interval(
        _diffusion.irregularity(scene.splats), settings.diffusion
    )
    kernels = _diffusion.Kernels.of(
        scene.material.gaussians.variances, settings.diffusion.normalization
    )
    camera = settings.rasterizer.planned(scene.splats, views, settings.splatting)
    looks = [_look(scene.splats, view, settings.splatting, camera) for view in views]
    shadows = [_shadows_wanted(group, bounds, settings) for group in groups]
    wanted = Wanted(scene.splats, settings, kernels, interval, views, looks, shadows, camera)
    return _on_one_device(wanted) if mesh is None else plan_over(mesh, wanted)


def _on_one_device(wanted: Wanted) -> Plan:
    splats, settings, looks = wanted.splats, wanted.settings, wanted.looks
    shown = max(int(np.sum(np.asarray(look) > -np.inf)) for look in looks)
    tiles = min(_splatting.round_up(shown, 1), looks[0].size)
    atlases = [
        _splatting.Atlas.of(look, view, tiles)
        for look, view in zip(looks, wanted.views, strict=True)
    ]
    rasterizer = settings.rasterizer.for_shadows()
    shadows = (
        None
        if each is None
        else ShadowPlan(rasterizer.planned(splats, each.views, settings.splatting), each.cube)
        for each in wanted.shadows
    )
    return Plan(
        rasterizer=wanted.rasterizer,
        tiles=tiles,
        shadows=tuple(shadows),
        diffuser=settings.diffuser.planned(splats, wanted.kernels, wanted.interval, atlases),
        interval=wanted.interval,
        splats=splats.count,
    )


@eqx.filter_jit
def _look(
    splats: Splats, view, settings: _splatting.SplattingSettings, rasterizer
) -> Float[Array, "surfaces down across"]:
    """Find where there is anything to see, and how far away: a tile farther on every side, and two
    radii, for what moves.
    """
    nothing = jnp.zeros((0, splats.count), splats.centers.dtype)
    seen = _splatting.farthest_depths(rasterizer.summed(splats, nothing, view, settings), view)
    grown = jax.lax.reduce_window(seen, -jnp.inf, jax.lax.max, (1, 3, 3), (1, 1, 1), "SAME")
    return jnp.where(grown > -jnp.inf, grown + 2 * jnp.mean(splats.radii), -jnp.inf)


def check_count(plan: Plan, scene: Scene) -> None:
    """Raise `ValueError` for a plan that is made for another number of splats."""
    if plan.splats not in (None, scene.splats.count):
        raise ValueError(
            f"the plan is for {plan.splats} splats, and the scene has {scene.splats.count}; make "
            "it anew"
        )


def plan_unless_traced(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    plan: Plan | None,
    mesh: Mesh | None = None,
) -> Plan:
    """Give the plan, or make one where that can be. Its own mesh need not be named.

    **Raises:** `ValueError` for a plan of another number of splats or another mesh, or when none is
    given under `jit`, `grad` or `vmap`.
    """
    if plan is not None:
        check_count(plan, scene)
        if mesh is not None and plan.mesh != mesh:
            made_for = "one device" if plan.mesh is None else f"{plan.mesh}"
            raise ValueError(
                f"the plan is for {made_for}, not for {mesh}; make it with splatjax.plan(..., "
                "mesh=mesh)"
            )
        return plan
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((scene, camera))):
        raise ValueError(
            "under jit, grad or vmap a plan is needed: plan=splatjax.plan(scene, camera, "
            "settings), made outside"
        )
    return _plan(scene, camera, settings, mesh)


def _groups(lights: Sequence[tuple[AbstractLight, ...]]) -> list[list[StackedLights]]:
    """Give, for each group of lights that are rendered together, what it is in every scene."""
    stacked = [stack_lights(each) for each in lights]
    kinds = [
        [(jax.tree.structure(group.lights), group.places) for group in groups] for groups in stacked
    ]
    for i, each in enumerate(kinds):
        if each != kinds[0]:
            raise ValueError(
                "scenes of one plan must have lights of the same kinds in the same order, but not "
                f"so scenes[{i}]"
            )
    return [list(group) for group in zip(*stacked, strict=True)]


def _shadows_wanted(
    groups: Sequence[StackedLights], bounds: _splatting.Bounds, settings: RenderSettings
) -> ShadowsWanted | None:
    if not groups[0].lights.cast_shadows:
        return None
    lights = [light for group in groups for light in group.apart()]
    cube = stands_among(lights, bounds)
    return ShadowsWanted(
        [view for light in lights for view in shadow_views(light, bounds, settings, cube)], cube
    )
