"""A picture of more splats than memory holds: they come a part at a time, several times over, and
leave only sums behind.

What the passes know of each other decides how often: where the front of every shadow map and of the
camera ends; what it weighs; where what lies behind ends; the shadow maps' surfaces; then light, and
the camera's sums; then what the pixels gather.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.scene import (
    AbstractLight,
    Camera,
    Frame,
    Material,
    Parts,
    Scene,
    Splats,
    StackedLights,
    stack_lights,
)

from ._inputs import check_channels, in_one_dtype
from ._lighting import EnteringLight, LightOnSplats, let_light_in
from ._passes import SeenSurfaces, compose, shade, sources_of, surfaces_of
from ._records import shadow_views, stands_among
from ._settings import RenderSettings
from ._sharded_plan import filled_up_to
from ._survey import SameParts, Survey
from ._swept_views import SweptViews, behind, blended, ends_of_surfaces, pictured

Report: TypeAlias = Callable[[str, int], None]


class _Map(eqx.Module):
    """One shadow map, and whose it is."""

    view: _splatting.AbstractView
    group: int = eqx.field(static=True)
    light: int = eqx.field(static=True)
    cube: bool = eqx.field(static=True)


def render_streamed(
    parts: Parts,
    lights: Sequence[AbstractLight],
    material: Material,
    camera: Camera,
    settings: RenderSettings | None = None,
    report: Report | None = None,
) -> Frame:
    r"""Render splats that come a part at a time, in memory that does not grow with their number.

    **Arguments:**

    - `parts`: gives all splats from the beginning whenever it is called, in parts of one size but
      the last, that are complete and near in memory where they are near in space:
      `splatjax.SplatFile`, for one.
    - `lights`, `material`, `camera`, `settings`: as for `render`; the rasterizer and the diffuser
      are the usual ones.
    - `report`: is told after each part what is being done, and how many splats are done.

    **Returns:** what `render` gives, to rounding but for pass 4: its clusters are those of each
    part, and every pixel gathers for itself, so that it differs by less than the diffuser's own
    error. Without gradients.

    **Raises:** `ValueError` when there are no splats, parts differ in size, are not the same each
    time, or the settings cannot be streamed.
    """
    settings = RenderSettings() if settings is None else settings
    rasterizer, diffuser = settings.rasterizer, settings.diffuser
    if not isinstance(rasterizer, _splatting.TileRasterizer) or not isinstance(
        diffuser, _diffusion.ClusterDiffuser
    ):
        raise ValueError(
            "only a TileRasterizer and a ClusterDiffuser can be streamed, not a "
            f"{type(rasterizer).__name__} and a"
            f" {type(diffuser).__name__}"
        )

    same = SameParts(parts)

    def told(what: str) -> Iterator[Splats]:
        done = 0
        for part in same():
            yield part
            done += part.count
            if report is not None:
                report(what, done)

    survey = Survey.of(partial(told, "looking"))

    def every(what: str) -> Iterator[Scene]:
        for part in told(what):
            whole = Scene(filled_up_to(part, survey.rows), tuple(lights), material)
            yield in_one_dtype(whole)[0]

    first = next(iter(every("looking")))
    check_channels(first)
    (first, camera), groups = in_one_dtype(first, camera), stack_lights(first.lights)
    dtype = first.splats.centers.dtype
    view, maps = _splatting.PerspectiveView.of(camera), _maps(groups, survey, settings, dtype)
    views = SweptViews.planned(
        every, [view, *(each.view for each in maps)], rasterizer, settings.splatting
    )
    limits, fronts, seconds = ends_of_surfaces(every, views, dtype)
    shadows = views.but_the_first
    hidden = behind(
        every("shadow maps") if maps else iter(()), shadows, limits[1:], seconds[1:], dtype
    )
    surfaces = [blended(*each) for each in zip(shadows.at, fronts[1:], hidden, strict=True)]

    def lit(scene: Scene) -> tuple[LightOnSplats, EnteringLight]:
        return _lit(scene, groups, maps, surfaces, settings.shadows)

    light, entering = lit(first)
    sizes = {
        name: rows.shape[0]
        for name, rows in settings.lighting.attributes(first, light, entering).items()
    }
    camera_at, nothing = views.at[0], views.at[0].nothing(sum(sizes.values()), dtype)
    both = nothing, nothing
    for scene, shows in zip(every("what the camera sees"), views.in_the_first, strict=True):
        if shows:
            rows = jnp.concatenate(list(settings.lighting.attributes(scene, *lit(scene)).values()))
            both = jax.block_until_ready(
                pictured(scene.splats, rows, camera_at, limits[0], seconds[0], both)
            )
    summed = _splatting.SummedFragments(*both, jnp.zeros((), dtype))
    tiles = max(int(jnp.sum(_splatting.farthest_depths(summed, view) > -jnp.inf)), 1)
    surface = surfaces_of(summed, sizes, view, settings, tiles).lit(first, light, settings)

    kernels = _diffusion.Kernels.of(
        first.material.gaussians.variances, settings.diffusion.normalization
    )
    origin, interval = jnp.asarray(survey.middle, dtype), survey.interval(settings.diffusion, dtype)
    pixels = _diffusion.Pixels.of(surface.points, surface.covered, origin, surface.atlas)
    fine = jnp.asarray(survey.fine, dtype)
    sums = _diffusion.StreamedSums.begin(diffuser, kernels, survey.spacing, fine, interval, pixels)
    room = _diffusion.StreamedRoom()
    for scene in every("diffusion"):
        if sums.within_reach(scene.splats):
            sums, room = sums.plus(sources_of(scene.splats, lit(scene)[1].source), room)
    return _finished(
        first,
        view,
        groups,
        surface,
        sums.found(first.material.gaussians.weights.shape[1]),
        interval,
        settings,
    )


def _maps(
    groups: Sequence[StackedLights], survey: Survey, settings: RenderSettings, dtype: jnp.dtype
) -> list[_Map]:
    bounds, found = survey.bounds(dtype), []
    for i, group in enumerate(groups):
        if not group.lights.cast_shadows:
            continue
        each = group.apart()
        cube = stands_among(each, bounds)
        found += [
            _Map(view, i, j, cube)
            for j, light in enumerate(each)
            for view in shadow_views(light, bounds, settings, cube)
        ]
    return found


@eqx.filter_jit
def _lit(
    scene: Scene,
    groups: list[StackedLights],
    maps: Sequence[_Map],
    surfaces: Sequence[_splatting.Surfaces],
    settings: _splatting.ShadowSettings,
) -> tuple[LightOnSplats, EnteringLight]:
    """Let light in through the shadow maps of all parts."""
    shares: list = [None] * len(groups)
    for each, surface in zip(maps, surfaces, strict=True):
        share = _splatting.lit_share(scene.splats, each.view, surface, settings)
        if isinstance(each.view, _splatting.PerspectiveView) and each.cube:
            share = share * _splatting.in_cube_face(each.view, scene.splats.centers.T)
        if shares[each.group] is None:
            shares[each.group] = [0.0] * len(groups[each.group].places)
        shares[each.group][each.light] = shares[each.group][each.light] + share
    light = LightOnSplats(
        groups,
        [None if each is None else jnp.stack(each) for each in shares],
        jnp.zeros((), scene.splats.centers.dtype),
    )
    return light, let_light_in(scene, light)


@eqx.filter_jit
def _finished(
    scene: Scene,
    view: _splatting.PerspectiveView,
    groups: list[StackedLights],
    surface: SeenSurfaces,
    diffused: _diffusion.Diffused,
    interval: Float[Array, "2"],
    settings: RenderSettings,
) -> Frame:
    material = scene.material
    layers = _diffusion.layers_of(
        diffused, material, surface.receivers(), interval, settings.diffusion.normalization
    )
    shaded = shade(scene, view, groups, surface, layers)
    return compose(
        shaded, surface, layers.resolved, material.gaussians.weights, jnp.zeros((), interval.dtype)
    )
