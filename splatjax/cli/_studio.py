"""`splatjax studio`: view and change a scene in the browser."""

import threading
import tomllib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import splatjax as sj
from splatjax.studio import Page, Session

from ._scene import scene_contents
from ._terminal import OptionalPath, check_folder
from ._view import ViewOptions


@dataclass(frozen=True, kw_only=True)
class Studio(ViewOptions):
    """Open a page in the browser to view and change splats, the built-in bust, or a scene.

    The command needs viser, the extra `studio` of splatjax. It prints the address of the page;
    Ctrl-C ends it. Sliders change the coefficients of a material that has a [medium]. The page
    saves pictures, the material, and the scene, which `splatjax render` and the studio can open. A
    scene is a TOML file with body, material, lights and camera, or a picture of `splatjax render`.

    Examples: splatjax studio --material marble --no-albedo --scale 0.2
              splatjax studio scene.toml
    """

    #: The folder for saved files. It is created if its parent exists.
    output: Path = Path("studio")
    #: Number of splats of the built-in bust.
    count: int = 100_000
    #: TOML file that lists pictures, as for `splatjax recover`. The page uses the camera and the
    #: lights of the first picture, and offers to recover the material.
    pictures: OptionalPath = None
    #: The address to listen on. With any address except 127.0.0.1, other computers can change the
    #: scene and save files.
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    #: The port to listen on; if it is in use, the next free port is used.
    port: int = 8080

    def run(self) -> None:
        self.check({"port": (1 <= self.port <= 65_535, "lie between 1 and 65535")})
        check_folder(self.output)
        page = self.page()
        print(page.url, flush=True)
        try:
            threading.Event().wait()
        finally:
            page.close()

    def page(self) -> Page:
        """Open the page of the scene and return it."""
        observations, images = [], None
        if self.pictures is not None:
            observations, images = sj.io.read_observations(self.pictures), _images(self.pictures)
        scene, camera, settings = self.open()
        if observations:
            scene, camera = replace(scene, lights=observations[0].lights), observations[0].camera
        centers, forward = np.asarray(scene.splats.centers), camera.rotation[2]
        middle = (centers.min(axis=0) + centers.max(axis=0)) / 2
        target = camera.position + (middle - camera.position) @ forward * forward
        session = Session(
            scene,
            camera,
            target,
            settings,
            exposure=self.exposure,
            skin=sj.io.load_skin(self.material_source),
            g=sj.io.load_mean_cosine(self.material_source),
        )
        return Page(
            session,
            self.output,
            partial(scene_contents, self, settings, images=images),
            observations=observations,
            host=self.host,
            port=self.port,
        )


def _images(pictures: Path) -> list[str]:
    """List the images of the lights of the first picture in a file."""
    lights = tomllib.loads(pictures.read_text())["pictures"][0]["lights"]
    images = [light.get("image", "") for light in lights]
    return [name if name in sj.io.ENVIRONMENTS else str(pictures.parent / name) for name in images]
