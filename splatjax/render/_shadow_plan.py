"""Which views the shadow maps of a light need, and what capacity."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import splatting as _splatting
from splatjax.scene import AbstractLight, DirectionalLight, GaussianBeam, PointLight

_NEARLY = 1.05  # bounding radii, from which on one frustum around all splats fits


class ShadowPlan(eqx.Module):
    """Shadow maps for one group of lights. A point light among the splats needs the six faces of a
    cube.
    """

    raster: _splatting.AbstractRasterPlan
    cube: bool = eqx.field(static=True)

    def closeness(self, light: AbstractLight, bounds: _splatting.Bounds) -> Float[Array, ""]:
        """Compute a number above 1 for a point light that was planned outside the splats' bounding
        sphere and has come into it.
        """
        if self.cube or not isinstance(light, PointLight):
            return jnp.zeros_like(bounds.radius)
        distance = jnp.linalg.norm(light.position - bounds.center)
        return jax.lax.stop_gradient(bounds.radius / distance)


def is_among(lights: Sequence[AbstractLight], bounds: _splatting.Bounds) -> bool:
    """Test whether a point light is among the splats, or nearly so: then all of its group need a
    cube. Not for traced arrays.
    """
    distances = (
        float(jnp.linalg.norm(light.position - bounds.center))
        for light in lights
        if isinstance(light, PointLight)
    )
    return any(distance < _NEARLY * float(bounds.radius) for distance in distances)


def shadow_views(
    light: AbstractLight,
    bounds: _splatting.Bounds,
    settings: _splatting.ShadowSettings,
    cube: bool,
) -> Sequence[_splatting.AbstractView]:
    """Return the views of a light's shadow maps: one of all splats, or the six faces of a cube."""
    if isinstance(light, DirectionalLight | GaussianBeam):
        return [_splatting.distant_view(light.direction, bounds, settings)]
    if not isinstance(light, PointLight):
        raise ValueError(
            f"{type(light).__name__} has no shadow map; give a light with cast_shadows=False"
        )
    if cube:
        return _splatting.cube_views(light.position, settings)
    return [_splatting.near_view(light.position, bounds, settings)]
