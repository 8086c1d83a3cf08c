"""Light on a mesh: shadow maps of its faces, with the comparison of splats, and the light that
enters.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import splatting as _splatting
from splatjax.render import Irradiance, LightVisibility, irradiance_at_splats, shadow_views
from splatjax.scene import (
    AbstractLightSample,
    AbstractPointSample,
    Material,
    Scene,
    Splats,
    stack_lights,
)

from ._mesh_raster import Landing, barycentrics, capacity_for, interpolate, see_faces
from ._textured_mesh import TexturedMesh


class MeshShadow(eqx.Module):
    """A mesh as seen from one light."""

    light: AbstractLightSample
    depths: _splatting.ShadowMap
    attributes: Float[Array, "tiles 5 pixels"]
    """Texture coordinates and normal."""


class MeshLight(eqx.Module):
    """Lights in the order of the scene, and their shadow maps, `None` for none."""

    lights: tuple[AbstractLightSample, ...]
    shadows: tuple[MeshShadow | None, ...]
    settings: _splatting.ShadowSettings
    needed: Float[Array, ""]

    def on(self, points: Splats) -> LightVisibility:
        """Compute the fraction of each light that reaches points of the surface. Differentiable."""
        groups = stack_lights(self.lights)
        shares = []
        for group in groups:
            maps = [self.shadows[index] for index in group.light_indices]
            visible = [
                _splatting.compute_visibility(points, shadow.depths, self.settings)
                for shadow in maps
                if shadow is not None
            ]
            shares.append(jnp.stack(visible) if visible else None)
        return LightVisibility(groups, shares, self.needed)

    def entering(self, points: Splats, material: Material) -> Irradiance:
        """Compute the light that enters the surface at points, by the renderer's own interface."""
        return irradiance_at_splats(Scene(points, self.lights, material), self.on(points))


def light_views(
    mesh: TexturedMesh, lights: tuple[AbstractLightSample, ...], settings: _splatting.ShadowSettings
) -> list[_splatting.AbstractView | None]:
    """Return the view of each light; `None` for a light without shadows."""
    bounds = mesh.bounds()
    return [
        shadow_views(light, bounds, settings, cube=False)[0] if light.cast_shadows else None
        for light in lights
    ]


def shadow_capacities(
    mesh: TexturedMesh, lights: tuple[AbstractLightSample, ...], settings: _splatting.ShadowSettings
) -> tuple[int | None, ...]:
    """Return the capacity that each light's shadow map needs; lights must be concrete.

    **Raises:** `ValueError` for a point light that casts shadows from within the mesh's bounding
    sphere.
    """
    bounds = mesh.bounds()
    for i, light in enumerate(lights):
        if isinstance(light, AbstractPointSample) and light.cast_shadows:
            distance = float(jnp.linalg.norm(light.position - bounds.center))
            if distance < 1.05 * float(bounds.radius):
                raise ValueError(
                    f"lights[{i}] is {distance:g} mm from the middle of the mesh, inside its "
                    f"bounding sphere of radius {float(bounds.radius):g} mm; move it outside, "
                    "or give cast_shadows=False"
                )
    corners, views = mesh.corners(), light_views(mesh, lights, settings)
    return tuple(
        None if view is None else capacity_for(Landing.in_view(corners, view)) for view in views
    )


def mesh_light(
    mesh: TexturedMesh,
    lights: tuple[AbstractLightSample, ...],
    settings: _splatting.ShadowSettings,
    capacities: tuple[int | None, ...],
) -> MeshLight:
    r"""Make the shadow maps of a mesh (section 4.1, but of triangles). Differentiable in depth, not
    in visibility.

    **Arguments:**

    - `capacities`: from `shadow_capacities`.

    **Returns:** a `MeshLight`.
    """
    corners, shadows, needed = mesh.corners(), [], jnp.zeros((), mesh.vertices.dtype)
    views = light_views(mesh, lights, settings)
    for light, view, capacity in zip(lights, views, capacities, strict=True):
        if view is None or capacity is None:
            shadows.append(None)
            continue
        landing = Landing.in_view(corners, view)
        seen = see_faces(landing, capacity)
        carried = jnp.concatenate(
            [mesh.uvs, mesh.normals[mesh.faces], landing.depth[..., None]], axis=2
        )
        surface = interpolate(carried, seen, barycentrics(landing, seen)).transpose(2, 0, 1)
        grid = _splatting.TileGrid(view.width, view.height)
        depth = grid.cut(jnp.where(seen.covered, surface[5], 1.0)[None])[:, 0]
        coverage = grid.cut(seen.covered.astype(surface.dtype)[None])[:, 0]
        zeros = jnp.zeros_like(depth)
        planes = jnp.stack([depth, coverage, zeros, zeros])
        depths = _splatting.ShadowMap(view, planes, seen.needed)
        shadows.append(MeshShadow(light, depths, grid.cut(surface[:5])))
        needed = jnp.maximum(needed, seen.needed)
    return MeshLight(lights, tuple(shadows), settings, needed)
