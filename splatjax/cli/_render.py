"""`splatjax render` and `splatjax turntable`: a picture with all layers, or the frames of an
animation, which resume after an interruption.
"""

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro

import splatjax as sj

from ._scene import camera_of, check_alone, is_scene, scene_of_file
from ._terminal import check_folder, check_options, check_output, complete, preview, stage
from ._view import PictureOptions

_LARGEST = 16_383  # pixels along a side of a WebP file
_MOST_FRAMES = 10_000  # the most that four digits can number
_DIRECTIONS = 128  # number of shadow maps of an environment that turns about the body


Rendered = tuple[sj.Frame, sj.Material, tuple[sj.scene.AbstractLight, ...], sj.Camera]


@dataclass(frozen=True, kw_only=True)
class Render(PictureOptions):
    """Render splats, the built-in bust, or a scene: an EXR file with every layer, and a PNG file.

    A scene is a TOML file of body, material, lights and camera, or a picture of this command, which
    is rendered again.

    The light is a studio, an --environment, or a single light with a weak fill. The camera looks at
    the middle of the splats from a distance at which all of them are visible. Angles are in
    degrees: azimuth turns about the vertical axis, 0 is the front (+z) and 90 the side of +x;
    elevation is measured from the horizon. If the splats have albedo, the weights of the material
    are divided by their sums, so that the albedo alone gives the color; with --no-albedo the
    material gives it.

    Examples: splatjax render head.ply --material skin --azimuth 30 --width 1024 --height 1024
    --output head.exr
              splatjax render --material marble --no-albedo --output marble.exr
    """

    #: The EXR file to write; the PNG file has the same name with another suffix.
    output: Path = Path("out.exr")

    #: Number of splats to read at a time, for files that are larger than memory. 0 reads all at
    #: once.
    stream: int = 0
    camera_file: Annotated[
        str | None,
        tyro.conf.arg(
            name="camera",
            metavar="FILE[:NAME]",
            help="Camera from transforms.json, glTF, or a folder of COLMAP, instead of --azimuth, "
            "--elevation and --fov; of several, by its name or its number from 0. The width of "
            "the picture follows from its --height.",
            help_behavior_hint="",
        ),
    ] = None
    #: Length of the unit of --camera, mm.
    camera_unit: float = 1.0

    def run(self) -> None:
        check_output(self.output, (".exr",))
        self.check()
        if self.stream != 0:
            check_options(
                self,
                {
                    "stream": (
                        self.stream > 0 and self.splats is not None,
                        "be a number of splats, with a PLY file as input",
                    ),
                    "bounces": (self.bounces == 0, "be 0 with --stream"),
                    "diffusion": (self.diffusion == "clusters", "be clusters with --stream"),
                },
            )
        if self.camera_file is not None:
            self.camera(tuple, self.azimuth)  # its file is read before anything is made
        options = self
        if self._scene:
            check_alone(self)
            with stage(f"loading {self._scene.path}"):
                scene, camera, settings = sj.io.load_scene(self._scene.path)
            rendered = self._drawn(scene, camera, settings)
            options = replace(self, **self._scene.entries["settings"])
        elif self.splats and self.stream:
            rendered = self._streamed(self.splats)
        else:
            rendered = self._drawn(*self.scene_and_camera(), self.settings)
        options.note_unresolved_layers(*rendered[:2])
        with stage(f"writing {self.output} and {self.output.with_suffix('.png')}"):
            written = options.write(self.output, *rendered)
        print(*written, sep="\n")

    @functools.cached_property
    def _scene(self) -> Any:
        return sj.io.scene_table(self.splats) if self.splats and is_scene(self.splats) else None

    def camera(self, parts: sj.scene.Parts, azimuth: float) -> sj.Camera:
        if self.camera_file is None:
            return super().camera(parts, azimuth)
        return camera_of(self.camera_file, self.camera_unit, self.up, self.height, self.scale)

    def record(self, folder: Path, *scene: Any) -> dict[str, Any]:
        if not self._scene:
            return super().record(folder, *scene)
        return {
            "splatjax": sj.__version__,
            "jax": jax.__version__,
            "scene": scene_of_file(self._scene, self.settings, folder, *scene),
        }

    def _drawn(self, scene: sj.Scene, camera: sj.Camera, settings: sj.RenderSettings) -> Rendered:
        # Sample the lights before the preview, which is drawn during the first compilation, so that
        # no compilation is nested.
        samples = [sample for light in scene.lights for sample in light.samples()]
        with preview(lambda side: rough_picture(scene, samples, camera, self.exposure, side)):
            with stage("planning"):
                plan = sj.make_plan(scene, camera, settings)
            size = f"{camera.width} x {camera.height}"
            with stage(f"rendering {scene.splats.count} splats at {size}"):
                frame = draw(scene, camera, settings, plan)
        return frame, scene.material, scene.lights, camera

    def _streamed(self, path: Path) -> Rendered:
        file = sj.SplatFile(path, self.stream, up=self.up)

        def parts() -> Iterable[sj.Splats]:
            return map(self.adjusted, file())

        with stage(f"reading {file.count} splats"):
            camera = self.camera(parts, self.azimuth)
        material = self.material_for(next(iter(parts())))
        lights = self.lights(material, self.azimuth, self.single_light[0])
        with stage("rendering the stream", file.count) as report:
            frame = sj.render_streamed(
                parts, lights, material, camera, report=lambda task, done: report(done, task)
            )
        return frame, material, lights, camera


