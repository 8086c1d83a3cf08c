"""Pictures of a mesh by texture-space diffusion, with the layers and the shading of the splats'
pictures.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import shading as _shading, splatting as _splatting
from splatjax._records import is_traced
from splatjax.render import LightVisibility, surface_parameters
from splatjax.scene import AbstractLightSample, Camera, Frame, Material

from ._mesh_light import MeshLight, mesh_light, shadow_capacities
from ._mesh_raster import Landing, barycentrics, capacity_for, interpolate, see_faces
from ._texture_space import (
    TextureLayers,
    TextureSpaceSettings,
    diffuse_in_texture,
    look_up_layers,
    rasterize_in_texture,
    reaches_of,
    stretch_map,
)
from ._textured_mesh import SurfaceTexels, TexturedMesh, surface_texels

_SETTINGS = TextureSpaceSettings()


class TexturePlan(eqx.Module):
    """The static sizes that `jit`, `grad` and loops need; made by `plan_texture_space` from
    concrete arrays.
    """

    texture: int = eqx.field(static=True)
    camera: int = eqx.field(static=True)
    shadows: tuple[int | None, ...] = eqx.field(static=True)
    reaches: tuple[int, ...] = eqx.field(static=True)


def plan_texture_space(
    mesh: TexturedMesh,
    lights: tuple[AbstractLightSample, ...],
    material: Material,
    camera: Camera,
    settings: TextureSpaceSettings = _SETTINGS,
) -> TexturePlan:
    """Compute the capacities for rendering a mesh, and the reaches of its blurs. Arguments are
    concrete, not traced.

    **Raises:** `ValueError` for a point light within the mesh's bounding sphere.
    """
    in_texture = Landing.in_texture(mesh.uvs, settings.resolution)
    in_view = Landing.in_view(mesh.corners(), _splatting.PerspectiveView.of(camera))
    capacities = capacity_for(in_texture), capacity_for(in_view)
    texels = rasterize_in_texture(mesh, settings.resolution, capacities[0])
    valid = texels.seen.covered.astype(mesh.vertices.dtype)
    taken = settings.stretch.millimeters(stretch_map(mesh, texels), valid)
    reaches = reaches_of(material.gaussians.variances, taken, valid)
    return TexturePlan(*capacities, shadow_capacities(mesh, lights, settings.shadows), reaches)


class TextureSpacePicture(eqx.Module):
    """A picture by texture-space diffusion, and the light as it was diffused in the texture."""

    frame: Frame
    texture: TextureLayers


def render_texture_space(
    mesh: TexturedMesh,
    lights: tuple[AbstractLightSample, ...],
    material: Material,
    camera: Camera,
    settings: TextureSpaceSettings = _SETTINGS,
    plan: TexturePlan | None = None,
) -> TextureSpacePicture:
    r"""Render a mesh with texture-space diffusion: shadow maps, irradiance map, blurs, far side,
    and the picture.

    Light, interface, material, normalization and shading are those of `splatjax.render`. Diffusion
    differs, and triangles are drawn with one sample per pixel, so edges are not smoothed.

    **Arguments:**

    - `mesh`: mm. Differentiable except for visibility.
    - `lights`, `material`, `camera`: as for `splatjax.render`. Differentiable.
    - `plan`: from `plan_texture_space`; needed under `jit`, `grad` and `vmap`, made here otherwise.

    **Returns:** a `TextureSpacePicture` in the dtype of `mesh.vertices`; if the plan's capacity is
    exceeded, it is NaN, and `overflow` of its frame is above 0.

    **Raises:** `ValueError` when a plan is needed and not given, or as `plan_texture_space` does.

    **Source:** d'Eon, Luebke and Enderton 2007; d'Eon and Luebke 2007 (GPU Gems 3, chapter 14).
    """
    if plan is None:
        if is_traced((mesh, lights, material, camera)):
            raise ValueError(
                "plan is None, and under jit, grad or vmap a plan is needed; make it outside, "
                "plan=plan_texture_space(...)"
            )
        plan = plan_texture_space(mesh, lights, material, camera, settings)
    return _render(mesh, lights, material, camera, settings, plan)


@eqx.filter_jit
def _render(
    mesh: TexturedMesh,
    lights,
    material: Material,
    camera: Camera,
    settings: TextureSpaceSettings,
    plan: TexturePlan,
):
    lights, material, camera = jax.tree.map(
        lambda leaf: leaf.astype(mesh.vertices.dtype) if eqx.is_inexact_array(leaf) else leaf,
        (lights, material, camera),
    )
    light = mesh_light(mesh, lights, settings.shadows, plan.shadows)
    texels = rasterize_in_texture(mesh, settings.resolution, plan.texture)
    texture = diffuse_in_texture(mesh, texels, light, material, settings, plan.reaches)
    view = _splatting.PerspectiveView.of(camera)
    landing = Landing.in_view(mesh.corners(), view)
    seen = surface_texels(mesh, landing, see_faces(landing, plan.camera))
    depth = interpolate(landing.depth[..., None], seen.seen, barycentrics(landing, seen.seen))[
        ..., 0
    ]
    needed = jnp.maximum(texture.needed, seen.seen.needed)
    frame = _shaded(seen, depth, look_up_layers(texture, seen.uvs), light, material, view, needed)
    return TextureSpacePicture(frame, texture)


def _shaded(
    seen: SurfaceTexels,
    depth: Float[Array, "height width"],
    layers: Float[Array, "gaussians points channels"],
    light: MeshLight,
    material: Material,
    view: _splatting.PerspectiveView,
    needed: Float[Array, ""],
) -> Frame:
    """Shade the visible points, as pass 5 does."""
    points, channels = seen.points, layers.shape[2]
    received: LightVisibility = light.on(points)
    f0 = _shading.fresnel_f0(material.eta)
    to_eye = view.position[None] - points.centers
    surface = _shading.SurfacePoints(
        points.centers,
        points.normals,
        _shading.unit_normals(to_eye),
        *surface_parameters(material, points),
        received.visibility,
    )
    covered = seen.seen.covered
    drawn = jnp.where(needed <= 1, 1.0, jnp.nan) * covered.reshape(-1, 1).astype(depth.dtype)
    per_exitance = (
        drawn * _shading.exit_transmission(surface, f0, material.angular_law()).T / jnp.pi
    )
    albedo = (
        jnp.ones((len(points.centers), channels), depth.dtype)
        if points.albedo is None
        else points.albedo
    )
    root = _shading.albedo_root(albedo)
    single = None
    if material.single_scattering is not None:
        single = _shading.single_scattered_radiance(
            surface, received.groups, f0, material.single_scattering
        )
        single = seen.picture(drawn * single.T * root**2)
    layers = (per_exitance * root)[None] * layers
    diffuse = seen.picture(jnp.sum(material.gaussians.weights[:, None] * layers, axis=0))
    specular = seen.picture(
        drawn * _shading.reflected_radiance(surface, received.groups, f0, channels).T
    )
    shadow = jnp.ones((len(light.lights), *covered.shape), depth.dtype)
    for group, shares in zip(received.groups, received.visibility, strict=True):
        if shares is not None:
            shares = jnp.where(covered[None], shares.reshape(-1, *covered.shape), 1.0)
            shadow = shadow.at[jnp.asarray(group.light_indices)].set(shares)
    return Frame(
        beauty=diffuse + specular if single is None else diffuse + single + specular,
        coverage=seen.picture(drawn[:, 0]),
        depth=jnp.where(covered, depth, jnp.inf),
        position=seen.picture(points.centers),
        normal=seen.picture(points.normals),
        albedo=seen.picture(drawn * albedo),
        shadow=shadow,
        irradiance=seen.picture(drawn * light.entering(points, material).entering.T),
        layers=layers.reshape(layers.shape[0], *covered.shape, channels),
        weights=material.gaussians.weights,
        diffuse=diffuse,
        specular=specular,
        unresolved_fraction=jnp.zeros(layers.shape[0], depth.dtype),
        overflow=jnp.where(needed <= 1, 0.0, needed),
        single_scattering=single,
    )
