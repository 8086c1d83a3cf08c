"""`splatjax render`, which writes a picture with all layers, and `splatjax turntable`, which writes
the frames of an animation and resumes after an interruption.
"""

import functools
import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import splatjax as sj

from ._scene import camera_of, draw, identified, note_unresolved, rough_picture, scene_contents
from ._terminal import (
    Rules,
    check_folder,
    check_options,
    check_output,
    check_unused,
    complete,
    option_name,
    preview,
    process_index_and_count,
    stage,
)
from ._view import ViewOptions

_LARGEST = 16_383  # largest side of a WebP file, pixels
_MOST_FRAMES = 10_000  # numbered with four digits
_NOT_IN_PICTURES = ("splats", "output", "fps", "quiet", "half", "camera_file", "camera_unit")
_DIRECTIONS = 128  # number of shadow maps of an environment that rotates about the body


@dataclass(frozen=True, kw_only=True)
class PictureOptions(ViewOptions):
    """Options for the contents of picture files."""

    #: Background of the PNG (not of the EXR): black, transparent, or the environment.
    background: Literal["black", "transparent", "environment"] = "black"
    #: Illuminant under which the PNG shows the color of a spectral material: D65, A, FL11, or
    #: another name of colour-science; None if the lights of the scene have spectra.
    illuminant: str | None = "D65"
    #: Write the EXR in half precision, except for depth and position.
    half: bool = False

    def check(self, more_rules: Rules | None = None) -> None:
        has_environment = self.environment_name is not None
        if self.table is not None:
            has_environment = "'environment'" in str(self.table.entries.get("lights"))
        rules: Rules = {
            "background": (
                self.background != "environment" or has_environment,
                "be black or transparent if no light is an environment",
            ),
        }
        super().check(rules | (more_rules or {}))

    def write(
        self,
        path: Path,
        frame: sj.Frame,
        scene: sj.Scene,
        camera: sj.Camera,
        settings: sj.RenderSettings,
        count: int | None = None,  # number of all splats, if the scene has only a part
    ) -> tuple[Path, Path]:
        """Write the picture with all its layers and the PNG file; return both paths."""
        material, lights = scene.material, scene.lights
        picture, shown = path.with_suffix(".png"), frame.beauty
        contents = scene_contents(self, settings, path.parent, material, lights, camera)
        variances = material.gaussians.variances.tolist()
        # The sum of all layers does not belong to a Gaussian.
        widths = variances if len(frame.weights) == len(variances) else None
        sj.write_exr(
            path,
            frame,
            variances=widths,
            manifest=self.manifest() | {"scene": contents},
            camera=camera,
            half=self.half,
            wavelengths=material.wavelengths,
        )
        if widths:
            note_unresolved(frame, scene, settings.kernel, self.count_option, count)
        if self.background == "environment":
            environment = next(light for light in lights if isinstance(light, sj.EnvironmentLight))
            shown = environment.behind(frame, camera)
        shown = sj.io.picture_to_rgb(np.asarray(shown), material.wavelengths, self.illuminant)
        if self.background == "transparent":
            colors = np.repeat(shown, 3 // shown.shape[-1], axis=-1)  # for a gray scene
            shown = np.concatenate([colors, np.asarray(frame.coverage)[..., None]], axis=-1)
        sj.write_png(picture, shown, exposure=self.exposure)
        return path, picture

    def manifest(self) -> dict[str, Any]:
        """Return the options, files and versions that the pictures depend on."""
        versions = {"splatjax": sj.__version__, "jax": jax.__version__}
        if self.table is not None:
            return versions
        options = {option_name(n): v for n, v in asdict(self).items() if n not in _NOT_IN_PICTURES}
        if self.environment and self.environment not in sj.io.ENVIRONMENTS:
            options["--environment"] = identified(Path(self.environment))
        return options | {
            "splats": identified(self.splats) if self.splats else "the built-in bust",
            "contents of --material": sj.io.material_path(self.material).read_text("utf-8"),
            "precision": str(jnp.result_type(float)),
            **versions,
        }


@dataclass(frozen=True, kw_only=True)
class Render(PictureOptions):
    """Render splats, the built-in bust, or a scene to an EXR file with all layers and a PNG file.

    A scene is a TOML file with body, material, lights and camera, or a picture of this command,
    which is rendered again.

    The light is a studio, an --environment, or a single light with a weak fill. The camera looks at
    the center of the splats from a distance at which all splats are visible. Angles are in degrees:
    azimuth turns about the vertical axis, with 0 in front (+z) and 90 at +x; elevation is measured
    from the horizon. If the splats have an albedo, the weights of the material are divided by their
    sums, so that the albedo alone determines the color; with --no-albedo, the material determines
    the color.

    Examples: splatjax render head.ply --material skin --azimuth 30 --output head.exr
              splatjax render --material marble --no-albedo --output marble.exr
    """

    #: The EXR file to write. The PNG file has the same name with another suffix.
    output: Path = Path("out.exr")
    #: Number of splats to read at a time, for files larger than memory. 0 reads all at once.
    stream: int = 0
    camera_file: Annotated[
        str | None,
        tyro.conf.arg(
            name="camera",
            metavar="FILE[:NAME]",
            help="Camera from transforms.json, glTF, or a folder of COLMAP, instead of --azimuth, "
            "--elevation and --fov. Select one of several by its name or its number from 0. "
            "--height determines the width of the picture.",
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
        if self.camera_file is None:
            check_unused(self, ["camera_unit"], "there is no --camera")
        else:  # read the file before any computation, and place the fill beside the camera
            check_unused(self, ("azimuth", "elevation", "fov", "width"), "--camera gives the view")
            x, _, z = -self.camera(tuple, self.azimuth).rotation[2]
            self = replace(self, azimuth=math.degrees(math.atan2(x, z)))
        if self.table is None and self.splats and self.stream:
            pictured = self._streamed(self.splats)
        else:
            opened = self.open()
            pictured = self._drawn(*opened), *opened
        with stage(f"writing {self.output} and {self.output.with_suffix('.png')}"):
            written = self.write(self.output, *pictured)
        print(*written, sep="\n")

    def camera(self, parts: sj.scene.Parts, azimuth: float) -> sj.Camera:
        if self.camera_file is None:
            return super().camera(parts, azimuth)
        return camera_of(self.camera_file, self.camera_unit, self.up, self.height, self.scale)

    def _drawn(self, scene: sj.Scene, camera: sj.Camera, settings: sj.RenderSettings) -> sj.Frame:
        # Sample the lights before the preview is drawn during the first compilation, so that
        # compilations are not nested.
        samples = [sample for light in scene.lights for sample in light.samples()]
        with preview(lambda side: rough_picture(scene, samples, camera, self.exposure, side)):
            with stage("planning"):
                plan = sj.make_plan(scene, camera, settings)
            with stage(
                f"rendering {scene.splats.count} splats at {camera.width} x {camera.height}"
            ):
                return draw(scene, camera, settings, plan)

    def _streamed(self, path: Path) -> tuple[Any, ...]:
        file = sj.SplatFile(path, self.stream, up=self.up)

        def parts() -> Iterable[sj.Splats]:
            return map(self.adjusted, file())

        with stage(f"reading {file.count} splats"):
            camera = self.camera(parts, self.azimuth)
        material = self.material_for(first := next(iter(parts())))
        lights = self.lights(material, self.azimuth, self.single_light[0])
        with stage("rendering the stream", file.count) as report:
            frame = sj.render_streamed(
                parts, lights, material, camera, report=lambda task, done: report(done, task)
            )
        return frame, sj.Scene(first, lights, material), camera, self.settings, file.count


@dataclass(frozen=True, kw_only=True)
class Turntable(PictureOptions):
    """Render the frames of an animation around splats, or the built-in bust.

    Each frame is an EXR file with all layers and a PNG file; the animation turntable.webp plays in
    a browser. Frames start at --azimuth and the light's azimuth and continue in equal steps; a full
    turn ends one step before its first frame, so that it can repeat. One plan and one compiled
    program serve all frames. With --turn camera and no fill, the light below the surface is
    computed only once; for a rotating environment, shadow maps are rendered only once. Existing
    frames are kept; after an interruption, run the same command again. A record in the folder,
    turntable.json, prevents mixing frames with different options. If a launcher starts several
    processes (SLURM, Open MPI, or JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID),
    they share the frames of one folder that all can access.

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
            help="Total angle by which camera and light turn, degrees; negative angles decrease "
            "the azimuth. An object appears to turn the other way."
        ),
    ] = 360.0
    #: Frames per second of turntable.webp, from 0.1 to 60.
    fps: float = 24.0

    table = None  # a scene file has one camera

    def run(self) -> None:
        process = process_index_and_count()
        in_webp = f"be at most {_LARGEST} in turntable.webp"
        self.check(
            {
                "frames": (1 <= self.frames <= _MOST_FRAMES, f"lie between 1 and {_MOST_FRAMES}"),
                "width": (1 <= self.width <= _LARGEST, in_webp),
                "height": (1 <= self.height <= _LARGEST, in_webp),
                "degrees": (
                    self.degrees != 0 and math.isfinite(self.degrees),
                    "be a finite number other than 0",
                ),
                "fps": (0.1 <= self.fps <= 60, "lie between 0.1 and 60"),
                "output": (not self.output.is_file(), "be a folder, or a new name"),
            }
        )
        check_folder(self.output)
        files = [self.output / f"frame_{i:04}.exr" for i in range(self.frames)]
        paths = [(file, file.with_suffix(".png")) for file in files]
        material = sj.io.material_path(self.material)
        done = complete(
            process,
            self.output / "turntable.json",
            self.manifest() | {"contents of --material": sj.io.fingerprint(material)},
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
        """Return the azimuths of the camera and the light in a frame."""
        turned = self.degrees * frame / self.frames
        return (
            self.azimuth + (0 if self.turn == "light" else turned),
            self.single_light[0] + (0 if self.turn == "camera" else turned),
        )

    def _prepare(self, paths: list[tuple[Path, Path]]) -> Callable[[int], None]:
        """Load the scene, make a plan, and return the function that renders and writes frame i."""
        splats, material = self.load()
        settings, places = self.settings, [self.azimuths(i) for i in range(self.frames)]
        scenes = [sj.Scene(splats, self.lights(material, *place), material) for place in places]
        cameras = [self.camera(lambda: [splats], azimuth) for azimuth, _ in places]
        keeps_shadows = self.environment_name is not None and self.turn != "camera"
        if keeps_shadows:
            even = functools.partial(replace, directions=sj.scene.even_directions(_DIRECTIONS))
            scenes = [replace(scene, lights=tuple(map(even, scene.lights))) for scene in scenes]
        # One plan serves all frames, so that an interruption does not change them.
        with stage(f"planning {self.frames} frames"):
            plan = sj.make_plan(scenes, cameras, settings)
        light = None
        if self.turn == "camera" and (self.environment_name is not None or self.fill == 0):
            # The lights do not move, so passes 1 and 4 are equal in all frames.
            with stage("computing the light at the splats"):
                light = jax.block_until_ready(sj.illuminate(scenes[0], plan, settings))
        elif keeps_shadows:
            with stage(f"rendering {_DIRECTIONS} shadow maps"):
                light = jax.block_until_ready(sj.transfer(scenes[0], plan, settings))

        def make(i: int) -> None:
            frame = draw(scenes[i], cameras[i], settings, plan, light)
            self.write(paths[i][0], frame, scenes[i], cameras[i], settings)

        return make
