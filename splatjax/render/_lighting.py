"""Pass 1, and the light that enters the surface: at the splats, or at the visible points."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax import diffusion as _diffusion, shading as _shading, splatting as _splatting
from splatjax._chunking import materialized
from splatjax._combination import DeviceMesh
from splatjax.scene import (
    AbstractLightSample,
    AbstractPointSample,
    DirectionalLight,
    GaussianBeam,
    Material,
    Scene,
    StackedLights,
    stack_lights,
)

from ._surface import surface_parameters

_GRAZING = 1e-3  # cosine
_NEARLY = 1.05  # least light distance, in bounding radii, for one frustum around all splats


class ShadowPlan(eqx.Module):
    """Shadow maps for one group of lights.

    **Attributes:**

    - `raster`: the capacity of the maps.
    - `settings`: settings of the maps and of the comparison with them.
    - `cube`: whether the maps are the six faces of a cube, for a point light among the splats.
      Static.
    - `splats_per_disc`: how many splats are merged into each disc in the maps. Static.
    - `lights`: the number of lights of the group that exist; the others are padding, come last and
      have no shadow map. `None` if all exist.
    """

    raster: _splatting.AbstractRasterPlan
    settings: _splatting.ShadowSettings
    cube: bool = eqx.field(static=True)
    splats_per_disc: int = eqx.field(static=True)
    lights: Int[Array, ""] | None = None

    def closeness(self, light: AbstractLightSample, bounds: _splatting.Bounds) -> Float[Array, ""]:
        """Divide the radius of the splats' bounding sphere by a point light's distance from its
        center. Above 1, a light that was outside the sphere when planned is now inside.
        """
        if self.cube or not isinstance(light, AbstractPointSample):
            return jnp.zeros_like(bounds.radius)
        distance = jnp.linalg.norm(light.position - bounds.center)
        return jax.lax.stop_gradient(bounds.radius / distance)


def plan_views(
    lights: Sequence[AbstractLightSample],
    bounds: _splatting.Bounds,
    settings: _splatting.ShadowSettings,
) -> tuple[list[Sequence[_splatting.AbstractView]], bool]:
    """Return the shadow-map views of each light of a group, and whether these are cube faces: all
    are, if any light is among or near the splats. Not for traced arrays.
    """
    cube = any(
        float(jnp.linalg.norm(light.position - bounds.center)) < _NEARLY * float(bounds.radius)
        for light in lights
        if isinstance(light, AbstractPointSample)
    )
    return [shadow_views(light, bounds, settings, cube) for light in lights], cube


def shadow_views(
    light: AbstractLightSample,
    bounds: _splatting.Bounds,
    settings: _splatting.ShadowSettings,
    cube: bool,
) -> Sequence[_splatting.AbstractView]:
    """Return the views of a light's shadow maps: one of all splats, or the six faces of a cube."""
    if isinstance(light, DirectionalLight | GaussianBeam):
        towards = getattr(light, "shadow_towards", None)
        direction = light.direction if towards is None else -towards
        return [_splatting.distant_view(direction, bounds, settings)]
    if not isinstance(light, AbstractPointSample):
        raise ValueError(
            f"{type(light).__name__} has no shadow map; give a light with cast_shadows=False"
        )
    if cube:
        return _splatting.cube_views(light.position, settings)
    return [_splatting.near_view(light.position, bounds, settings)]


class Transfer(eqx.Module):
    """Visibility of each light sample from each splat: pass 1, which does not depend on the
    strength and color of a light.

    **Attributes:**

    - `visibility`: for each kind of lights the visibility of each sample, along the splats in the
      order of the plan; `None` for lights that cast no shadows.
    - `needed`: needed capacity divided by planned capacity.
    - `places`: the directions and positions of the lights that cast shadows.
    """

    visibility: list[Float[Array, "_samples splats"] | None]
    needed: Float[Array, ""]
    places: tuple[dict[str, Array], ...] = ()


