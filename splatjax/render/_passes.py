"""The five passes, wired. No mathematics lives here."""

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from splatjax import diffusion as _diffusion, shading as _shading, splatting as _splatting
from splatjax._chunking import map_chunks
from splatjax.devices import Devices
from splatjax.scene import Camera, Frame, Scene, Splats, StackedLights, stack_lights

from ._lighting import LightOnSplats, let_light_in
from ._records import Plan, shadow_views
from ._settings import RenderSettings

BoundsOf: TypeAlias = Callable[[Splats], _splatting.Bounds]
"""Gives the sphere around all splats of some: `Bounds.of` of those that are all, `bounds_over` of a
device's.
"""


def bounds_over(devices: Devices) -> BoundsOf:
    """Give what finds the sphere around the splats of all devices."""
    return partial(_splatting.bounds_over, devices=devices)


def cast_shadows(
    scene: Scene, settings: RenderSettings, plan: Plan, bounds_of: BoundsOf = _splatting.Bounds.of
) -> LightOnSplats:
    """Pass 1."""
    groups = stack_lights(scene.lights)
    shares, needs = _lit_shares(scene.splats, groups, settings, plan, bounds_of(scene.splats))
    return LightOnSplats(
        groups,
        shares,
        jnp.max(jnp.stack(needs)) if needs else jnp.zeros((), scene.splats.centers.dtype),
    )


class SeenSurfaces(eqx.Module):
    """Passes 2 and 3: the surface in front and the one that shows behind its silhouettes, in the
    tiles of an atlas.
    """

    atlas: _splatting.Atlas
    points: Float[Array, "tiles 3 pixels"]
    """mm."""
    depth: Float[Array, "tiles pixels"]
    covered: Bool[Array, "tiles pixels"]
    named: dict[str, Float[Array, "tiles _rows pixels"]]
    """Blended attributes."""
    share: Float[Array, "tiles pixels"]
    """Of its pixel that each point covers: behind, of what the front leaves."""
    needed: Float[Array, ""]

    def poisoned_unless(self, fits: Bool[Array, ""]) -> "SeenSurfaces":
        """Make every picture NaN, and its derivatives too, where a plan does not suffice."""
        return eqx.tree_at(lambda seen: seen.atlas, self, self.atlas.poisoned_unless(fits))

    def lit(self, scene: Scene, light: LightOnSplats, settings: RenderSettings) -> "SeenSurfaces":
        """Give them with what passes 4 and 5 read."""
        named = settings.lighting.at_pixels(scene, light.groups, self.points, self.named)
        return eqx.tree_at(lambda seen: seen.named, self, named)

    def receivers(self, source: str = "source") -> _diffusion.SeenSurface:
        """Give what pass 4 asks of them, of the light of that name."""
        named = self.named
        albedo = named.get("albedo", jnp.ones_like(named[source]))
        return _diffusion.SeenSurface(
            self.points, self.covered, named[source], named["area"][:, 0], albedo
        )

    @property
    def coverage(self) -> Float[Array, "height width"]:
        """Of both surfaces together."""
        return self.atlas.picture(self.share[..., None])[..., 0]

    def picture(
        self, values: Float[Array, "tiles *rows pixels channels"]
    ) -> Float[Array, "*rows height width channels"]:
        """Lay the front over what shows behind it, premultiplied by coverage."""
        share = self.share.reshape(
            self.share.shape[0], *(1,) * (values.ndim - 3), self.share.shape[1], 1
        )
        return self.atlas.picture(share * values)


def see_surfaces(
    splats: Splats,
    attributes: dict[str, Array],
    view: _splatting.AbstractView,
    settings: RenderSettings,
    plan: Plan,
) -> SeenSurfaces:
    """Passes 2 and 3."""
    summed = plan.rasterizer.summed(
        splats, jnp.concatenate(list(attributes.values())), view, settings.splatting
    )
    return surfaces_of(
        summed,
        {name: rows.shape[0] for name, rows in attributes.items()},
        view,
        settings,
        plan.tiles,
    )


def surfaces_of(
    summed: _splatting.SummedFragments,
    sizes: dict[str, int],
    view: _splatting.AbstractView,
    settings: RenderSettings,
    tiles: int,
) -> SeenSurfaces:
    """Blend what is summed of the attributes, so many rows of each, and put it into so many
    tiles.
    """
    atlas = _splatting.Atlas.of(_splatting.farthest_depths(summed, view), view, tiles)
    surface = _splatting.Surface.of(
        atlas.pack(summed.front, summed.behind), view, settings.splatting
    )
    covered = stop_gradient(surface.weight_sum) > 0
    depth = jnp.where(covered, surface.depth, 1.0)
    return SeenSurfaces(
        atlas=atlas,
        points=atlas.points(depth).transpose(1, 0, 2),
        depth=depth,
        covered=covered,
        named=_by_name(sizes, surface.attributes),
        share=atlas.shares(surface.coverage),
        needed=jnp.maximum(summed.needed, atlas.needed),
    )