@dataclass(frozen=True, kw_only=True)
class Turntable(PictureOptions):
    """Render the frames of an animation around splats, or the built-in bust.

    Each frame is an EXR file with every layer and a PNG file; the animation turntable.webp plays in
    a browser. Frames start at --azimuth and the light's azimuth and continue in equal steps; a full
    turn ends one step before its first frame, so that it can repeat. The splats are planned and the
    program is compiled once for all frames. With --turn camera and no fill, the light below the
    surface is computed once too; for an environment that turns, shadow maps are rendered once.
    Existing frames are kept: after an interruption, run the same command again. A record in the
    folder, turntable.json, prevents a mixture of frames with different options. If a launcher has
    started several processes (SLURM, Open MPI, or JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and
    JAX_PROCESS_ID), they share the frames of one folder that all of them can access.

    Example: splatjax turntable head.ply --material skin --frames 72 --output head
    """

    #: The folder to write to. It is created if its parent exists.
    output: Path = Path("turntable")
    #: Number of frames.
    frames: int = 36
    turn: Annotated[
        Literal["object", "camera", "light"],
        tyro.conf.arg(
            help="The part that turns: the camera around object and light, the light around "
            "object and camera, or the object (camera and light together around it). The "
            "fill stays beside the camera."
        ),
    ] = "object"
    degrees: Annotated[
        float,
        tyro.conf.arg(
            help="Total angle by which camera and light turn: to greater azimuths, or to "
            "smaller ones if negative. An object seems to turn the other way."
        ),
    ] = 360.0
    #: Frames per second of turntable.webp, from 0.1 to 60.
    fps: float = 24.0

    def run(self) -> None:
        in_webp = f"be at most {_LARGEST} in turntable.webp"
        self.check(
            {
                "frames": (
                    1 <= self.frames <= _MOST_FRAMES,
                    f"lie between 1 and {_MOST_FRAMES}",
                ),
                "width": (1 <= self.width <= _LARGEST, in_webp),
                "height": (1 <= self.height <= _LARGEST, in_webp),
                "degrees": (
                    self.degrees != 0 and math.isfinite(self.degrees),
                    "be a finite number other than 0",
                ),
                "fps": (0.1 <= self.fps <= 60, "lie between 0.1 and 60"),
            }
        )
        if self.output.exists() and not self.output.is_dir():
            raise ValueError(f"{self.output}: is a file; give the name of a folder")
        check_folder(self.output)
        paths = [
            (self.output / f"frame_{i:04}.exr", self.output / f"frame_{i:04}.png")
            for i in range(self.frames)
        ]
        done = complete(
            self.output / "turntable.json",
            {
                **self.manifest(),
                "contents of --material": sj.io.fingerprint(sj.io.material_path(self.material)),
            },
            paths,
            lambda: self._prepare(paths),
            name="frames",
            what=f"rendering {self.frames} frames at {self.width} x {self.height}",
        )
        written = [path for i in done for path in paths[i]]
        if len(done) == self.frames:
            written.append(self.output / "turntable.webp")
            with stage(f"writing {written[-1]}"):
                sj.io.write_animation(
                    written[-1], [picture for _, picture in paths], frames_per_second=self.fps
                )
        print(*written, sep="\n")

    def azimuths(self, frame: int) -> tuple[float, float]:
        """Return the azimuths of camera and light."""
        turned = self.degrees * frame / self.frames
        return (
            self.azimuth + (0 if self.turn == "light" else turned),
            self.single_light[0] + (0 if self.turn == "camera" else turned),
        )

    def _prepare(self, paths: list[tuple[Path, Path]]) -> Callable[[int], None]:
        """Load and plan; return the function that renders and writes frame i."""
        splats, material = self.load()
        settings, places = self.settings, [self.azimuths(i) for i in range(self.frames)]
        scenes = [sj.Scene(splats, self.lights(material, *place), material) for place in places]
        cameras = [self.camera(lambda: [splats], azimuth) for azimuth, _ in places]
        keeps_shadows = self.environment_name is not None and self.turn != "camera"
        if keeps_shadows:
            even = partial(replace, directions=sj.scene.even_directions(_DIRECTIONS))
            scenes = [replace(scene, lights=tuple(map(even, scene.lights))) for scene in scenes]
        # One plan serves all frames, so that an interruption does not change any.
        with stage(f"planning {self.frames} frames"):
            plan = sj.make_plan(scenes, cameras, settings)
        light = None
        if self.turn == "camera" and (self.environment_name is not None or self.fill == 0):
            # No light moves: passes 1 and 4 are the same in every frame.
            with stage("computing the light at the splats"):
                light = jax.block_until_ready(sj.illuminate(scenes[0], plan, settings))
        elif keeps_shadows:
            with stage(f"rendering {_DIRECTIONS} shadow maps"):
                light = jax.block_until_ready(sj.transfer(scenes[0], plan, settings))

        def make(i: int) -> None:
            frame = draw(scenes[i], cameras[i], settings, plan, light)
            self.note_unresolved_layers(frame, material)
            self.write(paths[i][0], frame, material, scenes[i].lights, cameras[i])

        return make