class LightVisibility(eqx.Module):
    """Pass 1: the fraction of each light that reaches each splat.

    **Attributes:**

    - `groups`: samples of lights of one kind, stacked.
    - `visibility`: for each group the visibility of each sample; `None` for lights that cast no
      shadows.
    - `needed`: needed capacity divided by planned capacity.
    """

    groups: list[StackedLights]
    visibility: list[Float[Array, "_samples points"] | None]
    needed: Float[Array, ""]

    def per_light(
        self, positions: Float[Array, "points 3"], normals: Float[Array, "points 3"]
    ) -> tuple[Float[Array, "_lights points"] | None, ...]:
        """Average the visibility of each light's samples, weighted by their unshadowed light.
        Samples below the horizon count as grazing.
        """

        def received(light):
            wi, irradiance = light.incidence(positions)
            return jnp.maximum(jnp.sum(normals * wi, -1), _GRAZING) * light.weight(irradiance)

        def mean(group: StackedLights, rows):
            if rows is None or len(group.distinct) == len(group.light_indices):
                return rows
            return group.mean_per_light(rows, jax.lax.map(received, group.lights))

        return tuple(map(mean, self.groups, self.visibility))


class Irradiance(eqx.Module):
    """Light below the surface, at splats or at visible points.

    **Attributes:**

    - `entering`: irradiance that enters the surface.
    - `source`: `entering` times the root of the albedo: what pass 4 diffuses.
    """

    entering: Float[Array, "channels points"]
    source: Float[Array, "channels points"]


def cast_shadows(
    scene: Scene,
    shadows: tuple[ShadowPlan | None, ...],
    splatting: _splatting.SplattingSettings,
    combination: DeviceMesh,
) -> LightVisibility:
    """Render the shadow maps of all lights (4.1) and look up the splats in them."""
    splats, groups = scene.splats, stack_lights(scene.lights)
    bounds = _splatting.Bounds.of(splats, combination)
    zero = jnp.zeros((), splats.centers.dtype)

    def of_group(group: StackedLights, plan: ShadowPlan | None):
        if plan is None:
            return None, zero
        per_disc = plan.splats_per_disc
        discs = splats if per_disc == 1 else _splatting.merge_splats(splats, per_disc)

        def of_light(light):
            def of_view(view):
                shadow_map = _splatting.make_shadow_map(
                    discs, view, splatting, plan.raster, combination, per_disc
                )
                visible = map_visibility(scene, shadow_map, plan.settings, plan.cube)
                return materialized(visible), shadow_map.needed

            views = shadow_views(light, bounds, plan.settings, plan.cube)
            stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *views)
            visible, needed = jax.lax.map(of_view, stacked)
            needed = jnp.maximum(jnp.max(needed), plan.closeness(light, bounds))
            return jnp.sum(visible, axis=0), needed

        if len(group.light_indices) > len(group.distinct):  # in a gradient, maps are rendered again
            of_light = jax.checkpoint(of_light)  # ty: ignore[invalid-assignment]

        def if_exists(numbered):
            number, light = numbered
            if plan.lights is None:
                return of_light(light)
            dark = jnp.zeros_like(splats.radii), zero
            return jax.lax.cond(number < plan.lights, of_light, lambda _: dark, light)

        numbers = jnp.arange(len(group.light_indices), dtype=jnp.int32)
        visible, needed = jax.lax.map(if_exists, (numbers, group.lights))
        return visible, jnp.max(needed)

    of_groups = [of_group(*pair) for pair in zip(groups, shadows, strict=True)]
    needed = jnp.max(jnp.stack([zero, *(needed for _, needed in of_groups)]))
    return LightVisibility(groups, [visible for visible, _ in of_groups], needed)


def map_visibility(
    scene: Scene,
    shadow_map: _splatting.ShadowMap,
    settings: _splatting.ShadowSettings,
    cube: bool,
) -> Float[Array, " splats"]:
    """Compute the splats' visibility from one map; 0 for splats of another cube face."""
    visibility = _splatting.compute_visibility(scene.splats, shadow_map, settings)
    if cube:
        visibility *= _splatting.in_cube_face(shadow_map.view, scene.splats.centers.T)
    return visibility


