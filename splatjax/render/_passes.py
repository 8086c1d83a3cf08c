"""The five passes, wired once: what differs between pictures is what is read of the surface
samples, and between devices how partial results are combined. No mathematics lives here.
"""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float, PyTree

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax._chunking import map_chunks
from splatjax._combination import AbstractCombination
from splatjax.scene import Scene

from ._attributes import SurfaceAttributes, SurfaceSamples, split_rows, stack_rows
from ._lighting import (
    Irradiance,
    LightVisibility,
    cast_shadows,
    irradiate,
)
from ._plan import Plan
from ._settings import RenderSettings

Values = TypeVar("Values", bound=PyTree)
Read = Callable[[SurfaceSamples], Values]
"""Reads what a picture needs off the surface samples: pointwise, along their last axis."""


class SplatLight(eqx.Module):
    """The light of a body before anyone looks at it: passes 1 and 4 on the splats.

    **Attributes:** along the splats, in the order of the plan

    - `visibility`: of each light.
    - `irradiance`: that enters, and that spreads.
    - `layers`: of pass 4.
    - `derivative`: of the layers in the logarithms of their variances; `None` where not asked for.
    - `added_source`: the derivative of the spreading irradiance in a weight of the Gaussians;
      `None` where it has none. Its own layers follow those of the irradiance, channel by channel.
    - `needed`: capacity needed over planned.
    """

    visibility: list[Float[Array, "_lights splats"] | None]
    irradiance: Irradiance
    layers: tuple[_diffusion.LayerValues | None, ...]
    derivative: tuple[_diffusion.LayerValues | None, ...] | None
    added_source: Float[Array, "channels splats"] | None
    needed: Float[Array, ""]


def light_splats(
    scene: Scene,
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    derivative: bool = False,
    wanted: Bool[Array, " splats"] | None = None,
) -> SplatLight:
    """Passes 1 and 4: light the splats, and diffuse their irradiance among them.

    **Arguments:**

    - `derivative`: also differentiate the layers in the material's Gaussians.
    - `wanted`: the splats that will be looked at; all for `None`.
    """
    light = cast_shadows(scene, plan.shadows, settings.splatting, settings.shadows, combination)
    irradiance, added = irradiate(scene, light), None
    if derivative and scene.material.single_scattering is not None:
        irradiance, added = _irradiate_and_differentiate(scene, light)
    source = irradiance.source if added is None else jnp.concatenate([irradiance.source, added])
    layers, slopes, needed = diffuse_splats(
        scene, source, settings, plan, combination, derivative, wanted
    )
    needed = jnp.maximum(needed, light.needed)
    return SplatLight(light.visibility, irradiance, layers, slopes, added, needed)


def _irradiate_and_differentiate(scene: Scene, light: LightVisibility):
    """Also compute what each weight adds to the light that spreads: beside single scattering, which
    leaves less of it where light grazes.
    """
    weights = scene.material.gaussians.weights

    def irradiance(more: Float[Array, " channels"]):
        moved = weights.at[0].add(more)
        return irradiate(eqx.tree_at(lambda s: s.material.gaussians.weights, scene, moved), light)

    zero, one = jnp.zeros_like(weights[0]), jnp.ones_like(weights[0])
    found, slope = jax.jvp(irradiance, (zero,), (one,))
    return found, slope.source


def diffuse_splats(
    scene: Scene,
    source: Float[Array, "channels splats"],
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    derivative: bool = False,
    wanted: Bool[Array, " splats"] | None = None,
):
    """Pass 4: return the layers of the splats, their derivatives, and the capacity needed."""
    splats, variances = scene.splats, scene.material.gaussians.variances
    sources = _diffusion.Sources(splats.centers.T, splats.normals.T, splats.areas, source)
    given = sources, variances, settings.kernel, combination, wanted
    if not derivative:
        diffused = plan.diffusion.diffuse(*given)
        return diffused.layers, None, diffused.needed
    diffused, slopes = _diffusion.diffuse_with_derivative(plan.diffusion, *given)
    return diffused.layers, slopes.layers, diffused.needed


