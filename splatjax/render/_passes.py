"""The five passes, wired. No mathematics lives here."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, shading as _shading, splatting as _splatting
from splatjax.scene import Frame, Scene, Splats, StackedLights, stack_lights

from ._plan import Plan, shadow_views
from ._settings import RenderSettings


class LightOnSplats(eqx.Module):
    """Pass 1: what of each light reaches each splat."""

    groups: list[StackedLights]
    shares: list[Float[Array, "_lights splats"] | None]
    """Per group of lights; `None` for lights that cast no shadows."""
    needed: Float[Array, ""]


def cast_shadows(scene: Scene, settings: RenderSettings, plan: Plan) -> LightOnSplats:
    """Pass 1."""
    groups = stack_lights(scene.lights)
    shares, needs = _lit_shares(scene.splats, groups, settings, plan)
    return LightOnSplats(groups, shares, jnp.max(jnp.stack(needs)) if needs else jnp.zeros((), scene.splats.centers.dtype))


class EnteringLight(eqx.Module):
    """What the light leaves below the surface of each splat."""

    irradiance: Float[Array, "channels splats"]
    """That enters the surface."""
    source: Float[Array, "channels splats"]
    """That spreads: times the root of the albedo."""


def let_light_in(scene: Scene, light: LightOnSplats) -> EnteringLight:
    """The irradiance that enters at every splat."""
    splats, material = scene.splats, scene.material
    f0 = _shading.fresnel_f0(material.eta)
    specular, roughness = _surface_parameters(scene)

    def entering(cosine):
        share = 1 - _shading.directional_albedo(cosine, f0, specular, roughness)
        return share[None] if material.single_scattering is None else share[None] * material.left_to_diffuse(cosine).T

    channels = material.gaussians.weights.shape[1]
    irradiance = _diffusion.entering_irradiance(splats.centers, splats.normals, light.groups, light.shares, entering, channels)
    return EnteringLight(irradiance, irradiance if splats.albedo is None else irradiance * _shading.albedo_root(splats.albedo).T)


def surface_attributes(scene: Scene, light: LightOnSplats, entering: EnteringLight) -> dict[str, Float[Array, "_rows splats"]]:
    """What passes 2 and 3 blend for the passes that follow, by name."""
    splats = scene.splats
    specular, roughness = _surface_parameters(scene)
    attributes = {
        "normal": splats.normals.T,
        "area": splats.areas[None],
        "source": entering.source,
        "albedo": None if splats.albedo is None else splats.albedo.T,
        "irradiance": None if splats.albedo is None else entering.irradiance,
        "specular": None if splats.specular is None else specular[None],
        "roughness": None if splats.roughness is None else roughness[None],
    }
    attributes |= {f"lit {i}": shares for i, shares in enumerate(light.shares)}
    return {name: rows for name, rows in attributes.items() if rows is not None}


class SeenSurfaces(eqx.Module):
    """Passes 2 and 3: the surface in front, and the one that shows behind its silhouettes."""

    surfaces: tuple[_splatting.Surface, _splatting.Surface]
    named: tuple[dict[str, Array], dict[str, Array]]
    """Their blended attributes."""
    needed: Float[Array, ""]

    def receivers(self, source: str = "source") -> list[_diffusion.SeenSurface]:
        """Give what pass 4 asks of them, of the light of that name."""
        return [
            _diffusion.SeenSurface(each, named[source], named["area"][0], named.get("albedo", jnp.ones_like(named[source])))
            for each, named in zip(self.surfaces, self.named, strict=True)
        ]


def see_surfaces(
    splats: Splats, attributes: dict[str, Array], view: _splatting.AbstractView, settings: RenderSettings, plan: Plan
) -> SeenSurfaces:
    """Passes 2 and 3."""
    stacked = jnp.concatenate(list(attributes.values()))
    found = _splatting.splat_surfaces(splats, stacked, view, settings.splatting, plan.camera)
    named = _by_name(attributes, found.front.attributes), _by_name(attributes, found.behind.attributes)
    return SeenSurfaces((found.front, found.behind), named, found.needed)


def sources_of(splats: Splats, irradiance: Float[Array, "channels splats"]) -> _diffusion.Sources:
    """Give the splats as sources of diffused light."""
    return _diffusion.Sources(splats.centers.T, splats.normals.T, splats.areas, irradiance)


class ShadedSurface(eqx.Module):
    """One surface, shaded; nothing premultiplied."""

    coverage: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    albedo: Float[Array, "height width channels"]
    shadow: Float[Array, "lights height width"]
    irradiance: Float[Array, "height width channels"]
    post: Float[Array, "height width #channels"]
    """From a layer to the radiance towards the eye."""
    layers: Float[Array, "gaussians height width channels"]
    specular: Float[Array, "height width channels"]
    single_scattering: Float[Array, "height width channels"] | None
    resolved: Float[Array, "gaussians height width"]


def shade_surfaces(
    scene: Scene,
    view: _splatting.AbstractView,
    groups: list[StackedLights],
    seen: SeenSurfaces,
    layers: list[_diffusion.DiffusionLayers],
) -> list[ShadedSurface]:
    """Pass 5 on the surface in front and on the one behind it."""
    return [
        _shade(scene, view, groups, surface, named, layer)
        for surface, named, layer in zip(seen.surfaces, seen.named, layers, strict=True)
    ]


def _shade(scene: Scene, view, groups, surface: _splatting.Surface, named, layers: _diffusion.DiffusionLayers) -> ShadedSurface:
    splats, material = scene.splats, scene.material
    f0 = _shading.fresnel_f0(material.eta)
    covered = surface.weight_sum > 0
    dtype = surface.depth.dtype
    shape = surface.depth.shape
    position = _diffusion.pixel_points(view, surface.depth)
    to_eye = jnp.broadcast_to(view.position[:, None, None], position.shape) - position
    outgoing = to_eye / jnp.sqrt(jnp.sum(to_eye * to_eye, axis=0))[None]
    points = _shading.SurfacePoints(
        positions=position.transpose(1, 2, 0),
        normals=_shading.unit_normals(named["normal"].transpose(1, 2, 0)),
        outgoing=outgoing.transpose(1, 2, 0),
        specular=material.specular if splats.specular is None else named["specular"][0],
        roughness=material.roughness if splats.roughness is None else named["roughness"][0],
        lit=[named.get(f"lit {i}") for i in range(len(groups))],
    )
    channels = layers.layers.shape[1]
    specular = _shading.reflected_radiance(points, groups, f0, channels)
    albedo = jnp.ones((*shape, channels), dtype)
    post = (_shading.leaving_share(points, f0) / jnp.pi)[..., None]
    if splats.albedo is not None:
        albedo = named["albedo"].transpose(1, 2, 0)
        post = post * _shading.albedo_root(albedo)
    single = None
    if material.single_scattering is not None:
        single = _shading.single_scattered_radiance(points, groups, f0, material.single_scattering)
        if splats.albedo is not None:
            single = single * _shading.albedo_root(albedo) ** 2
    return ShadedSurface(
        coverage=surface.coverage,
        depth=jnp.where(covered, surface.depth, jnp.inf),
        position=jnp.where(covered[..., None], points.positions, 0.0),
        normal=points.normals,
        albedo=albedo,
        shadow=_shadows_in_order(points.lit, groups, shape, dtype),
        irradiance=named.get("irradiance", named["source"]).transpose(1, 2, 0),
        post=post,
        layers=post[None] * layers.layers.transpose(0, 2, 3, 1),
        specular=jnp.where(covered[..., None], specular, 0.0),
        single_scattering=None if single is None else jnp.where(covered[..., None], single, 0.0),
        resolved=layers.resolved,
    )


def over(front: ShadedSurface, behind: ShadedSurface, a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """Lay what belongs to the front over what belongs to the surface behind, premultiplied by coverage; channels last."""
    lift = (*(None,) * (a.ndim - 3), ..., None)
    return front.coverage[lift] * a + _shown_behind(front, behind)[lift] * b


def _shown_behind(front: ShadedSurface, behind: ShadedSurface) -> Float[Array, "height width"]:
    return (1 - front.coverage) * behind.coverage


def compose(
    front: ShadedSurface, behind: ShadedSurface, weights: Float[Array, "gaussians channels"], needed: Float[Array, ""]
) -> Frame:
    """Lay the front over what shows behind it; sum the layers."""

    def premultiplied(name: str):
        return over(front, behind, getattr(front, name), getattr(behind, name))

    layers = premultiplied("layers")
    diffuse = jnp.sum(weights[:, None, None] * layers, axis=0)
    specular = premultiplied("specular")
    single = None if front.single_scattering is None else premultiplied("single_scattering")
    drawn = (front.coverage > 0).astype(front.depth.dtype)
    handed_over = jnp.sum((1 - front.resolved) * drawn[None], axis=(1, 2)) / jnp.maximum(jnp.sum(drawn), 1)
    frame = Frame(
        beauty=diffuse + specular if single is None else diffuse + single + specular,
        coverage=front.coverage + _shown_behind(front, behind),
        depth=front.depth,
        position=front.position,
        normal=front.normal,
        albedo=premultiplied("albedo"),
        shadow=front.shadow,
        irradiance=premultiplied("irradiance"),
        layers=layers,
        weights=weights,
        diffuse=diffuse,
        specular=specular,
        handed_over=handed_over,
        overflow=jnp.where(needed > 1, needed, 0.0),
        single_scattering=single,
    )
    poisoned = poisoned_unless(needed <= 1, frame)
    return eqx.tree_at(lambda f: (f.weights, f.overflow), poisoned, (weights, frame.overflow))


def poisoned_unless(fits, tree):
    """Make every array NaN where the plan does not suffice."""
    return jax.tree.map(lambda leaf: jnp.where(fits, leaf, jnp.nan), tree)


def _lit_shares(splats: Splats, groups: list[StackedLights], settings: RenderSettings, plan: Plan):
    """Pass 1 for every group of lights: per group the share of each light that reaches each splat, or None."""
    bounds = _splatting.Bounds.of(splats)
    lit, needs = [], []
    for group, shadow in zip(groups, plan.shadows, strict=True):
        if shadow is None:
            lit.append(None)
            continue

        def share(light, shadow=shadow):
            views = shadow_views(light, bounds, settings, shadow.cube)

            def one_view(view):
                surfaces = _splatting.light_surfaces(splats, view, settings.splatting, shadow.rasterizer)
                shares = _splatting.lit_share(splats, view, surfaces, settings.shadows)
                if shadow.cube:
                    shares = shares * _splatting.in_cube_face(view, splats.centers.T)
                return shares, surfaces.needed

            shares, needed = jax.lax.map(one_view, _splatting.stack_views(views))
            return jnp.sum(shares, axis=0), jnp.maximum(jnp.max(needed), shadow.closeness(light, bounds))

        shares, needed = jax.lax.map(share, group.lights)
        lit.append(shares)
        needs.append(jnp.max(needed))
    return lit, needs


def _surface_parameters(scene: Scene):
    """The material's specular strength and roughness, times the splats' own."""
    splats, material = scene.splats, scene.material
    specular = material.specular if splats.specular is None else material.specular * splats.specular
    roughness = material.roughness if splats.roughness is None else material.roughness * splats.roughness
    return specular, roughness


def _by_name(attributes: dict[str, Array], stacked: Float[Array, "rows height width"]) -> dict[str, Array]:
    edges = [0]
    for rows in attributes.values():
        edges.append(edges[-1] + rows.shape[0])
    return {name: stacked[i:j] for name, i, j in zip(attributes, edges, edges[1:], strict=False)}


def _shadows_in_order(lit, groups: list[StackedLights], shape, dtype) -> Float[Array, "lights height width"]:
    """Per light, in the scene's order; 1 where a light casts none."""
    planes = [jnp.ones(shape, dtype)] * sum(len(group.places) for group in groups)
    for group, shares in zip(groups, lit, strict=True):
        if shares is not None:
            for row, place in enumerate(group.places):
                planes[place] = shares[row]
    return jnp.stack(planes) if planes else jnp.zeros((0, *shape), dtype)