def draw(
    scene: sj.Scene, camera: sj.Camera, settings: sj.RenderSettings, plan: sj.Plan, light=None
) -> sj.Frame:
    """Render, and wait for the picture; the arguments are those of `sj.render`.

    **Raises:** `ValueError` when the plan's capacity is exceeded.
    """
    frame = jax.block_until_ready(sj.render(scene, camera, settings, plan, light=light))
    if not frame.overflow <= 0:
        raise ValueError(
            f"the plan's capacity is exceeded: {float(frame.overflow):.2f} times the capacity "
            "is needed"
        )
    return frame


def rough_picture(
    scene: sj.Scene, samples: Sequence[Any], camera: sj.Camera, exposure: float, side: int
) -> list:
    """Draw the centers of splats, matte and under samples of the lights, by NumPy alone, which
    compiles nothing. The longer side has at most `side` pixels, fewer for few splats; the height is
    even. Return rows of red, green and blue up to 255.
    """
    scene, camera, lights = jax.device_get((scene, camera, samples))
    # A part of millions of splats suffices.
    splats = jax.tree.map(lambda leaf: leaf[:: 1 + len(leaf) // 2**19], scene.splats)
    lengths = np.asarray([camera.width, camera.height])
    side = max(2, min(side, 0.5 * splats.count**0.5))  # so that few pixels have no splat
    size = 2 * np.maximum(np.rint(side / 2 * lengths / lengths.max()), 1).astype(int)
    albedo = 1.0 if splats.albedo is None else splats.albedo
    color = (albedo * scene.material.gaussians.weights.sum(axis=0) / np.pi) * sum(
        np.maximum(splats.normals @ -light.direction, 0)[:, None] * light.irradiance
        for light in lights
    )
    local = (splats.centers - camera.position) @ camera.rotation.T
    # Draw splats that face the camera from far to near: nearer ones cover farther ones.
    order = np.argsort(-local[:, 2])
    order = order[np.sum(local * (splats.normals @ camera.rotation.T), axis=1)[order] < 0]
    middle = size * np.asarray(camera.principal_pixel) / lengths
    place = camera.focal_length * size[1] * local[:, :2] / local[:, 2:] + middle
    column, row = np.clip(place, 0, size - 1)[order].astype(int).T
    picture = np.zeros((size[1], size[0], 3))
    picture[row, column] = color[order]
    return np.rint(255 * sj.io.linear_to_srgb(picture * 2.0**exposure)).astype(int).tolist()
