"""`splatjax studio`: a scene in the browser, to turn and to change."""

import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

import splatjax as sj
from splatjax.studio import Page, Session, check_viser

from ._terminal import OptionalPath, check_folder
from ._view import ENVIRONMENTS, ViewOptions

_DIRECTIONS = 64  # of the shadows of an environment


@dataclass(frozen=True, kw_only=True)
class Studio(ViewOptions):
    """Open a page in the browser on which splats, or the built-in bust, can be turned and changed.

    It needs viser, the extra `studio` of splatjax. The command prints the address of the page;
    Ctrl-C ends it. Sliders change the coefficients of a material that has a [medium]. The page
    saves the material, pictures, and the program that renders a picture.

    Example: splatjax studio --material marble --no-albedo --scale 0.2
    """

    #: The folder for saved files. It is created if its parent exists.
    output: Path = Path("studio")
    #: Number of splats of the built-in bust.
    count: int = 100_000
    #: TOML file that lists pictures, as for `splatjax recover`: the page takes the camera and the
    #: lights of the first, and offers to recover the material.
    pictures: OptionalPath = None
    #: The address to listen at. At any address except 127.0.0.1, other computers that reach it can
    #: change the scene and save files.
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    #: The port to listen at; if it is in use, the next free one.
    port: int = 8080

    def run(self) -> None:
        self.check({"port": (1 <= self.port <= 65_535, "lie between 1 and 65535")})
        check_folder(self.output)
        check_viser()
        if self.splats is not None and self.splats.suffix in (".toml", ".exr"):
            raise ValueError(f"{self.splats} is a scene; the studio takes splats (PLY) and options")
        splats, material = self.load()
        middle = (splats.centers.min(axis=0) + splats.centers.max(axis=0)) / 2
        observations = [] if self.pictures is None else sj.io.read_observations(self.pictures)
        if observations:
            camera, lights = observations[0].camera, observations[0].lights
            along = (middle - camera.position) @ camera.rotation[2]
            middle = camera.position + along * camera.rotation[2]
        else:
            camera, lights = self.camera(lambda: [splats], self.azimuth), self._lights(material)
        scene = sj.Scene(splats, lights, material)
        session = Session(scene, camera, middle, exposure=self.exposure)
        recipe = self._recipe(session.own.lights)
        place = {"host": self.host, "port": self.port}
        page = Page(session, self.output, recipe, observations=observations, **place)
        print(page.url, flush=True)
        try:
            threading.Event().wait()
        finally:
            page.close()

    def _lights(self, material: sj.Material) -> list[sj.scene.AbstractLight]:
        lights = self.lights(material, self.azimuth, self.single_light[0])
        directions = sj.scene.even_directions(_DIRECTIONS)
        return [
            replace(light, directions=directions)
            if isinstance(light, sj.EnvironmentLight)
            else light
            for light in lights
        ]

    def _recipe(self, lights: tuple[sj.scene.AbstractLight, ...]) -> dict[str, str]:
        """Return expressions that make the splats and the lights."""
        path = self.splats and str(self.splats.absolute())
        splats = f"sj.read_splats({path!r}, up={self.up!r})" if path else f"sj.bust({self.count})"
        splats = splats if self.scale == 1 else f"{splats}.scaled({self.scale})"
        splats = splats if self.albedo else f"{splats}.without_maps()"
        if self.pictures is None:
            return {"splats": splats, "lights": f"[{', '.join(map(self._made, lights))}]"}
        pictures = str(self.pictures.absolute())
        return {"splats": splats, "lights": f"sj.io.read_observations({pictures!r})[0].lights"}

    def _made(self, light: sj.scene.AbstractLight) -> str:
        if isinstance(light, sj.DirectionalLight):
            arguments = ", ".join(
                str(sj.exports.plain_numbers(each)) for each in (light.direction, light.irradiance)
            )
            return f"sj.DirectionalLight({arguments}, cast_shadows={light.cast_shadows})"
        assert isinstance(light, sj.EnvironmentLight)
        name = self.environment_name or ""
        image = f"sj.io.load_environment({str(Path(name).absolute())!r}).image"
        if name in ENVIRONMENTS:
            image = f"sj.scene.{ENVIRONMENTS[name].__name__}()"
        directions = f"sj.scene.even_directions({_DIRECTIONS})"
        return f"sj.EnvironmentLight({image}, {float(light.rotation)}, directions={directions})"
