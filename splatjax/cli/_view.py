"""Options shared by the commands for pictures and the studio: splats, camera and lights."""

import functools
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import splatjax as sj
from splatjax._memory import check_memory
from splatjax.render import BYTES_PER_PIXEL, BYTES_PER_SPLAT

from ._scene import direction_to, is_scene
from ._terminal import (
    OptionalFloat,
    Rules,
    UpAxis,
    check_options,
    check_unused,
    note,
    stage,
)

# Degrees. The fill is beside the camera, on the side away from the light.
_FILL_SIDE, _FILL_ELEVATION = 25.0, 10.0
_WHITE = 0.995  # least reflectance of a material that counts as white
# Options of the single light, and their defaults if another of them is given.
_SINGLE_LIGHT = {"light_azimuth": -20.0, "light_elevation": 30.0, "fill": 0.1}
# Options that are allowed with a scene file.
_BESIDE_SCENES = {
    *("splats", "output", "background", "exposure", "illuminant", "half", "quiet", "host", "port")
}


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Splats of one material, a camera that shows all of them, and lights."""

    #: PLY or SPZ file of splats, in mm (`splatjax sample` writes one), scene in a TOML file, or EXR
    #: file of a picture. Default: the built-in bust.
    splats: Annotated[
        tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[SPLATS]", help_behavior_hint="")
    ] = None
    #: The file or folder to write.
    output: Path
    #: Name of a material (`splatjax materials`), or path of a TOML file.
    material: Annotated[str, tyro.conf.arg(metavar="MATERIAL")] = "skin"
    #: Width of the picture, pixels.
    width: int = 512
    #: Height of the picture, pixels.
    height: int = 512
    #: Azimuth of the camera around the center of the splats, degrees.
    azimuth: float = 25.0
    #: Elevation of the camera, degrees, between -90 and 90, both excluded.
    elevation: float = 0.0
    #: Vertical field of view, degrees.
    fov: float = 25.0
    #: Azimuth of a single light that replaces the studio, degrees; beyond 90 it is behind the body.
    #: Default with another option of the single light: -20.
    light_azimuth: OptionalFloat = None
    #: Elevation of the single light, degrees. Default with another option of the single light: 30.
    light_elevation: OptionalFloat = None
    #: Strength of a shadowless fill light beside the camera, relative to the single light. Default
    #: with another option of the single light: 0.1.
    fill: OptionalFloat = None
    #: Latitude-longitude map of linear radiance that replaces single lights: an EXR or HDR file, or
    #: the name of a built-in map (studio, overcast, sun). Default without single lights: studio.
    environment: Annotated[str | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="")] = None
    #: Rotation of the environment about the vertical axis, degrees; at 0 the middle of the map is
    #: in front (+z).
    environment_rotation: float = 0.0
    #: Exposure of the PNG in stops; each stop doubles the brightness. The EXR is not affected.
    exposure: float = 0.0
    #: Let light spread below the surface. Without scattering, light leaves where it enters.
    scattering: bool = True
    #: Model of the light below the surface: the profile of a flat surface (clusters); the same
    #: faster, with only the sum of the layers in the EXR (exitance); or the diffusion equation in a
    #: closed body, with the coefficients of the material (shape).
    diffusion: Literal["clusters", "exitance", "shape"] = "clusters"
    #: Number of times that light may leave the body and enter it again; 1 or 2 brighten folds.
    bounces: int = 0
    #: Use the maps of the splats (on the bust, skin). Without maps, only the material is visible.
    albedo: bool = True
    #: Number of splats of the built-in bust.
    count: int = 200_000
    #: Scale of the body: at 0.2 the bust is 7 cm tall, and light travels five times as far relative
    #: to its size.
    scale: float = 1.0
    #: Upward axis of the PLY file.
    up: UpAxis = "y"
    #: Print only written files and errors.
    quiet: bool = False

    illuminant = "D65"  # an option of pictures only

    def check(self, more_rules: Rules | None = None) -> None:
        """Raise `ValueError` for invalid options, for a material that a PNG file cannot show, and
        for too little memory.
        """
        finite, positive = "be a finite number", "be 1 or more"
        azimuth, elevation, fill = self.single_light
        if self.splats is not None:
            check_unused(self, ["count"], f"the splats are those of {self.splats}")
        if self.environment is not None:
            check_unused(self, _SINGLE_LIGHT, "--environment replaces the single light")
        if self.environment_name is None:
            check_unused(self, ["environment_rotation"], "single lights replace the environment")
        if self.splats is None and getattr(self, "camera_file", None) is None:
            check_unused(self, ["up"], "there are no SPLATS and no --camera")
        source = "material" if self.table is None else "splats"
        material = sj.load_material(self.material_source)
        is_spectral = material.wavelengths is not None
        rules: Rules = {
            "fill": (0 <= fill < math.inf, "be 0 or more"),
            "scale": (0 < self.scale < math.inf, "be a positive factor"),
            "azimuth": (math.isfinite(self.azimuth), finite),
            "light_azimuth": (math.isfinite(azimuth), finite),
            "light_elevation": (math.isfinite(elevation), finite),
            "environment_rotation": (math.isfinite(self.environment_rotation), finite),
            "exposure": (math.isfinite(self.exposure), finite),
            "width": (self.width >= 1, positive),
            "height": (self.height >= 1, positive),
            "count": (self.count >= 1, positive),
            "fov": (0 < self.fov < 180, "lie between 0 and 180 degrees, both excluded"),
            "elevation": (
                -90 < self.elevation < 90,
                "lie between -90 and 90 degrees, both excluded",
            ),
            "bounces": (self.bounces >= 0, "be 0 or more"),
            "diffusion": (
                self.diffusion != "shape" or (self.scattering and material.medium is not None),
                f"be clusters without scattering, or if {self.material} has no [medium]",
            ),
            source: (
                is_spectral or material.channels in (1, 3),
                "have colors for a PNG file: 1 or 3 channels, or `wavelengths` (nm) in the file of "
                f"the material; it has {material.channels} channels",
            ),
            "illuminant": (
                is_spectral or self.illuminant == "D65",
                f"be left out, because {getattr(self, source)} has no wavelengths",
            ),
        }
        check_options(self, rules | (more_rules or {}))
        # Raise an error for an unknown illuminant.
        sj.io.picture_to_rgb(np.zeros(material.channels), material.wavelengths, self.illuminant)
        _ = self._environment  # read the file before any computation
        count = 0 if self.splats else self.count
        check_memory(
            f"--width {self.width} --height {self.height}{f' --count {count}' if count else ''}",
            BYTES_PER_SPLAT * count + BYTES_PER_PIXEL * self.width * self.height,
            "take fewer pixels or splats",
        )

    @property
    def single_light(self) -> tuple[float, ...]:
        """Return the azimuth and elevation of the single light, and the strength of the fill."""
        return tuple(
            usual if (chosen := getattr(self, name)) is None else chosen
            for name, usual in _SINGLE_LIGHT.items()
        )

    @property
    def environment_name(self) -> str | None:
        """Return the name of the environment, by default the studio; `None` for single lights."""
        is_lit = any(getattr(self, name) is not None for name in _SINGLE_LIGHT)
        return self.environment or (None if is_lit else "studio")

    @property
    def count_option(self) -> str:
        """Return what sets the number of splats."""
        of_file = "`count` of the scene" if self.table else "splatjax sample --count"
        return of_file if self.splats else "--count"

    @functools.cached_property
    def _environment(self) -> sj.EnvironmentLight | None:
        name = self.environment_name
        if name in sj.io.ENVIRONMENTS:
            return sj.EnvironmentLight(sj.io.ENVIRONMENTS[name]())
        check_options(
            self,
            {
                "environment": (
                    not name or Path(name).is_file(),
                    f"be the path of a file, or one of {', '.join(sj.io.ENVIRONMENTS)}",
                )
            },
        )
        return sj.io.load_environment(name) if name else None

    @property
    def settings(self) -> sj.RenderSettings:
        return sj.RenderSettings(bounces=self.bounces, diffuser=sj.io.DIFFUSERS[self.diffusion])

    @functools.cached_property
    def table(self) -> Any:
        """Return the contents of a file that describes the whole scene, or `None`."""
        if self.splats is None or not is_scene(self.splats):
            return None
        reason = f"{self.splats} describes the whole scene (change it there)"
        check_unused(self, vars(self).keys() - _BESIDE_SCENES, reason)
        return sj.io.scene_table(self.splats)

    @property
    def material_source(self) -> Any:
        """Return the name, path or tables of the material."""
        return self.material if self.table is None else sj.io.material_of_scene(self.table)

    def open(self) -> tuple[sj.Scene, sj.Camera, sj.RenderSettings]:
        """Return scene, camera and settings of a scene file, or of the options with a camera that
        shows all splats.
        """
        if self.table is not None:
            with stage(f"loading {self.splats}"):
                return sj.io.load_scene(self.table.path)
        splats, material = self.load()
        lights = self.lights(material, self.azimuth, self.single_light[0])
        camera = self.camera(lambda: [splats], self.azimuth)
        return sj.Scene(splats, lights, material), camera, self.settings

    def load(self) -> tuple[sj.Splats, sj.Material]:
        """Return the splats and the material for rendering them."""
        with stage(
            f"reading {self.splats}" if self.splats else f"making the bust of {self.count} splats"
        ):
            splats = self.adjusted(
                sj.read_splats(self.splats, up=self.up) if self.splats else sj.bust(self.count)
            )
        return splats, self.material_for(splats)

    def material_for(self, splats: sj.Splats) -> sj.Material:
        material = sj.load_material(self.material)
        check_options(
            self,
            {
                "diffusion": (
                    self.diffusion != "shape" or splats.albedo is None,
                    "come with --no-albedo, because the material gives the color",
                ),
                "albedo": (
                    material.wavelengths is None or splats.albedo is None,
                    f"be left out (--no-albedo), because {self.material} has wavelengths instead "
                    "of red, green and blue",
                ),
            },
        )
        is_white = float(material.total_reflectance().min()) > _WHITE
        if splats.albedo is not None:
            material = material.white()
            if self.scattering:
                note(
                    f"the color is the albedo of the splats, and {self.material} only spreads the "
                    f"light{'' if is_white else '; --no-albedo gives the color of the material'}"
                )
        elif is_white:
            note(
                f"{self.material} has no color, and the splats have no albedo, so the body "
                "is white; give --material skin_light, skin1 or marble (`splatjax materials` "
                "lists more), or splats with albedo"
            )
        if material.channels == 1:  # equal weights for red, green and blue
            tiled = jax.tree.map(lambda leaf: jnp.tile(leaf, 3) if leaf.ndim else leaf, material)
            gaussians = replace(tiled.gaussians, variances=material.gaussians.variances)
            material = replace(tiled, gaussians=gaussians, wavelengths=None)
        return material if self.scattering else material.opaque()

    def adjusted(self, splats: sj.Splats) -> sj.Splats:
        """Scale splats and keep or remove their maps, as the options specify."""
        splats = splats if self.scale == 1 else splats.scaled(self.scale)
        return splats if self.albedo else splats.without_maps()

    def lights(
        self, material: sj.Material, azimuth: float, light_azimuth: float
    ) -> tuple[sj.scene.AbstractLight, ...]:
        """Return the single light and the fill, in the channels of a material, or the environment,
        which turns with the light. The fill is always on the same side of the camera.
        """
        first_azimuth, elevation, fill = self.single_light
        if self._environment is not None:
            rotation = self.environment_rotation + light_azimuth - first_azimuth
            image, is_rgb = self._environment.image, material.wavelengths is None
            image = image if is_rgb else image.mean(axis=-1, keepdims=True)
            return (sj.EnvironmentLight(image, rotation),)
        # A white diffuser that faces the first light has radiance 1.
        irradiance = np.full(material.channels, np.pi)
        light = sj.DirectionalLight(-direction_to(light_azimuth, elevation), irradiance)
        side = math.copysign(_FILL_SIDE, math.remainder(self.azimuth - first_azimuth, 360))
        if not fill:
            return (light,)
        beside = -direction_to(azimuth + side, _FILL_ELEVATION)
        return light, sj.DirectionalLight(beside, fill * irradiance, cast_shadows=False)

    def camera(self, parts: sj.scene.Parts, azimuth: float) -> sj.Camera:
        """Place a camera at an azimuth so that the bounding sphere of the splats, given in parts,
        just fits the shorter side of the picture.
        """
        bodies = (np.asarray(part.centers) for part in parts())
        corners = [bound(body, axis=0) for body in bodies for bound in (np.min, np.max)]
        middle = (np.min(corners, axis=0) + np.max(corners, axis=0)) / 2
        reaches = [
            np.linalg.norm(np.asarray(part.centers) - middle, axis=1) + np.asarray(part.radii)
            for part in parts()
        ]
        radius = float(max(np.max(reach) for reach in reaches))
        narrower = min(1.0, self.width / self.height)
        half_angle = math.atan(math.tan(math.radians(self.fov) / 2) * narrower)
        eye = middle + radius / math.sin(half_angle) * direction_to(azimuth, self.elevation)
        return sj.Camera.look_at(eye, middle, fov=self.fov, width=self.width, height=self.height)