def see_and_read(
    scene: Scene,
    view: _splatting.AbstractView,
    light: SplatLight,
    attributes: SurfaceAttributes,
    read: Read[Values],
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
) -> tuple[Values, _splatting.VisibleSurfaces, Float[Array, ""]]:
    """Passes 2 and 3: blend the splats' attributes and layers, and read the samples.

    **Returns:** what was read, for each place of this device; the places; and the capacity needed
    over planned.
    """
    origin = stop_gradient(_splatting.Bounds.of(scene.splats, combination).center)
    attributes = with_layers(attributes, light, scene.splats.centers.T - origin[:, None])
    visible = _splatting.visible_surfaces(
        scene.splats, stack_rows(attributes), view, settings.splatting, plan.raster, combination
    )

    def sampled(samples: SurfaceSamples) -> SurfaceSamples:
        centers, own = samples.attributes.centers, samples.positions - origin[:, None]
        layers, slopes = samples.attributes.layers, samples.attributes.derivative

        def continued(layer):
            return layer and _diffusion.continue_to_points(layer, centers, own)

        parts = tuple(map(continued, layers)), slopes and tuple(map(continued, slopes))
        return eqx.tree_at(
            lambda each: (each.layers, each.derivative), samples, parts, is_leaf=lambda x: x is None
        )

    values = read_places(visible, attributes, lambda samples: read(sampled(samples)))
    return values, visible, jnp.maximum(light.needed, visible.needed)


def with_layers(
    attributes: SurfaceAttributes, light: SplatLight, centers: Float[Array, "3 splats"]
) -> SurfaceAttributes:
    """Add the layers of the splats to what passes 2 and 3 blend."""

    def prepared(layers):
        return tuple(layer and _diffusion.continue_from_splats(layer, centers) for layer in layers)

    return SurfaceAttributes(
        normals=attributes.normals,
        area=attributes.area,
        source=attributes.source,
        albedo=attributes.albedo,
        irradiance=attributes.irradiance,
        specular=attributes.specular,
        roughness=attributes.roughness,
        visibility=attributes.visibility,
        centers=centers,
        layers=prepared(light.layers),
        derivative=None if light.derivative is None else prepared(light.derivative),
        added_source=light.added_source,
        extra=attributes.extra,
    )


def read_places(
    visible: _splatting.VisibleSurfaces, like: SurfaceAttributes, read: Read[Values], *more: PyTree
) -> Values:
    """Blend the sums of every place, a chunk of places at a time, and read the samples.

    **Arguments:**

    - `like`: the attributes whose rows were summed.
    - `read`: of the samples, and of `more`.
    - `more`: arrays `[places, rows, pixels]`, given to `read` as `[rows, points]`.

    **Returns:** for each array `[*rows, points]` that `read` returns, `[places, rows, pixels]`.
    """
    like = jax.eval_shape(lambda: like)

    def chunk(rows, tiles, *more):
        surface = _splatting.Surface.of(rows, visible.view)
        places, pixels = surface.depth.shape

        def in_a_row(values: Float[Array, "places rows pixels"]) -> Float[Array, "rows points"]:
            return jnp.moveaxis(values, 1, 0).reshape(values.shape[1], -1)

        attributes = split_rows(in_a_row(surface.attributes), like)
        samples = SurfaceSamples(
            attributes=attributes,
            positions=in_a_row(visible.points(tiles, surface.depth)),
            depth=surface.depth.reshape(-1),
            covered=surface.covered.reshape(-1),
            layers=(),
            derivative=None,
        )

        def by_place(values: Float[Array, "*rows points"]) -> Float[Array, "places _ pixels"]:
            return jnp.moveaxis(values.reshape(-1, places, pixels), 1, 0)

        return jax.tree.map(by_place, read(samples, *map(in_a_row, more)))

    return map_chunks(chunk, visible.rows, visible.tiles, *more, at_once=_splatting.TILES_AT_ONCE)
