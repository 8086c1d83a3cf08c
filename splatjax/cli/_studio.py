"""`splatjax studio`: turn and change a scene in the browser."""

import threading
import tomllib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import numpy as np
import tyro

import splatjax as sj
from splatjax._records import check_installed
from splatjax.studio import AsFile, Page, Session

from ._scene import check_alone, is_scene, scene_of_file, scene_of_options
from ._terminal import OptionalPath, check_folder, stage
from ._view import ViewOptions

# Scene, camera, settings, the source of the material, and the function for the scene's file.
Opened: TypeAlias = tuple[sj.Scene, sj.Camera, sj.RenderSettings, Any, AsFile]


@dataclass(frozen=True, kw_only=True)
class Studio(ViewOptions):
    """Open a page in the browser on which splats, the built-in bust, or a scene can be turned and
    changed.

    It needs viser, the extra `studio` of splatjax. The command prints the address of the page;
    Ctrl-C ends it. Sliders change the coefficients of a material that has a [medium]. The page
    saves pictures, the material, and the scene, which `splatjax render` and the studio take. A
    scene is a TOML file of body, material, lights and camera, or a picture of `splatjax render`.

    Examples: splatjax studio --material marble --no-albedo --scale 0.2
              splatjax studio scene.toml
    """

    #: The folder for saved files. It is created if its parent exists.
    output: Path = Path("studio")
    #: Number of splats of the built-in bust.
    count: int = 100_000
    #: TOML file that lists pictures, as for `splatjax recover`: the page takes the camera and the
    #: lights of the first, and offers to recover the material.
    pictures: OptionalPath = None
    #: The address to listen on. On any address except 127.0.0.1, other computers that reach it can
    #: change the scene and save files.
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
        """Open the page of the scene, and return it."""
        check_installed("the page of the studio", "viser")
        observations = [] if self.pictures is None else sj.io.read_observations(self.pictures)
        if self.splats is not None and is_scene(self.splats):
            scene, camera, settings, material, as_file = self._of_file(self.splats)
        else:
            scene, camera, settings, material, as_file = self._of_options()
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
            skin=sj.io.load_skin(material),
            g=sj.io.load_mean_cosine(material),
        )
        return Page(
            session, self.output, as_file, observations=observations, host=self.host, port=self.port
        )

    def _of_options(self) -> Opened:
        scene, camera = self.scene_and_camera()
        images = self.environment_name or ""
        if self.pictures is not None:
            first = tomllib.loads(self.pictures.read_text())["pictures"][0]
            images = [light.get("image", "") for light in first["lights"]]
            images = [
                i if i in sj.io.ENVIRONMENTS else str(self.pictures.parent / i) for i in images
            ]
        as_file = partial(scene_of_options, self, images, self.settings)
        return scene, camera, self.settings, self.material, as_file

    def _of_file(self, path: Path) -> Opened:
        check_alone(self)
        with stage(f"loading {path}"):
            table = sj.io.scene_table(path)
            scene, camera, settings = sj.io.load_scene(path)
        material = sj.io.material_of_scene(table)
        return scene, camera, settings, material, partial(scene_of_file, table, settings)
