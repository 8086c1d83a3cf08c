"""The five passes, wired: plan once what shapes they need, then render. No mathematics lives here."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from . import diffusion as _diffusion, shading as _shading, splatting as _splatting
from .scene import Camera, Frame, PointLight, Scene, Splats, StackedLights, stack_lights


class RenderSettings(eqx.Module):
    """How each pass works: the records of its room, and the objects that carry it out."""

    splatting: _splatting.SplattingSettings = _splatting.SplattingSettings()
    shadows: _splatting.ShadowSettings = _splatting.ShadowSettings()
    diffusion: _diffusion.DiffusionSettings = _diffusion.DiffusionSettings()
    rasterizer: _splatting.AbstractRasterizer = _splatting.TileRasterizer()
    diffuser: _diffusion.AbstractDiffuser = _diffusion.ClusterDiffuser()


class ShadowPlan(eqx.Module):
    """Shadow maps for one group of lights. A point light among the splats needs the six faces of a cube."""

    rasterizer: _splatting.AbstractRasterizer
    cube: bool = eqx.field(static=True)


class Plan(eqx.Module):
    r"""What `jit`, `grad` and loops need to know of shapes; made by `plan` from concrete arrays.

    Capacities are static, indices are arrays. A picture that needs more than its plan holds is NaN, and says so in `overflow`.
    """

    camera: _splatting.AbstractRasterizer
    shadows: tuple[ShadowPlan | None, ...]
    diffuser: _diffusion.AbstractDiffuser
    interval: Float[Array, "2"]


def plan(scene: Scene, cameras: Camera | Sequence[Camera], settings: RenderSettings | None = None) -> Plan:
    r"""Find the capacities and orders that rendering a scene with these cameras needs.

    **Arguments:** `scene`, `cameras`: concrete (not traced); all cameras have pictures of one size.

    **Returns:** a `Plan` that serves every one of the cameras, and scenes and materials near this one.
    """
    settings = RenderSettings() if settings is None else settings
    cameras = [cameras] if isinstance(cameras, Camera) else list(cameras)
    scene, *cameras = _in_one_dtype(scene, *cameras)
    if len({(camera.width, camera.height) for camera in cameras}) != 1:
        sizes = sorted({(camera.width, camera.height) for camera in cameras})
        raise ValueError(f"cameras of one plan must have pictures of one size, not {sizes}")
    views = [_splatting.PerspectiveView.of(camera) for camera in cameras]
    bounds = _splatting.Bounds.of(scene.splats)
    interval = _diffusion.handover_interval(_diffusion.irregularity(scene.splats), settings.diffusion)
    variances = scene.material.gaussians.variances
    kernels = _diffusion.Kernels(variances, settings.diffusion.normalization.depths(variances))
    return Plan(
        camera=settings.rasterizer.planned(scene.splats, views, settings.splatting),
        shadows=tuple(_plan_shadows(group, scene.splats, bounds, settings) for group in stack_lights(scene.lights)),
        diffuser=settings.diffuser.planned(scene.splats, kernels, interval, views),
        interval=interval,
    )


def render(scene: Scene, camera: Camera, settings: RenderSettings | None = None, plan: Plan | None = None) -> Frame:
    r"""Render a picture with all its layers: shadow maps, visibility, attributes, diffusion, shading.

    **Arguments:**

    - `scene`: splats (mm), lights and material. Differentiable; which splats are visible is not.
    - `camera`: Differentiable.
    - `settings`: how each pass works.
    - `plan`: from `splatjax.plan`; needed under `jit`, `grad` and `vmap`, made here otherwise.

    **Returns:** a `Frame` in the dtype of `splats.centers`.

    **Raises:** `ValueError` when a plan is needed and not given, or when the scene's channels disagree.
    """
    settings = RenderSettings() if settings is None else settings
    _check_channels(scene)
    plan = _plan_unless_traced(scene, camera, settings, plan)
    return _render(scene, camera, settings, plan)


_SAME = "give both the same number"
_make_plan = plan  # `plan` is also an argument of `render`


def diffuse(
    scene: Scene,
    irradiance: Float[Array, "splats channels"],
    camera: Camera,
    settings: RenderSettings | None = None,
    plan: Plan | None = None,
) -> Float[Array, "gaussians height width channels"]:
    r"""Diffuse any irradiance of the splats below the surface: pass 4 alone, the plain layers `L_k` (section 4.2).

    **Arguments:** as for `render`; of the scene only the splats' geometry and albedo and the material's Gaussians matter.

    - `irradiance`: that enters at each splat, in the channels of the material's weights. Differentiable.

    **Returns:** one layer per Gaussian on the front surface, 0 where there is none; NaN where the plan does not suffice.
    Weighted by `material.gaussians.weights` and summed they are the radiant exitance.

    **Raises:** `ValueError` when a plan is needed and not given, or when the channels disagree.
    """
    settings = RenderSettings() if settings is None else settings
    _check_channels(scene)
    channels = scene.material.gaussians.weights.shape[1]
    if irradiance.shape[1] != channels:
        raise ValueError(f"irradiance has {irradiance.shape[1]} channels, material.gaussians.weights has {channels}: {_SAME}")
    plan = _plan_unless_traced(scene, camera, settings, plan)
    return _diffuse(scene, irradiance, camera, settings, plan)


@eqx.filter_jit
def _diffuse(scene: Scene, irradiance, camera: Camera, settings: RenderSettings, plan: Plan):
    scene, camera, irradiance = _in_one_dtype(scene, camera, irradiance)
    splats, view = scene.splats, _splatting.PerspectiveView.of(camera)
    attributes = {"area": splats.areas[None], "source": irradiance.T}
    if splats.albedo is not None:
        attributes["albedo"] = splats.albedo.T
    _, (layers, _), needed = _see_and_diffuse(scene, attributes, view, settings, plan)
    return jnp.where(needed <= 1, layers.layers.transpose(0, 2, 3, 1), jnp.nan)


def _see_and_diffuse(scene: Scene, attributes: dict[str, Array], view, settings: RenderSettings, plan: Plan):
    """Passes 2 to 4: the surface in front and the one that shows behind its silhouettes, with their diffused light."""
    splats = scene.splats
    stacked = jnp.concatenate(list(attributes.values()))
    surfaces = _splatting.splat_surfaces(splats, stacked, view, settings.splatting, plan.camera)
    front, behind = ((each, _by_name(attributes, each.attributes)) for each in (surfaces.front, surfaces.behind))
    seen = [
        _diffusion.SeenSurface(each, named["source"], named["area"][0], named.get("albedo", jnp.ones_like(named["source"])))
        for each, named in (front, behind)
    ]
    sources = _diffusion.Sources(splats.centers.T, splats.normals.T, splats.areas, attributes["source"])
    layers, needed = _diffusion.diffusion_layers(
        sources, scene.material, seen, plan.interval, view, plan.diffuser, settings.diffusion.normalization
    )
    return (front, behind), layers, jnp.maximum(surfaces.needed, needed)


def _plan_unless_traced(scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan | None) -> Plan:
    if plan is not None:
        return plan
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((scene, camera))):
        raise ValueError("under jit, grad or vmap a plan is needed: plan=splatjax.plan(scene, camera, settings), made outside")
    return _make_plan(scene, camera, settings)


@eqx.filter_jit
def _render(scene: Scene, camera: Camera, settings: RenderSettings, plan: Plan) -> Frame:
    scene, camera = _in_one_dtype(scene, camera)
    splats, material = scene.splats, scene.material
    channels = material.gaussians.weights.shape[1]
    groups = stack_lights(scene.lights)
    view = _splatting.PerspectiveView.of(camera)
    f0 = _shading.fresnel_f0(material.eta)

    # Pass 1: how much of each light reaches each splat, and with it the light that enters there.
    lit, shadow_needs = _lit_shares(splats, groups, settings, plan)
    specular, roughness = _surface_parameters(splats, scene)

    def entering(cosine):
        share = 1 - _shading.directional_albedo(cosine, f0, specular, roughness)
        return share[None] if material.single_scattering is None else share[None] * material.left_to_diffuse(cosine).T

    irradiance = _diffusion.entering_irradiance(splats.centers, splats.normals, groups, lit, entering, channels)
    root = None if splats.albedo is None else _shading.albedo_root(splats.albedo).T
    source = irradiance if root is None else irradiance * root

    # Passes 2 to 4: what the camera sees, with blended attributes, and the light diffused to there.
    attributes = {
        "normal": splats.normals.T,
        "area": splats.areas[None],
        "source": source,
        "albedo": None if splats.albedo is None else splats.albedo.T,
        "irradiance": None if splats.albedo is None else irradiance,
        "specular": None if splats.specular is None else specular[None],
        "roughness": None if splats.roughness is None else roughness[None],
    }
    attributes = {name: rows for name, rows in attributes.items() if rows is not None}
    attributes |= {f"lit {i}": shares for i, shares in enumerate(lit) if shares is not None}
    seen, layers, need = _see_and_diffuse(scene, attributes, view, settings, plan)

    # Pass 5 on both, and the front laid over what shows behind it.
    front, behind = (
        _shade(scene, view, groups, f0, surface, named, layer) for (surface, named), layer in zip(seen, layers, strict=True)
    )
    needed = jnp.stack([need, *shadow_needs])
    return _compose(front, behind, material.gaussians.weights, jnp.max(needed))


class _Shaded(eqx.Module):
    """One surface, shaded; nothing premultiplied."""

    coverage: Float[Array, "height width"]
    depth: Float[Array, "height width"]
    position: Float[Array, "height width 3"]
    normal: Float[Array, "height width 3"]
    albedo: Float[Array, "height width channels"]
    shadow: Float[Array, "lights height width"]
    irradiance: Float[Array, "height width channels"]
    layers: Float[Array, "gaussians height width channels"]
    specular: Float[Array, "height width channels"]
    single_scattering: Float[Array, "height width channels"] | None
    resolved: Float[Array, "gaussians height width"]


def _shade(scene, view, groups, f0, surface, named, layers) -> _Shaded:
    """Pass 5 on one surface."""
    splats, material = scene.splats, scene.material
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
    leaving = _shading.leaving_share(points, f0) / jnp.pi
    albedo = jnp.ones((*shape, channels), dtype)
    post = leaving[..., None]
    if splats.albedo is not None:
        albedo = named["albedo"].transpose(1, 2, 0)
        post = post * _shading.albedo_root(albedo)
    single = None
    if material.single_scattering is not None:
        single = _shading.single_scattered_radiance(points, groups, f0, material.single_scattering)
        if splats.albedo is not None:
            single = single * _shading.albedo_root(albedo) ** 2
    return _Shaded(
        coverage=surface.coverage,
        depth=jnp.where(covered, surface.depth, jnp.inf),
        position=jnp.where(covered[..., None], points.positions, 0.0),
        normal=points.normals,
        albedo=albedo,
        shadow=_shadows_in_order(points.lit, groups, shape, dtype),
        irradiance=named.get("irradiance", named["source"]).transpose(1, 2, 0),
        layers=post[None] * layers.layers.transpose(0, 2, 3, 1),
        specular=jnp.where(covered[..., None], specular, 0.0),
        single_scattering=None if single is None else jnp.where(covered[..., None], single, 0.0),
        resolved=layers.resolved,
    )


def _compose(front: _Shaded, behind: _Shaded, weights: Float[Array, "gaussians channels"], needed: Float[Array, ""]) -> Frame:
    """Lay the front over what shows behind it; sum the layers."""
    through = (1 - front.coverage) * behind.coverage

    def over(name: str):
        a, b = getattr(front, name), getattr(behind, name)
        lift = (...,) if a.ndim == 2 else (..., None)
        return front.coverage[lift] * a + through[lift] * b

    layers = front.coverage[None, ..., None] * front.layers + through[None, ..., None] * behind.layers
    diffuse = jnp.sum(weights[:, None, None] * layers, axis=0)
    specular = over("specular")
    single = None if front.single_scattering is None else over("single_scattering")
    drawn = (front.coverage > 0).astype(front.depth.dtype)
    handed_over = jnp.sum((1 - front.resolved) * drawn[None], axis=(1, 2)) / jnp.maximum(jnp.sum(drawn), 1)
    frame = Frame(
        beauty=diffuse + specular if single is None else diffuse + single + specular,
        coverage=front.coverage + through,
        depth=front.depth,
        position=front.position,
        normal=front.normal,
        albedo=over("albedo"),
        shadow=front.shadow,
        irradiance=over("irradiance"),
        layers=layers,
        weights=weights,
        diffuse=diffuse,
        specular=specular,
        handed_over=handed_over,
        overflow=jnp.where(needed > 1, needed, 0.0),
        single_scattering=single,
    )
    fits = needed <= 1
    poisoned = jax.tree.map(lambda leaf: jnp.where(fits, leaf, jnp.nan), frame)
    return eqx.tree_at(lambda f: (f.weights, f.overflow), poisoned, (weights, frame.overflow))


def _lit_shares(splats: Splats, groups: list[StackedLights], settings: RenderSettings, plan: Plan):
    """Pass 1 for every group of lights: per group the share of each light that reaches each splat, or None."""
    bounds = _splatting.Bounds.of(splats)
    lit, needs = [], []
    for group, shadow in zip(groups, plan.shadows, strict=True):
        if shadow is None:
            lit.append(None)
            continue

        def share(light, shadow=shadow):
            views = _shadow_views(light, bounds, settings, shadow.cube)

            def one_view(view):
                surfaces = _splatting.light_surfaces(splats, view, settings.splatting, shadow.rasterizer)
                shares = _splatting.lit_share(splats, view, surfaces, settings.shadows)
                if shadow.cube:
                    shares = shares * _splatting.in_cube_face(view, splats.centers.T)
                return shares, surfaces.needed

            shares, needed = jax.lax.map(one_view, _splatting.stack_views(views))
            return jnp.sum(shares, axis=0), jnp.max(needed)

        shares, needed = jax.lax.map(share, group.lights)
        lit.append(shares)
        needs.append(jnp.max(needed))
    return lit, needs


def _shadow_views(light, bounds, settings: RenderSettings, cube: bool) -> Sequence[_splatting.AbstractView]:
    if not isinstance(light, PointLight):
        return [_splatting.distant_view(light.direction, bounds, settings.shadows)]
    if cube:
        return _splatting.cube_views(light.position, settings.shadows)
    return [_splatting.near_view(light.position, bounds, settings.shadows)]


def _plan_shadows(group: StackedLights, splats: Splats, bounds, settings: RenderSettings) -> ShadowPlan | None:
    if not group.lights.cast_shadows:
        return None
    cube = False
    if isinstance(group.lights, PointLight):
        distance = jnp.linalg.norm(group.lights.position - bounds.center[None], axis=1)
        cube = bool(jnp.any(distance < 1.05 * bounds.radius))
    lights = [jax.tree.map(lambda leaf, i=i: leaf[i], group.lights) for i in range(len(group.places))]
    views = [view for light in lights for view in _shadow_views(light, bounds, settings, cube)]
    return ShadowPlan(settings.rasterizer.planned(splats, views, settings.splatting), cube)


def _surface_parameters(splats: Splats, scene: Scene):
    """The material's specular strength and roughness, times the splats' own."""
    material = scene.material
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


def _in_one_dtype(scene: Scene, *rest):
    """Cast every float to the dtype of the splats' centers, once."""
    dtype = scene.splats.centers.dtype

    def cast(leaf):
        return leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf

    return jax.tree.map(cast, (scene, *rest))


def _check_channels(scene: Scene) -> None:
    """All that carries color must have as many channels as the material's weights."""
    channels = scene.material.gaussians.weights.shape[1]
    found = {}
    if scene.splats.albedo is not None:
        found["splats.albedo"] = scene.splats.albedo.shape[1]
    if scene.material.single_scattering is not None:
        found["material.single_scattering.medium"] = scene.material.single_scattering.medium.sigma_a.shape[0]
    point = jax.ShapeDtypeStruct((1, 3), scene.splats.centers.dtype)
    for i, light in enumerate(scene.lights):
        found[f"lights[{i}]"] = eqx.filter_eval_shape(lambda light, x: light.incidence(x)[1], light, point).shape[1]
    for name, count in found.items():
        if count != channels:
            raise ValueError(f"{name} has {count} channels, material.gaussians.weights has {channels}: {_SAME}")
