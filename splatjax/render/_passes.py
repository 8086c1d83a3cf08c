"""The five passes. Pictures differ in the values read from the surface samples, and devices in the
combination of partial results. The formulas of the passes are in splatting, diffusion and shading.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree, Shaped

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax._chunking import Result, map_chunks, take_points
from splatjax._combination import AbstractCombination
from splatjax.scene import Camera, Scene, stack_lights

from ._attributes import SurfaceAttributes, SurfaceSamples, split_rows, stack_rows
from ._beams import beams_at_splats
from ._bounces import bounced_irradiance, diffuse_splats
from ._lighting import Irradiance, LightVisibility, cast_shadows, irradiance_at_splats
from ._plan import Plan
from ._settings import RenderSettings
from ._shade import ShadedSurface, shade


class Transfer(eqx.Module):
    """Visibility of each light sample from each splat: pass 1, which does not depend on the
    strength and color of a light.

    **Attributes:**

    - `visibility`: of each sample of lights of one kind, along the splats in the order of the plan;
      `None` for lights that cast no shadows.
    - `needed`: capacity needed over planned.
    """

    visibility: list[Float[Array, "_samples splats"] | None]
    needed: Float[Array, ""]


class SplatLight(eqx.Module):
    """Passes 1 and 4 on the splats, which do not depend on the camera.

    **Attributes:** along the splats, in the order of the plan

    - `visibility`: of each light.
    - `irradiance`: the irradiance that enters, and the part that spreads.
    - `layers`: of pass 4.
    - `derivative`: of the layers in the logarithms of their variances; `None` if not requested.
    - `added_source`: the derivative of the spreading irradiance in a weight of the Gaussians;
      `None` if it is zero. Its layers follow those of the irradiance, channel by channel.
    - `needed`: capacity needed over planned.
    - `solved`: the state of a diffuser that solves for the light, along all splats; otherwise
      `None`.
    """

    visibility: list[Float[Array, "_lights splats"] | None]
    irradiance: Irradiance
    layers: _diffusion.LayerValues
    derivative: _diffusion.LayerValues | None
    added_source: Float[Array, "channels splats"] | None
    needed: Float[Array, ""]
    solved: PyTree | None = None

    def take(self, chosen: Int[Array, " chosen"]) -> "SplatLight":
        """Return the light of some splats."""
        along = dataclasses.replace(self, solved=None)
        taken = jax.tree.map(lambda leaf: take_points(leaf, chosen) if leaf.ndim else leaf, along)
        return dataclasses.replace(taken, solved=self.solved)


def light_visibility(
    scene: Scene,
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    transfer: Transfer | None = None,
) -> LightVisibility:
    """Render the shadow maps and look up the splats in them (pass 1), or read a precomputed result.

    **Arguments:** as for `light_splats`.
    """
    if transfer is not None:
        return LightVisibility(stack_lights(scene.lights), transfer.visibility, transfer.needed)
    return cast_shadows(scene, plan.shadows, settings.splatting, combination)


def light_splats(
    scene: Scene,
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    at: Int[Array, " chosen"] | None = None,
    derivative: bool = False,
    transfer: Transfer | None = None,
) -> SplatLight:
    """Compute the light at the splats, and diffuse their irradiance: passes 1 and 4.

    **Arguments:**

    - `at`: the splats whose light is returned, in ascending order; all for `None`.
    - `derivative`: also differentiate the layers in the material's Gaussians.
    - `transfer`: replaces pass 1.
    """
    light = light_visibility(scene, settings, plan, combination, transfer)
    direct = irradiance_at_splats(scene, light)
    beams = partial(beams_at_splats, scene, light, direct)
    irradiance, bounced, bounce_needed = bounced_irradiance(
        scene, settings, plan, combination, direct, beams
    )
    added, solved, log_variance_derivative = None, None, None
    if derivative and scene.material.single_scattering is not None:
        irradiance, added = _differentiated_irradiance(scene, light)
    source = irradiance.source if added is None else jnp.concatenate([irradiance.source, added])
    if derivative:
        layers, log_variance_derivative, needed = diffuse_splats(
            scene, source, settings, plan, combination, at, derivative
        )
    else:
        given = scene.splats, scene.material, source, beams, settings.kernel, combination, at
        diffused, solved = plan.diffusion.light(*given, bounced)
        layers, needed = diffused.layers, diffused.needed
    needed = jnp.maximum(needed, jnp.maximum(light.needed, bounce_needed))
    along_splats = light.visibility, irradiance, added
    if at is not None:
        along_splats = jax.tree.map(partial(take_points, chosen=at), along_splats)
    visibility, irradiance, added = along_splats
    derivatives = log_variance_derivative, added
    return SplatLight(visibility, irradiance, layers, *derivatives, needed, solved)


def make_light_at(
    scene: Scene,
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    light: SplatLight | Transfer | None,
    derivative: bool = False,
) -> Callable[..., SplatLight]:
    """Return the function that computes passes 1 and 4 for `see_and_shade`, or reads a precomputed
    result.
    """
    if isinstance(light, SplatLight):
        return light.take
    return partial(
        light_splats, scene, settings, plan, combination, derivative=derivative, transfer=light
    )


def _differentiated_irradiance(
    scene: Scene, light: LightVisibility
) -> tuple[Irradiance, Float[Array, "channels splats"]]:
    """Compute the irradiance, and also differentiate the source in the weights.

    With single scattering, less light is left for the Gaussians at grazing angles. This depends
    only on the sum of the weights, so the derivative is taken in one weight.
    """
    weights = scene.material.gaussians.weights

    def irradiance(change: Float[Array, " channels"]):
        moved = weights.at[0].add(change)
        return irradiance_at_splats(
            eqx.tree_at(lambda s: s.material.gaussians.weights, scene, moved), light
        )

    zero, one = jnp.zeros_like(weights[0]), jnp.ones_like(weights[0])
    value, derivative = jax.jvp(irradiance, (zero,), (one,))
    return value, derivative.source


def see_and_shade(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    plan: Plan,
    combination: AbstractCombination,
    light_at: Callable[[Int[Array, " chosen"]], SplatLight],
    read: Callable[[ShadedSurface, _diffusion.LayersAtPoints, SurfaceSamples], Result],
) -> tuple[Result, _splatting.VisibleSurfaces]:
    """Run all passes: light the splats, find and shade the visible surface, and read the results.

    **Arguments:**

    - `light_at`: passes 1 and 4, for the splats that the camera may see: `make_light_at`.
    - `read`: computes the results of a picture from shaded points, pointwise along the last axis.

    **Returns:** the results for each place, and the places, with the capacity that all passes
    needed.
    """
    view, groups = _splatting.PerspectiveView.of(camera), stack_lights(scene.lights)
    chosen, chosen_needed = plan.raster.choose(scene.splats, view)
    light = light_at(chosen)

    # Passes 2 and 3: blend the attributes and layers of the splats that may be visible.
    splats = scene.splats.take(chosen)
    shown = Scene(splats, scene.lights, scene.material)
    layers = plan.diffusion.towards(
        camera.position, scene.splats, scene.material, light.layers, light.solved, chosen
    )
    visibility = LightVisibility(groups, light.visibility, light.needed)
    attributes = settings.lighting.attributes(shown, visibility, light.irradiance, view.position)
    bounds = _splatting.Bounds.of(scene.splats, combination)
    origin = jax.lax.stop_gradient(bounds.center)[:, None]
    centers = splats.centers.T - origin
    attributes = dataclasses.replace(
        attributes,
        centers=centers,
        layers=_diffusion.continue_from_splats(layers, centers),
        derivative=light.derivative and _diffusion.continue_from_splats(light.derivative, centers),
        added_source=light.added_source,
    )
    visible = _splatting.visible_surfaces(
        splats, stack_rows(attributes), view, settings.splatting, plan.raster, combination
    )

    needed = combination.largest([jnp.maximum(chosen_needed, light.needed)])
    visible = dataclasses.replace(visible, needed=jnp.maximum(needed, visible.needed))

    # Pass 5: shade the visible points.
    def shade_and_read(samples: SurfaceSamples) -> Result:
        samples = jax.tree.map(in_a_row, samples)
        planned = plan.diffusion.gaussians, plan.interval
        shaded, layers = shade(scene, view.position, groups, samples, *planned, settings)
        return read(shaded, layers, samples)

    sample = partial(sample_surfaces, visible, attributes, origin)

    # A separate call, so that samples are materialized; large chunks, so that few are at a time.
    def sample_and_read(sums, tiles) -> Result:
        return map_places(shade_and_read, map_places(sample, sums, tiles))

    at_once = 2 * _splatting.TILES_AT_ONCE
    values = map_chunks(sample_and_read, visible.sums, visible.tiles, at_once=at_once)
    return combination.gather(values), visible.gathered(combination)


def sample_surfaces(
    visible: _splatting.VisibleSurfaces,
    like: SurfaceAttributes,
    origin: Float[Array, "3 1"],
    sums: _splatting.PixelSums,
    tiles: Int[Array, " places"],
) -> SurfaceSamples:
    """Blend the sums of some places, and continue the layers of the splats to the visible points.

    **Arguments:**

    - `visible`: of all places.
    - `like`: the attributes whose rows were summed.
    - `origin`: of the splats' centers among the attributes.
    - `sums`, `tiles`: those of `visible`, of these places.
    """
    like = jax.eval_shape(lambda: like)
    surface = _splatting.Surface.of(sums, visible.view, visible.needed)
    attributes = split_rows(in_a_row(surface.attributes), like)
    positions = in_a_row(visible.points(tiles, surface.depth))

    layers, derivative = jnp.zeros((0, 1, positions.shape[1]), positions.dtype), None
    if attributes.layers is not None:
        layers, derivative = _diffusion.continue_to_points(
            attributes.layers,
            attributes.derivative,
            attributes.centers,
            positions - origin,
            len(attributes.source),
        )
    return SurfaceSamples(
        attributes=dataclasses.replace(attributes, centers=None, layers=None, derivative=None),
        positions=positions,
        depth=in_a_row(surface.depth),
        covered=in_a_row(surface.covered),
        layers=layers,
        derivative=derivative,
    )


def map_places(function: Callable[..., Result], *given: PyTree) -> Result:
    """Apply a pointwise function to chunks of places.

    **Arguments:**

    - `function`: returns arrays `[*rows, points]`, the pixels of its places in a row.
    - `given`: arrays along the places.

    **Returns:** the same arrays, `[places, *rows, pixels]`.
    """

    return map_chunks(
        lambda *given: jax.tree.map(_by_place, function(*given)),
        *given,
        at_once=_splatting.TILES_AT_ONCE,
    )


def in_a_row(values: Shaped[Array, "places *rows pixels"]) -> Shaped[Array, "*rows points"]:
    rows = jnp.moveaxis(values, 0, -2)
    return rows.reshape(*rows.shape[:-2], rows.shape[-2] * rows.shape[-1])


def _by_place(values: Shaped[Array, "*rows points"]) -> Shaped[Array, "places *rows pixels"]:
    pixels = _splatting.TILE_SIDE**2
    rows = values.reshape(*values.shape[:-1], values.shape[-1] // pixels, pixels)
    return jnp.moveaxis(rows, -2, 0)