def sources_of(splats: Splats, irradiance: Float[Array, "channels splats"]) -> _diffusion.Sources:
    """Give the splats as sources of diffused light."""
    return _diffusion.Sources(splats.centers.T, splats.normals.T, splats.areas, irradiance)


def spread_light(
    scene: Scene,
    source: Float[Array, "channels splats"],
    seen: SeenSurfaces,
    settings: RenderSettings,
    plan: Plan,
) -> tuple[_diffusion.DiffusionLayers, Float[Array, ""]]:
    """Pass 4: also what room was needed over what there is."""
    rest = plan.interval, seen.atlas, plan.diffuser, settings.diffusion.normalization
    return _diffusion.diffusion_layers(
        sources_of(scene.splats, source), scene.material, seen.receivers(), *rest
    )


class ShadedSurface(eqx.Module):
    """The surface, shaded, in the tiles of an atlas; nothing premultiplied."""

    depth: Float[Array, "tiles pixels"]
    position: Float[Array, "tiles pixels 3"]
    normal: Float[Array, "tiles pixels 3"]
    albedo: Float[Array, "tiles pixels channels"]
    shadow: Float[Array, "tiles lights pixels"]
    irradiance: Float[Array, "tiles pixels channels"]
    post: Float[Array, "tiles pixels #channels"]
    """From a layer to the radiance towards the eye."""
    layers: Float[Array, "tiles gaussians pixels channels"]
    diffuse: Float[Array, "tiles pixels channels"]
    """The layers, weighted and summed."""
    specular: Float[Array, "tiles pixels channels"]
    single_scattering: Float[Array, "tiles pixels channels"] | None


def shade(
    scene: Scene,
    view: _splatting.PerspectiveView,
    groups: list[StackedLights],
    seen: SeenSurfaces,
    layers: _diffusion.DiffusionLayers,
) -> ShadedSurface:
    """Pass 5."""

    def shaded(points, depth, covered, named, layers):
        return _shade(scene, view, groups, points, depth, covered, named, layers)

    return map_chunks(
        shaded,
        seen.points,
        seen.depth,
        seen.covered,
        seen.named,
        layers.layers,
        at_once=_splatting.TILES_AT_ONCE,
    )


def _shade(
    scene: Scene, view, groups: list[StackedLights], position, depth, covered, named, layers
) -> ShadedSurface:
    splats, material = scene.splats, scene.material
    f0 = _shading.fresnel_f0(material.eta)
    dtype, shape, channels = depth.dtype, depth.shape, layers.shape[2]
    to_eye = jnp.broadcast_to(view.position[None, :, None], position.shape) - position
    outgoing = to_eye / jnp.sqrt(jnp.sum(to_eye * to_eye, axis=1, keepdims=True))
    points = _shading.SurfacePoints(
        positions=position.transpose(0, 2, 1),
        normals=_shading.unit_normals(named["normal"].transpose(0, 2, 1)),
        outgoing=outgoing.transpose(0, 2, 1),
        specular=material.specular if splats.specular is None else named["specular"][:, 0],
        roughness=material.roughness if splats.roughness is None else named["roughness"][:, 0],
        lit=[
            shares.transpose(1, 0, 2) if (shares := named.get(f"lit {i}")) is not None else None
            for i in range(len(groups))
        ],
    )
    specular = _shading.reflected_radiance(points, groups, f0, channels)
    albedo = jnp.ones((*shape, channels), dtype)
    post = (_shading.leaving_share(points, f0) / jnp.pi)[..., None]
    if splats.albedo is not None:
        albedo = named["albedo"].transpose(0, 2, 1)
        post = post * _shading.albedo_root(albedo)
    single = None
    if material.single_scattering is not None:
        single = _shading.single_scattered_radiance(points, groups, f0, material.single_scattering)
        if splats.albedo is not None:
            single = single * _shading.albedo_root(albedo) ** 2
    layers = post[:, None] * layers.transpose(0, 1, 3, 2)
    return ShadedSurface(
        depth=jnp.where(covered, depth, jnp.inf),
        position=jnp.where(covered[..., None], points.positions, 0.0),
        normal=points.normals,
        albedo=albedo,
        shadow=jnp.where(
            covered[:, None],
            _shadows_in_order(points.lit, groups, shape, dtype).transpose(1, 0, 2),
            1.0,
        ),
        irradiance=named.get("irradiance", named["source"]).transpose(0, 2, 1),
        post=post,
        layers=layers,
        diffuse=jnp.sum(material.gaussians.weights[None, :, None] * layers, axis=1),
        specular=jnp.where(covered[..., None], specular, 0.0),
        single_scattering=None if single is None else jnp.where(covered[..., None], single, 0.0),
    )


