"""What a plan is made of, and what it must make room for."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.scene import AbstractLight, DirectionalLight, GaussianBeam, PointLight, Splats

from ._settings import RenderSettings

# times the radius of the splats' bounding sphere, around which one frustum fits from outside alone
_NEARLY = 1.05


class ShadowPlan(eqx.Module):
    """Shadow maps for one group of lights. A point light among the splats needs the six faces of a
    cube.
    """

    rasterizer: _splatting.AbstractRasterizer
    cube: bool = eqx.field(static=True)

    def closeness(self, light: AbstractLight, bounds: _splatting.Bounds) -> Float[Array, ""]:
        """Give above 1 for a point light that was planned outside the splats' bounding sphere and
        has come into it.
        """
        if self.cube or not isinstance(light, PointLight):
            return jnp.zeros_like(bounds.radius)
        return jax.lax.stop_gradient(
            bounds.radius / jnp.linalg.norm(light.position - bounds.center)
        )


class Plan(eqx.Module):
    r"""What `jit`, `grad` and loops need to know of shapes; made by `plan` from concrete arrays.

    Capacities are static, indices are arrays. A picture that needs more than its plan holds is NaN,
    and says so in `overflow`.

    **Attributes:**

    - `rasterizer`: with room for what the camera sees.
    - `tiles`: of the picture, that show a surface or one behind it. Static.
    - `shadows`: for each group of lights of a kind the room of its shadow maps; `None` for lights
      that cast no shadows.
    - `diffuser`: with the clusters of the splats.
    - `interval`: standard deviations per spacing between which a layer passes from the surface to
      diffusion.
    - `mesh`: the devices that hold the splats; `None` for one. Static.
    - `splats`: how many it is for, whose order and clusters are in it; `None` for any number.
      Static.
    """

    rasterizer: _splatting.AbstractRasterizer
    tiles: int = eqx.field(static=True)
    shadows: tuple[ShadowPlan | None, ...]
    diffuser: _diffusion.AbstractDiffuser
    interval: Float[Array, "2"]
    mesh: Mesh | None = eqx.field(static=True, default=None)
    splats: int | None = eqx.field(static=True, default=None)


class Wanted(eqx.Module):
    """What a plan must make room for, in concrete arrays."""

    splats: Splats
    settings: RenderSettings
    kernels: _diffusion.Kernels
    interval: Float[Array, "2"]
    views: list[_splatting.PerspectiveView]
    """Of the cameras."""
    looks: list[Float[Array, "surfaces down across"]]
    """For each of them, where there is anything to see, and how far away."""
    shadows: list["ShadowsWanted | None"]
    """For each group of lights; `None` for lights that cast no shadows."""
    rasterizer: _splatting.AbstractRasterizer
    """With room for the views of the cameras."""


class ShadowsWanted(eqx.Module):
    """The views of the shadow maps of one group of lights."""

    views: list[_splatting.AbstractView]
    cube: bool = eqx.field(static=True)


def stands_among(lights: Sequence[AbstractLight], bounds: _splatting.Bounds) -> bool:
    """Say whether a point light stands among the splats, or nearly so: all of its group need a
    cube. Not for traced arrays.
    """
    near = (
        float(jnp.linalg.norm(light.position - bounds.center))
        for light in lights
        if isinstance(light, PointLight)
    )
    return any(distance < _NEARLY * float(bounds.radius) for distance in near)


def shadow_views(
    light: AbstractLight, bounds: _splatting.Bounds, settings: RenderSettings, cube: bool
) -> Sequence[_splatting.AbstractView]:
    """Give the views of a light's shadow maps: one of all splats, or the six faces of a cube around
    it.
    """
    if isinstance(light, DirectionalLight | GaussianBeam):
        return [_splatting.distant_view(light.direction, bounds, settings.shadows)]
    if not isinstance(light, PointLight):
        raise ValueError(
            f"{type(light).__name__}: no shadow map is known for it; give one with "
            "cast_shadows=False"
        )
    if cube:
        return _splatting.cube_views(light.position, settings.shadows)
    return [_splatting.near_view(light.position, bounds, settings.shadows)]
