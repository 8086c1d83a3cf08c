"""Pictures of more splats than fit into memory: parts are read one at a time, several times, and
only sums are kept.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax._chunking import jit_unless_traced, map_chunks, stack_rows
from splatjax._combination import DeviceMesh, PartByPart
from splatjax.scene import (
    AbstractLight,
    AbstractLightSample,
    Camera,
    Frame,
    Material,
    Parts,
    Scene,
    StackedLights,
    lights_by_kind,
    stack_lights,
)

from ._checks import check_channels, in_one_dtype
from ._devices import cut_frame
from ._lighting import (
    Irradiance,
    LightVisibility,
    irradiance_at_splats,
    map_visibility,
    plan_views,
)
from ._parts import pad_splats
from ._passes import sample_surfaces
from ._settings import RenderSettings
from ._statistics import ReplayableStream, measure_stream
from ._surface import (
    SurfaceAttributes,
    SurfaceSamples,
    compose,
    map_places,
    shade,
)


def render_streamed(
    parts: Parts,
    lights: AbstractLight | Sequence[AbstractLight],
    material: Material,
    camera: Camera,
    settings: RenderSettings = RenderSettings(),
    report: Callable[[str, int], None] | None = None,
) -> Frame:
    r"""Render splats part by part, in memory that does not grow with their number.

    **Arguments:**

    - `parts`: each call iterates over all splats from the beginning, in parts of one size except
      for a smaller last one, such as `splatjax.SplatFile`. Splats near in space must be near in
      memory.
    - `lights`, `material`, `camera`, `settings`: as for `render`, with the default rasterizer and
      diffuser.
    - `report`: called after each part with the name of the stage, and the number of finished
      splats.

    **Returns:** the frame of `render`, to rounding but for two differences. In pass 4 each part has
    its own clusters, and layers are evaluated at the visible points: the difference is below the
    error of the diffuser. The shadow maps of environments and area lights are rendered from all
    splats, as if `sample_shadows.merged_spacing` were 0. There are no gradients.

    **Raises:** `ValueError` when there are no splats, parts differ in size, are not the same each
    time, or the settings cannot be streamed.
    """
    if not callable(parts):
        raise ValueError(
            f"parts is a {type(parts).__name__}; give a function that iterates over the parts each "
            "time it is called, such as lambda: iter(list_of_splats)"
        )
    if settings.bounces:
        raise ValueError(
            f"settings.bounces is {settings.bounces}, and a stream does not support bounces; "
            "give bounces=0, or use splatjax.render, over a mesh if memory requires it"
        )
    rasterizer, diffuser = settings.rasterizer, settings.diffuser
    if not isinstance(rasterizer, _splatting.TileRasterizer) or not isinstance(
        diffuser, _diffusion.ClusterDiffuser
    ):
        raise ValueError(
            f"settings has a {type(rasterizer).__name__} and a {type(diffuser).__name__}; only a "
            "TileRasterizer and a ClusterDiffuser can be streamed"
        )
    stream = ReplayableStream(parts, report)
    size, bounds, spacing, fine, uneven, discs = measure_stream(lambda: stream("looking"))
    part_size = -(-size // _diffusion.POINTS_PER_BLOCK) * _diffusion.POINTS_PER_BLOCK

    def scenes(task: str) -> Iterator[Scene]:
        for part in stream(task):
            yield in_one_dtype(Scene(pad_splats(part, part_size), lights, material))[0]

    first = next(iter(scenes("looking")))
    check_channels(first)
    (first, camera), groups = in_one_dtype(first, camera), stack_lights(first.lights)
    dtype, view = first.splats.centers.dtype, _splatting.PerspectiveView.padded(camera)
    splatting = settings.splatting.measured(uneven, discs)
    settings = dataclasses.replace(settings, splatting=splatting)

    # Pass 1: the shadow maps of each light that casts shadows, in its group.
    def views_of(samples: list[AbstractLightSample]):
        if not samples[0].cast_shadows:
            return None
        shadows = settings.shadows_of(samples[0]).for_spacing(spacing, bounds)
        return plan_views(samples, bounds, shadows)[0]

    of_lights = [
        views_of([sample for _, sample in group]) for group in lights_by_kind(first.lights)
    ]
    views, structure = jax.tree.flatten(
        of_lights, is_leaf=lambda leaf: isinstance(leaf, _splatting.AbstractView)
    )
    sums = _sum_views(
        scenes,
        "shadow maps",
        part_size,
        views,
        rasterizer,
        splatting,
        lambda scene: jnp.zeros((0, scene.splats.count), dtype),
    )
    shadow_maps = structure.unflatten(
        _splatting.ShadowMap.of(of_view, seen_from)
        for of_view, seen_from in zip(sums, views, strict=True)
    )
    light = partial(_light, groups=groups, shadow_maps=shadow_maps, settings=settings)

    # Passes 2 and 3: the view of the camera.
    def attributes(scene: Scene) -> SurfaceAttributes:
        return settings.lighting.attributes(scene, *light(scene), view.position)

    (seen,) = _sum_views(
        scenes,
        "what the camera sees",
        part_size,
        [view],
        rasterizer,
        splatting,
        lambda scene: stack_rows(attributes(scene)),
    )
    visible, samples = _sample(seen, view, settings, attributes(first), bounds.center)

    # Pass 4, at the visible points.
    def sources() -> Iterator[_diffusion.Sources]:
        for scene in scenes("diffusion"):
            splats, (_, irradiance) = scene.splats, light(scene)
            centered = dataclasses.replace(splats, centers=splats.centers - bounds.center[None])
            yield _diffusion.Sources.of(centered, irradiance.source)

    interval = settings.kernel.interval(uneven)
    gaussians, layers = _diffusion.streamed_layers(
        sources(),
        diffuser,
        settings.kernel,
        first.material,
        spacing,
        fine,
        interval,
        samples.positions - bounds.center[None, :, None],
        samples.covered,
    )

    # Pass 5.
    frame = _shade(
        first,
        view,
        groups,
        visible,
        samples,
        layers,
        gaussians,
        interval,
        settings,
    )
    return cut_frame(frame, camera)


def _sum_views(
    scenes: Callable[[str], Iterator[Scene]],
    task: str,
    part_size: int,
    views: Sequence[_splatting.AbstractView],
    rasterizer: _splatting.TileRasterizer,
    splatting: _splatting.SplattingSettings,
    rows: Callable[[Scene], Array],
) -> list[_splatting.FragmentSums]:
    """Sum the fragments of all parts in some views."""
    if not views:
        return []
    demands = [
        [rasterizer.demand(scene.splats, view, splatting) for view in views]
        for scene in scenes("planning")
    ]
    plans = [
        rasterizer.plan_for([[part[k]] for part in demands], part_size, view)
        for k, view in enumerate(views)
    ]

    def parts() -> Iterator[list[_splatting.PartSweep]]:
        for scene in scenes(task):
            attributes = rows(scene)
            yield [
                plan.part_sweep(scene.splats, attributes, view, splatting)
                for plan, view in zip(plans, views, strict=True)
            ]

    summed = _splatting.sum_parts(parts, [plan.places for plan in plans], PartByPart())
    return [sums for sums, _ in summed]


@jit_unless_traced
def _light(
    scene: Scene,
    groups: list[StackedLights],
    shadow_maps: Sequence[Sequence[Sequence[_splatting.ShadowMap]] | None],
    settings: RenderSettings,
) -> tuple[LightVisibility, Irradiance]:
    """Look a part up in the shadow maps of all parts."""

    def of_light(group: StackedLights, maps: Sequence[_splatting.ShadowMap]):
        shadows, cube = settings.shadows_of(group.lights), len(maps) > 1
        return sum(map_visibility(scene, shadow_map, shadows, cube) for shadow_map in maps)

    visibility = [
        None if of_group is None else jnp.stack([of_light(group, maps) for maps in of_group])
        for group, of_group in zip(groups, shadow_maps, strict=True)
    ]
    light = LightVisibility(groups, visibility, jnp.zeros((), scene.splats.centers.dtype))
    return light, irradiance_at_splats(scene, light)


@jit_unless_traced
def _sample(
    sums: _splatting.FragmentSums,
    view: _splatting.AbstractView,
    settings: RenderSettings,
    like: SurfaceAttributes,
    origin: Float[Array, "3"],
) -> tuple[_splatting.VisibleSurfaces, SurfaceSamples]:
    visible = _splatting.VisibleSurfaces.of(sums, view, settings.splatting, DeviceMesh())
    sample = partial(sample_surfaces, visible, (like, None), origin[:, None])
    return visible, map_chunks(
        sample, visible.sums, visible.tiles, at_once=_splatting.TILES_AT_ONCE
    )


@jit_unless_traced
def _shade(
    scene: Scene,
    view: _splatting.PerspectiveView,
    groups: list[StackedLights],
    visible: _splatting.VisibleSurfaces,
    samples: SurfaceSamples,
    layers: Float[Array, "places layers values pixels"],
    gaussians: Int[Array, " layers"],
    interval: Float[Array, "2"],
    settings: RenderSettings,
) -> Frame:
    def shade_places(samples: SurfaceSamples, layers):
        samples = dataclasses.replace(samples, layers=layers)
        attributes = settings.lighting.at_pixels(scene, groups, samples)
        shaded, _ = shade(
            scene,
            view.position,
            groups,
            samples,
            attributes,
            gaussians,
            interval,
            settings.kernel,
        )
        return shaded

    return compose(scene, map_places(shade_places, samples, layers), visible)
