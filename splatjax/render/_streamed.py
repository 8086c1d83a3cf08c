"""A picture of more splats than memory holds: they come a part at a time, several times over, and leave only sums behind.

What the passes know of each other decides how often: where the front of every shadow map and of the camera ends; what it
weighs; where what lies behind ends; the shadow maps' surfaces; then light, and the camera's sums; then what the pixels gather.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.scene import AbstractLight, Camera, Frame, Material, Parts, Scene, Splats, StackedLights, stack_lights

from ._inputs import check_channels, in_one_dtype
from ._lighting import EnteringLight, LightOnSplats, let_light_in
from ._passes import SeenSurfaces, compose, shade, sources_of, surfaces_of
from ._records import shadow_views, stands_among
from ._settings import RenderSettings
from ._sharded_plan import filled_up_to
from ._survey import Survey

Report: TypeAlias = Callable[[str, int], None]
Scenes: TypeAlias = Callable[[str], Iterator[Scene]]
"""Gives a scene of each part, and tells what is being done with them."""
OfTiles: TypeAlias = Float[Array, "tiles pixels"]
Done = TypeVar("Done")


class _View(eqx.Module):
    """A view, with room for any part."""

    view: _splatting.AbstractView
    rasterizer: _splatting.TileRasterizer
    settings: _splatting.SplattingSettings

    def stages(self, splats: Splats, attributes: Float[Array, "attributes splats"] | None = None) -> _splatting.Stages:
        if attributes is None:
            attributes = jnp.zeros((0, splats.count), splats.centers.dtype)
        return _splatting.Stages.of(self.rasterizer.binned(splats, attributes, self.view, self.settings))

    def nothing(self, attributes: int, dtype: jnp.dtype) -> _splatting.FragmentSums:
        """Give the sums of no part."""
        tiles = _splatting.TileGrid(self.view.width, self.view.height).count
        return _splatting.FragmentSums.of(jnp.zeros((tiles, attributes + 2, _splatting.SIDE**2), dtype))


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

    - `parts`: gives all splats from the beginning whenever it is called, in parts of one size but the last, that are complete and
      near in memory where they are near in space: `splatjax.SplatFile`, for one.
    - `lights`, `material`, `camera`, `settings`: as for `render`; the rasterizer and the diffuser are the usual ones.
    - `report`: is told after each part what is being done, and how many splats are done.

    **Returns:** what `render` gives, to rounding but for pass 4: its clusters are those of each part, and every pixel gathers for
    itself, so that it differs by less than the diffuser's own error. Without gradients.

    **Raises:** `ValueError` when there are no splats, parts differ in size, are not the same each time, or the settings cannot
    be streamed.
    """
    settings = RenderSettings() if settings is None else settings
    rasterizer, diffuser = settings.rasterizer, settings.diffuser
    if not isinstance(rasterizer, _splatting.TileRasterizer) or not isinstance(diffuser, _diffusion.ClusterDiffuser):
        raise ValueError(
            f"only a TileRasterizer and a ClusterDiffuser can be streamed, not a {type(rasterizer).__name__} and a"
            f" {type(diffuser).__name__}"
        )

    def told(what: str) -> Iterator[Splats]:
        done = 0
        for part in parts():
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
    at = _with_room(every, [view, *(each.view for each in maps)], rasterizer, settings.splatting)
    limits, fronts, seconds = _ends_of_surfaces(every, at, dtype)
    behind = [each.nothing(0, dtype) for each in at[1:]]
    for scene in every("shadow maps") if maps else ():
        behind = _done(_behind(scene.splats, *each) for each in zip(at[1:], limits[1:], seconds[1:], behind, strict=True))
    surfaces = [_blended(*each) for each in zip(at[1:], fronts[1:], behind, strict=True)]

    def lit(scene: Scene) -> tuple[LightOnSplats, EnteringLight]:
        return _lit(scene, groups, maps, surfaces, settings.shadows)

    light, entering = lit(first)
    sizes = {name: rows.shape[0] for name, rows in settings.lighting.attributes(first, light, entering).items()}
    both = at[0].nothing(sum(sizes.values()), dtype), at[0].nothing(sum(sizes.values()), dtype)
    for scene in every("what the camera sees"):
        attributes = settings.lighting.attributes(scene, *lit(scene))
        rows = jnp.concatenate(list(attributes.values()))
        both = jax.block_until_ready(_pictured(scene.splats, rows, at[0], limits[0], seconds[0], both))
    if not all(bool(jnp.all(jnp.isfinite(sums.weights))) for sums in (*fronts, *behind, *both)):
        raise ValueError("the parts were not the same each time that they were asked for; give the same splats in the same order")
    summed = _splatting.SummedFragments(*both, jnp.zeros((), dtype))
    tiles = max(int(jnp.sum(_splatting.farthest_depths(summed, view) > -jnp.inf)), 1)
    surface = surfaces_of(summed, sizes, view, settings, tiles).lit(first, light, settings)

    kernels = _diffusion.Kernels.of(first.material.gaussians.variances, settings.diffusion.normalization)
    origin, interval = jnp.asarray(survey.middle, dtype), survey.interval(settings.diffusion, dtype)
    pixels = _diffusion.Pixels.of(surface.points, surface.covered, origin, surface.atlas)
    fine = jnp.asarray(survey.fine, dtype)
    sums = _diffusion.StreamedSums.begin(diffuser, kernels, survey.spacing, fine, interval, pixels)
    room = _diffusion.StreamedRoom()
    for scene in every("diffusion"):
        sums, room = sums.plus(sources_of(scene.splats, lit(scene)[1].source), room)
    return _finished(first, view, groups, surface, sums.found(first.material.gaussians.weights.shape[1]), interval, settings)


