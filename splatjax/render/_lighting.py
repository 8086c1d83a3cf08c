"""Where the light that enters the surface is found: at the splats, or at what the pixels see of
them.
"""

import abc

import equinox as eqx
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, shading as _shading
from splatjax.scene import Material, Scene, StackedLights


class LightOnSplats(eqx.Module):
    """Pass 1: what of each light reaches each splat."""

    groups: list[StackedLights]
    shares: list[Float[Array, "_lights splats"] | None]
    """Per group of lights; `None` for lights that cast no shadows."""
    needed: Float[Array, ""]


class EnteringLight(eqx.Module):
    """What the light leaves below the surface of each splat, or of each point that a pixel sees."""

    irradiance: Float[Array, "channels points"]
    """That enters the surface."""
    source: Float[Array, "channels points"]
    """That spreads: times the root of the albedo."""


def entering_light(
    material: Material,
    light: LightOnSplats,
    points: Float[Array, "points 3"],
    normals: Float[Array, "points 3"],
    albedo: Float[Array, "points channels"] | None,
    specular: Float[Array, " points"] | Float[Array, ""],
    roughness: Float[Array, " points"] | Float[Array, ""],
) -> EnteringLight:
    """Give the light that enters at points of the surface.

    **Arguments:**

    - `light`: with the shares that reach these points.
    - `normals`: unit.
    """
    f0 = _shading.fresnel_f0(material.eta)

    def entering(cosine):
        share = 1 - _shading.directional_albedo(cosine, f0, specular, roughness)
        return (
            share[None]
            if material.single_scattering is None
            else share[None] * material.diffuse_fraction(cosine).T
        )

    channels = material.gaussians.weights.shape[1]
    irradiance = _diffusion.entering_irradiance(
        points, normals, light.groups, light.shares, entering, channels
    )
    return EnteringLight(
        irradiance, irradiance if albedo is None else irradiance * _shading.albedo_root(albedo).T
    )


def let_light_in(scene: Scene, light: LightOnSplats) -> EnteringLight:
    """The irradiance that enters at every splat."""
    splats = scene.splats
    specular, roughness = surface_parameters(scene)
    return entering_light(
        scene.material, light, splats.centers, splats.normals, splats.albedo, specular, roughness
    )


def surface_parameters(scene: Scene):
    """The material's specular strength and roughness, times the splats' own."""
    splats, material = scene.splats, scene.material
    specular = material.specular if splats.specular is None else material.specular * splats.specular
    roughness = (
        material.roughness if splats.roughness is None else material.roughness * splats.roughness
    )
    return specular, roughness


def surface_attributes(
    scene: Scene, light: LightOnSplats, entering: EnteringLight
) -> dict[str, Float[Array, "_rows splats"]]:
    """What passes 2 and 3 blend for the passes that follow, by name."""
    splats = scene.splats
    specular, roughness = surface_parameters(scene)
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


class AbstractLighting(eqx.Module):
    """What splats carry into the picture, and what pixels make of it before light spreads and is
    shaded.
    """

    def attributes(
        self, scene: Scene, light: LightOnSplats, entering: EnteringLight
    ) -> dict[str, Float[Array, "_rows splats"]]:
        """Give what passes 2 and 3 blend, by name: `surface_attributes`, or more."""
        return surface_attributes(scene, light, entering)

    @abc.abstractmethod
    def at_pixels(
        self,
        scene: Scene,
        groups: list[StackedLights],
        points: Float[Array, "tiles 3 pixels"],
        named: dict[str, Float[Array, "tiles _rows pixels"]],
    ) -> dict[str, Float[Array, "tiles _rows pixels"]]:
        """Give what passes 4 and 5 read, from what was blended at the points (mm) that the pixels
        see.

        They read the names of `surface_attributes`; normals need not be unit.
        """


class LightAtSplats(AbstractLighting):
    """The irradiance of the splats, blended like all they carry: what spreads below a pixel is what
    enters the splats there.
    """

    def at_pixels(self, scene, groups, points, named):
        return named