def five_passes(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    plan: Plan,
    bounds_of: BoundsOf = _splatting.Bounds.of,
) -> tuple[ShadedSurface, SeenSurfaces, Float[Array, "tiles gaussians pixels"], Float[Array, ""]]:
    """Give what is shaded and seen, how much of each layer is diffused, and what room was needed
    over what there is.
    """
    view = _splatting.PerspectiveView.of(camera)
    light = cast_shadows(scene, settings, plan, bounds_of)
    entering = let_light_in(scene, light)
    attributes = settings.lighting.attributes(scene, light, entering)
    seen = see_surfaces(scene.splats, attributes, view, settings, plan).lit(scene, light, settings)
    layers, needed = spread_light(scene, entering.source, seen, settings, plan)
    shaded = shade(scene, view, light.groups, seen, layers)
    needed = jnp.max(jnp.stack([needed, seen.needed, light.needed]))
    return shaded, seen, layers.resolved, needed


def compose(
    shaded: ShadedSurface,
    seen: SeenSurfaces,
    resolved: Float[Array, "tiles gaussians pixels"],
    weights: Float[Array, "gaussians channels"],
    needed: Float[Array, ""],
) -> Frame:
    """Lay the front over what shows behind it; all of it NaN where the plan does not suffice."""
    seen = seen.poisoned_unless(needed <= 1)
    front = seen.atlas.front_picture
    diffuse, specular = seen.picture(shaded.diffuse), seen.picture(shaded.specular)
    single = None if shaded.single_scattering is None else seen.picture(shaded.single_scattering)
    drawn = ((seen.share > 0) & seen.atlas.in_front[:, None]).astype(shaded.depth.dtype)
    handed_over = jnp.sum((1 - resolved) * drawn[:, None], axis=(0, 2)) / jnp.maximum(
        jnp.sum(drawn), 1
    )
    return Frame(
        beauty=diffuse + specular if single is None else diffuse + single + specular,
        coverage=seen.coverage,
        depth=front(shaded.depth[..., None], jnp.inf)[..., 0],
        position=front(shaded.position),
        normal=front(shaded.normal),
        albedo=seen.picture(shaded.albedo),
        shadow=front(shaded.shadow[..., None], 1.0)[..., 0],
        irradiance=seen.picture(shaded.irradiance),
        layers=seen.picture(shaded.layers),
        weights=weights,
        diffuse=diffuse,
        specular=specular,
        handed_over=seen.atlas.poison * handed_over,
        overflow=jnp.where(needed <= 1, 0.0, needed),
        single_scattering=single,
    )


def _lit_shares(
    splats: Splats,
    groups: list[StackedLights],
    settings: RenderSettings,
    plan: Plan,
    bounds: _splatting.Bounds,
):
    """Pass 1 for every group of lights: per group the share of each light that reaches each splat,
    or None.
    """
    lit, needs = [], []
    for group, shadow in zip(groups, plan.shadows, strict=True):
        if shadow is None:
            lit.append(None)
            continue

        def share(light, shadow=shadow):
            views = shadow_views(light, bounds, settings, shadow.cube)

            def one_view(view):
                surfaces = _splatting.light_surfaces(
                    splats, view, settings.splatting, shadow.rasterizer
                )
                shares = _splatting.lit_share(splats, view, surfaces, settings.shadows)
                if shadow.cube:
                    shares = shares * _splatting.in_cube_face(view, splats.centers.T)
                return shares, surfaces.needed

            shares, needed = jax.lax.map(one_view, _splatting.stack_views(views))
            return jnp.sum(shares, axis=0), jnp.maximum(
                jnp.max(needed), shadow.closeness(light, bounds)
            )

        shares, needed = jax.lax.map(share, group.lights)
        lit.append(shares)
        needs.append(jnp.max(needed))
    return lit, needs


def _by_name(sizes: dict[str, int], packed: Float[Array, "tiles rows pixels"]) -> dict[str, Array]:
    return dict(zip(sizes, jax.lax.split(packed, list(sizes.values()), axis=1), strict=True))


def _shadows_in_order(
    lit, groups: list[StackedLights], shape, dtype
) -> Float[Array, "lights tiles pixels"]:
    """Per light, in the scene's order; 1 where a light casts none."""
    planes = [jnp.ones(shape, dtype)] * sum(len(group.places) for group in groups)
    for group, shares in zip(groups, lit, strict=True):
        if shares is not None:
            for row, place in enumerate(group.places):
                planes[place] = shares[row]
    return jnp.stack(planes) if planes else jnp.zeros((0, *shape), dtype)