def _maps(groups: Sequence[StackedLights], survey: Survey, settings: RenderSettings, dtype: jnp.dtype) -> list[_Map]:
    bounds, found = survey.bounds(dtype), []
    for i, group in enumerate(groups):
        if not group.lights.cast_shadows:
            continue
        each = [jax.tree.map(lambda leaf, j=j: leaf[j], group.lights) for j in range(len(group.places))]
        cube = stands_among(each, bounds)
        found += [_Map(view, i, j, cube) for j, light in enumerate(each) for view in shadow_views(light, bounds, settings, cube)]
    return found


def _with_room(
    every: Scenes,
    views: Sequence[_splatting.AbstractView],
    rasterizer: _splatting.TileRasterizer,
    settings: _splatting.SplattingSettings,
) -> list[_View]:
    demands, rows = [[] for _ in views], 0
    for scene in every("planning"):
        rows = scene.splats.count
        for view, found in zip(views, demands, strict=True):
            found.append(rasterizer.demand(scene.splats, view, settings))
    return [_View(view, rasterizer.with_room(found, rows, view), settings) for view, found in zip(views, demands, strict=True)]


def _ends_of_surfaces(
    every: Scenes, at: Sequence[_View], dtype: jnp.dtype
) -> tuple[list[OfTiles], list[_splatting.FragmentSums], list[OfTiles]]:
    """Find where the front ends in every view, what it weighs, and where what lies behind ends."""
    fronts = [each.nothing(0, dtype) for each in at]
    limits = [jnp.full_like(each.weights, -jnp.inf) for each in fronts]
    ends = [(each, each) for each in limits]
    for scene in every("where the front ends"):
        limits = _done(_limits(scene.splats, *each) for each in zip(at, limits, strict=True))
    for scene in every("what it weighs"):
        fronts = _done(_fronts(scene.splats, *each) for each in zip(at, limits, fronts, strict=True))
    for scene in every("where what lies behind ends"):
        ends = _done(_ends(scene.splats, *each) for each in zip(at, limits, fronts, ends, strict=True))
    return limits, fronts, [_splatting.second_limits(*each) for each in ends]


def _done(found: Iterable[Done]) -> list[Done]:
    """Wait: parts that are read ahead would pile up."""
    return jax.block_until_ready(list(found))


@eqx.filter_jit
def _limits(splats: Splats, at: _View, so_far: OfTiles) -> OfTiles:
    return jnp.maximum(so_far, at.stages(splats).limits())


@eqx.filter_jit
def _fronts(splats: Splats, at: _View, limits: OfTiles, so_far: _splatting.FragmentSums) -> _splatting.FragmentSums:
    return jax.tree.map(jnp.add, so_far, at.stages(splats).front(limits))


@eqx.filter_jit
def _ends(
    splats: Splats, at: _View, limits: OfTiles, front: _splatting.FragmentSums, so_far: tuple[OfTiles, OfTiles]
) -> tuple[OfTiles, OfTiles]:
    stages = at.stages(splats)
    return jax.tree.map(jnp.maximum, so_far, stages.limits_behind(limits, stages.gaps(limits, front.weights)))


@eqx.filter_jit
def _behind(
    splats: Splats, at: _View, limits: OfTiles, seconds: OfTiles, so_far: _splatting.FragmentSums
) -> _splatting.FragmentSums:
    return jax.tree.map(jnp.add, so_far, at.stages(splats).behind(limits, seconds))


@eqx.filter_jit
def _blended(at: _View, front: _splatting.FragmentSums, behind: _splatting.FragmentSums) -> _splatting.Surfaces:
    both = (_splatting.Surface.of(sums, at.view, at.settings) for sums in (front, behind))
    return _splatting.Surfaces(*both, jnp.zeros((), front.weights.dtype))


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
        groups, [None if each is None else jnp.stack(each) for each in shares], jnp.zeros((), scene.splats.centers.dtype)
    )
    return light, let_light_in(scene, light)


@eqx.filter_jit
def _pictured(
    splats: Splats,
    attributes: Float[Array, "attributes splats"],
    at: _View,
    limits: OfTiles,
    seconds: OfTiles,
    so_far: tuple[_splatting.FragmentSums, _splatting.FragmentSums],
) -> tuple[_splatting.FragmentSums, _splatting.FragmentSums]:
    stages = at.stages(splats, attributes)
    return jax.tree.map(jnp.add, so_far, (stages.front(limits), stages.behind(limits, seconds)))


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
    layers = _diffusion.layers_of(diffused, material, surface.receivers(), interval, settings.diffusion.normalization)
    shaded = shade(scene, view, groups, surface, layers)
    return compose(shaded, surface, layers.resolved, material.gaussians.weights, jnp.zeros((), interval.dtype))
