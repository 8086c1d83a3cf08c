"""`splatjax turntable`: the frames of an animation, continued where it was interrupted."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import jax
import tyro

import splatjax as sj
from splatjax.io import fingerprint, material_path, write_animation

from ._resumable import complete
from ._terminal import check_folder, stage
from ._view import ViewOptions, draw

_LARGEST = 16_383  # pixels along a side of a WebP file
_MOST_FRAMES = 10_000  # that four digits can name
_TURN = (
    "What turns: the camera around object and light, the light around object and camera, or the "
    "object before both, which is the "
    "same as camera and light together around it. The fill keeps beside the camera."
)
_DEGREES = (
    "How far camera and light go around in all: to greater azimuths, or to smaller ones if "
    "negative. What stands before both "
    "seems to turn the other way."
)


@dataclass(frozen=True, kw_only=True)
class Turntable(ViewOptions):
    """Render the frames of an animation around splats, or the built-in bust.

    Per frame an EXR file with every layer and a PNG file; in the end turntable.webp, which plays in
    a browser. Frames begin at --azimuth and --light-azimuth and go on in equal steps; a full turn
    ends one step before its beginning, so that it plays round and round. The splats are planned and
    the program is compiled once for all frames; with --turn camera --fill 0 the light below the
    surface is computed once too. Frames that are there are kept: after an
    interruption, run the same command again. A record in the folder, turntable.json, makes sure
    that frames with different options are not mixed. Where a launcher has started several processes
    (SLURM, Open MPI, or JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID), they share
    the frames of one folder that all of them see.

    Example: splatjax turntable head.ply --material skin --frames 72 --output head
    """

    #: The folder to write to; it is made where its parent exists.
    output: Path = Path("turntable")
    #: Number of frames.
    frames: int = 36
    turn: Annotated[Literal["object", "camera", "light"], tyro.conf.arg(help=_TURN)] = "object"
    degrees: Annotated[float, tyro.conf.arg(help=_DEGREES)] = 360.0
    #: Frames per second of turntable.webp, from 0.1 to 60.
    fps: float = 24.0

    def run(self) -> None:
        """Check, render what is missing, join."""
        in_webp = f"be {_LARGEST} at most in turntable.webp"
        turns = self.degrees != 0 and math.isfinite(self.degrees)
        most = f"lie between 1 and {_MOST_FRAMES}"
        self.check(
            {
                "frames": (1 <= self.frames <= _MOST_FRAMES, most),
                "width": (1 <= self.width <= _LARGEST, in_webp),
                "height": (1 <= self.height <= _LARGEST, in_webp),
                "degrees": (turns, "be a finite number other than 0"),
                "fps": (0.1 <= self.fps <= 60, "lie between 0.1 and 60"),
            }
        )
        if self.output.exists() and not self.output.is_dir():
            raise ValueError(f"{self.output}: is a file; give the name of a folder")
        check_folder(self.output)
        material = fingerprint(material_path(self.material))
        record = self.manifest() | {"contents of --material": material}
        names = [self.output / f"frame_{i:04}" for i in range(self.frames)]
        paths = [(name.with_suffix(".exr"), name.with_suffix(".png")) for name in names]
        what = f"rendering {self.frames} frames at {self.width} x {self.height}"
        record_path, prepare = self.output / "turntable.json", lambda: self._prepare(paths)
        done = complete(record_path, record, paths, prepare, name="frames", what=what)
        written = [path for i in done for path in paths[i]]
        if len(done) == self.frames:
            written.append(self.output / "turntable.webp")
            with stage(f"writing {written[-1]}"):
                pictures = [picture for _, picture in paths]
                write_animation(written[-1], pictures, frames_per_second=self.fps)
        print(*written, sep="\n")

    def azimuths(self, frame: int) -> tuple[float, float]:
        """Return the azimuths of camera and light."""
        turned = self.degrees * frame / self.frames
        return (
            self.azimuth + (0 if self.turn == "light" else turned),
            self.light_azimuth + (0 if self.turn == "camera" else turned),
        )

    def _prepare(self, paths: list[tuple[Path, Path]]) -> Callable[[int], None]:
        """Load and plan; return the function that renders and writes frame i."""
        splats, material = self.load()
        places = [self.azimuths(i) for i in range(self.frames)]
        scenes = [sj.Scene(splats, self.lights(material, *place), material) for place in places]
        cameras = [self.camera(lambda: [splats], azimuth) for azimuth, _ in places]
        # The plan is for all frames, so that an interruption changes none.
        with stage(f"planning {self.frames} frames"):
            plan = sj.make_plan(scenes, cameras)
        light = None
        if self.turn == "camera" and self.fill == 0:
            # No light moves: passes 1 and 4 are the same in every frame.
            with stage("lighting the splats"):
                light = jax.block_until_ready(sj.illuminate(scenes[0], plan))

        def make(i: int) -> None:
            frame = draw(scenes[i], cameras[i], plan, light)
            self.note_unresolved_layers(frame, material)
            self.write(paths[i][0], frame, material)

        return make
