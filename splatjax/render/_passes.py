"""The five passes. Pictures differ in the values read from the surface samples, and devices in the
combination of partial results. The formulas of the passes are in splatting, diffusion and shading.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from splatjax import diffusion as _diffusion, shading as _shading, splatting as _splatting
from splatjax._chunking import Result, map_chunks, split_rows, stack_rows, take_points
from splatjax._combination import DeviceMesh
from splatjax.scene import Scene, stack_lights

from ._lighting import (
    Irradiance,
    LightVisibility,
    Transfer,
    beams_at_splats,
    cast_shadows,
    irradiance_at_splats,
    source_derivative,
)
from ._plan import Plan
from ._settings import RenderSettings
from ._surface import (
    ShadedSurface,
    SurfaceAttributes,
    SurfaceSamples,
    map_places,
    shade,
    surface_parameters,
)


class SplatLight(eqx.Module):
    """Passes 1 and 4 on the splats, which do not depend on the camera.

    **Attributes:** along the splats, in the order of the plan

    - `visibility`: for each kind of lights the visibility of each sample.
    - `irradiance`: the irradiance that enters, and the part that spreads.
    - `layers`: the layers of pass 4.
    - `derivative`: derivative of the layers with respect to the logarithms of their variances;
      `None` if not requested.
    - `added_source`: the derivative of the spreading irradiance with respect to a weight of the
      Gaussians; `None` if it is zero. Its layers follow the layers of the irradiance, channel by
      channel.
    - `needed`: needed capacity divided by planned capacity.
    - `solved`: the state of a diffuser that solves for the light, along all splats; otherwise
      `None`.
    """

    visibility: list[Float[Array, "_samples splats"] | None]
    irradiance: Irradiance
    layers: _diffusion.LayerValues
    derivative: _diffusion.LayerValues | None
    added_source: Float[Array, "channels splats"] | None
    needed: Float[Array, ""]
    solved: PyTree | None = None

    def take(self, chosen: Int[Array, " chosen"] | None) -> "SplatLight":
        """Return the light of some splats; of all for `None`."""
        taken = jax.tree.map(
            lambda leaf: take_points(leaf, chosen) if leaf.ndim else leaf,
            dataclasses.replace(self, solved=None),
        )
        return dataclasses.replace(taken, solved=self.solved)


class Passes(eqx.Module):
    """The passes over the splats of one device.

    **Attributes:**

    - `scene`: the scene, with its splats in the order of the plan.
    - `combination`: combines the partial results of all devices.
    """

    scene: Scene
    settings: RenderSettings
    plan: Plan
    combination: DeviceMesh

    def visibility(self) -> LightVisibility:
        """Render the shadow maps and look up the splats in them (pass 1)."""
        return cast_shadows(
            self.scene, self.plan.shadows, self.settings.splatting, self.combination
        )

    def light(
        self,
        at: Int[Array, " chosen"] | None = None,
        *,
        kept: SplatLight | Transfer | None = None,
        derivative: bool = False,
    ) -> SplatLight:
        """Compute the light at the splats, and diffuse their irradiance: passes 1 and 4.

        **Arguments:**

        - `at`: the splats whose light is returned, in ascending order; all for `None`.
        - `kept`: a precomputed result, which replaces both passes or pass 1.
        - `derivative`: also differentiate the layers in the material's Gaussians.
        """
        if isinstance(kept, SplatLight):
            return kept.take(at)
        splats, material = self.scene.splats, self.scene.material
        light = (
            self.visibility()
            if kept is None
            else LightVisibility(stack_lights(self.scene.lights), kept.visibility, kept.needed)
        )
        irradiance, bounced, beams, bounce_needed = self.irradiance(light)
        source, added, slopes, solved = irradiance.source, None, None, None
        kernel, combination = self.settings.kernel, self.combination
        if derivative:
            if material.single_scattering is not None:
                added = source_derivative(self.scene, light)
                source = jnp.concatenate([source, added])
            sources = _diffusion.Sources.of(splats, source)
            diffused, differentiated = self.plan.diffusion.diffuse_with_derivative(
                sources, material.gaussians.variances, kernel, combination, at
            )
            slopes = differentiated.layers
        else:
            diffused, solved = self.plan.diffusion.light(
                splats, material, source, beams, kernel, combination, at, bounced
            )
        needed = jnp.maximum(light.needed, jnp.maximum(bounce_needed, diffused.needed))
        visibility, irradiance, added = jax.tree.map(
            partial(take_points, chosen=at), (light.visibility, irradiance, added)
        )
        return SplatLight(visibility, irradiance, diffused.layers, slopes, added, needed, solved)

    def irradiance(
        self, light: LightVisibility
    ) -> tuple[
        Irradiance,
        Float[Array, "channels splats"] | None,
        Callable[[], _diffusion.Beams],
        Float[Array, ""],
    ]:
        r"""Compute the light that enters every splat, directly from the lights and after bounces,

            E_n = E_0 + t F M(E_(n - 1))

        where `M(E)` is the radiant exitance of diffused light, `F M` the irradiance that the body
        receives from itself, and t the fraction of it that enters. Light that scatters once is
        treated as diffused.

        **Returns:** the irradiance; the part of its source that has bounced, `None` without
        bounces; the beams of `E_0`, for `AbstractDiffusionPlan.light`; and the capacity needed of
        pass 4.
        """
        direct = irradiance_at_splats(self.scene, light)
        beams = partial(beams_at_splats, self.scene, light, direct)
        none = jnp.zeros((), direct.entering.dtype)
        if not self.settings.bounces:
            return direct, None, beams, none
        sightlines, material = self.plan.sightlines, self.scene.material
        if sightlines is None:
            raise ValueError(
                f"settings.bounces is {self.settings.bounces}, and the plan was made with 0; "
                "make it with the same settings"
            )
        # The first splat of each group of this device.
        at = jnp.arange(len(sightlines.seen), dtype=jnp.int32) * sightlines.size
        summed = _diffusion.ExitancePlan.of(self.plan.diffusion, self.plan.interval)
        splats, albedo, kernel = self.scene.splats, self.scene.splats.albedo, self.settings.kernel
        root = jnp.ones_like(direct.source) if albedo is None else _shading.albedo_root(albedo.T)
        _, roughness = surface_parameters(material, splats)
        enters = _shading.average_transmission(
            _shading.fresnel_f0(material.eta), roughness, material.angular_law()
        ).reshape(material.channels, -1)
        # The Gaussians are scaled to represent light that scatters once too: direct light before
        # each bounce, bounced light where it enters.
        total, diffused = material.total_reflectance(), material.gaussians.total_reflectance()
        with_single = (total / jnp.where(diffused > 0, diffused, 1.0))[:, None]

        def bounce(so_far, _):
            bounced, needed = so_far
            source = (with_single * direct.entering + bounced) * root
            diffused, _ = summed.light(
                splats, material, source, beams, kernel, self.combination, at, bounced * root
            )
            received = sightlines.irradiance(
                root[:, at] * diffused.layers.values[0], splats.normals, self.combination
            )
            return (with_single * enters * received, jnp.maximum(needed, diffused.needed)), None

        (bounced, needed), _ = jax.lax.scan(
            bounce, (jnp.zeros_like(direct.entering), none), None, length=self.settings.bounces
        )
        # The root of a missing albedo is one.
        entering = direct.entering + bounced
        return Irradiance(entering, entering * root), bounced * root, beams, needed

    def picture(
        self,
        view: _splatting.PerspectiveView,
        light_at: Callable[[Int[Array, " chosen"]], SplatLight],
        read: Callable[[ShadedSurface, _diffusion.LayersAtPoints, SurfaceSamples], Result],
    ) -> tuple[Result, _splatting.VisibleSurfaces]:
        """Run all passes: light the splats, find and shade the visible surface, and read the
        results.

        **Arguments:**

        - `light_at`: passes 1 and 4, for the splats that the camera may see: `light`.
        - `read`: computes the results of a picture from shaded points, pointwise along the last
          axis.

        **Returns:** the results of each place, and the visible surfaces, whose `needed` covers all
        passes.
        """
        scene, settings, plan = self.scene, self.settings, self.plan
        groups = stack_lights(scene.lights)
        chosen, chosen_needed = plan.raster.choose(scene.splats, view)
        light = light_at(chosen)

        # Passes 2 and 3: blend the attributes and layers of the splats that may be visible.
        splats = scene.splats.take(chosen)
        shown = plan.diffusion.shown(Scene(splats, scene.lights, scene.material))
        layers = plan.diffusion.towards(
            view.position, scene.splats, scene.material, light.layers, light.solved, chosen
        )
        attributes = settings.lighting.attributes(
            shown,
            LightVisibility(groups, light.visibility, light.needed),
            light.irradiance,
            view.position,
        )
        origin = _splatting.Bounds.of(scene.splats, self.combination).center[:, None]
        origin = jax.lax.stop_gradient(origin)
        centers = splats.centers.T - origin
        derivative = light.derivative and _diffusion.continue_from_splats(light.derivative, centers)
        attributes = dataclasses.replace(attributes, added_source=light.added_source)
        rows = attributes, (centers, _diffusion.continue_from_splats(layers, centers), derivative)
        visible = _splatting.visible_surfaces(
            splats, stack_rows(rows), view, plan.splatting, plan.raster, self.combination
        )

        needed = self.combination.largest([jnp.maximum(chosen_needed, light.needed)])
        visible = dataclasses.replace(visible, needed=jnp.maximum(needed, visible.needed))

        # Pass 5: shade the visible points.
        def shade_and_read(samples: SurfaceSamples) -> Result:
            shaded, layers = shade(
                shown,
                view.position,
                groups,
                samples,
                settings.lighting.at_pixels(scene, groups, samples),
                plan.diffusion.gaussians,
                plan.interval,
                settings.kernel,
            )
            return read(shaded, layers, samples)

        sample = partial(sample_surfaces, visible, rows, origin)

        # A separate call materializes the samples; the chunks bound how many are in memory.
        def sample_and_read(sums, tiles) -> Result:
            samples = map_chunks(sample, sums, tiles, at_once=_splatting.TILES_AT_ONCE)
            return map_places(shade_and_read, samples)

        values = map_chunks(
            sample_and_read,
            visible.sums,
            visible.tiles,
            at_once=2 * _splatting.TILES_AT_ONCE,
            used=visible.tiles < visible.grid.count,
        )
        return self.combination.gather(values), visible.gathered(self.combination)


def sample_surfaces(
    visible: _splatting.VisibleSurfaces,
    like: tuple[SurfaceAttributes, tuple | None],
    origin: Float[Array, "3 1"],
    sums: _splatting.PixelSums,
    tiles: Int[Array, " places"],
) -> SurfaceSamples:
    """Blend the sums of some places, and continue the layers of the splats to the visible points.

    **Arguments:**

    - `visible`: the visible surfaces of all places.
    - `like`: the attributes whose rows were summed; and, of the splats, centers, layers as
      `continue_from_splats` prepares them, and derivative, or `None` without layers.
    - `origin`: the origin of the splats' centers among the attributes.
    - `sums`, `tiles`: the entries of `visible` for these places.
    """
    surface = _splatting.Surface.of(sums, visible.view, visible.needed)

    # Place by place, as the sums are in memory.
    @jax.vmap
    def of_place(rows, positions, depth, covered) -> SurfaceSamples:
        attributes, of_layers = split_rows(rows, like)
        layers, derivative = jnp.zeros((0, 1, len(depth)), depth.dtype), None
        if of_layers is not None:
            centers, layers, derivative = of_layers
            layers, derivative = _diffusion.continue_to_points(
                layers, derivative, centers, positions - origin, len(attributes.source)
            )
        return SurfaceSamples(attributes, positions, depth, covered, layers, derivative)

    x, y = (index.astype(origin.dtype) + 0.5 for index in visible.grid.columns_and_rows(tiles))
    positions = jnp.moveaxis(visible.view.unproject(x, y, surface.depth), 0, 1)
    return of_place(surface.attributes, positions, surface.depth, surface.covered)