def irradiance_at_points(
    material: Material,
    light: LightVisibility,
    positions: Float[Array, "points 3"],
    normals: Float[Array, "points 3"],
    albedo: Float[Array, "points channels"] | None,
    roughness: Float[Array, " points"] | Float[Array, ""],
) -> Irradiance:
    """Compute the light that enters at points of the surface.

    **Arguments:**

    - `light`: the light, with the visibility at these points.
    - `normals`: unit.
    """
    f0 = _shading.fresnel_f0(material.eta)
    reflects = _shading.albedo_under(light.groups, f0, roughness)

    def enters(_, cosine):
        return (1 - reflects(cosine))[None] * material.diffuse_fraction(cosine).T

    irradiance = _shading.sum_received(
        positions, normals, light.groups, light.visibility, enters, material.channels
    )
    if albedo is None:
        return Irradiance(irradiance, irradiance)
    return Irradiance(irradiance, irradiance * _shading.albedo_root(albedo).T)


def irradiance_at_splats(scene: Scene, light: LightVisibility) -> Irradiance:
    """Compute the light that enters every splat."""
    splats, (_, roughness) = scene.splats, surface_parameters(scene.material, scene.splats)
    return irradiance_at_points(
        scene.material, light, splats.centers, splats.normals, splats.albedo, roughness
    )


def source_derivative(scene: Scene, light: LightVisibility) -> Float[Array, "channels splats"]:
    """Differentiate the source in the weights.

    With single scattering, less light is left for the Gaussians at grazing angles. This depends
    only on the sum of the weights, so the derivative is taken in one weight.
    """

    def source(weights: Float[Array, "gaussians channels"]):
        changed = eqx.tree_at(lambda s: s.material.gaussians.weights, scene, weights)
        return irradiance_at_splats(changed, light).source

    weights = scene.material.gaussians.weights
    return jax.jvp(source, (weights,), (jnp.zeros_like(weights).at[0].set(1),))[1]


def single_scattering_at_splats(
    scene: Scene, light: LightVisibility, eye: Float[Array, "3"]
) -> Float[Array, "channels splats"] | None:
    """Compute the radiance of light that scatters once, each sample with its own shadow."""
    splats, single = scene.splats, scene.material.single_scattering
    if single is None:
        return None
    points = _shading.SurfacePoints(
        splats.centers,
        splats.normals,
        _shading.unit_normals(eye[None] - splats.centers),
        *surface_parameters(scene.material, splats),
        light.visibility,
    )
    f0 = _shading.fresnel_f0(scene.material.eta)
    return _shading.single_scattered_radiance(points, light.groups, f0, single)


def beams_at_splats(
    scene: Scene, light: LightVisibility, irradiance: Irradiance
) -> _diffusion.Beams:
    """Refract the light that enters every splat, and sum it to one beam for each.

    **Arguments:**

    - `irradiance`: from `irradiance_at_splats`.
    """
    splats, material = scene.splats, scene.material
    f0, (_, roughness) = _shading.fresnel_f0(material.eta), surface_parameters(material, splats)
    reflects = _shading.albedo_under(light.groups, f0, roughness)

    def along(axis: int):
        def enters(wi, cosine):
            fraction = 1 - reflects(cosine)
            sine = jnp.minimum((1 - cosine * cosine) / (material.eta * material.eta), 1 - _GRAZING)
            inward = jnp.sqrt(1 - sine) - cosine / material.eta
            inside = wi[:, axis] / material.eta + inward * splats.normals[:, axis]
            return -(fraction * inside)[None]

        return _shading.sum_received(
            splats.centers,
            splats.normals,
            light.groups,
            light.visibility,
            enters,
            material.channels,
        )

    directions = jnp.stack([along(axis) for axis in range(3)], axis=1)
    entering = jnp.where(irradiance.entering > 0, irradiance.entering, 1.0)
    return _diffusion.Beams(irradiance.source, directions / entering[:, None])
