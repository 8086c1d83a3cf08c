"""`splatjax turntable`: the frames of an animation, taken up again where it was interrupted."""

import hashlib
import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import tyro

import splatjax as sj
from splatjax.io import read_record, write_animation, write_record

from ._processes import own_share
from ._report import note, progress, stage
from ._shot import Shot, draw

_RECORD = "turntable.json"
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


class Turn(Enum):
    """What goes around the middle of the splats."""

    OBJECT = "object"
    CAMERA = "camera"
    LIGHT = "light"


@dataclass(frozen=True, kw_only=True)
class Turntable(Shot):
    """Render the frames of an animation around splats, or the built-in bust.

    Per frame an EXR file with every layer and a PNG file; in the end turntable.webp, which plays in
    a browser. Frames begin at --azimuth and --light-azimuth and go on in equal steps; a full turn
    ends one step before its beginning, so that it plays round and round. The splats are planned and
    the program is compiled once for all frames. Frames that are there are kept: after an
    interruption, run the same command again. A record in the folder, turntable.json, sees to it
    that only frames of one kind come together. Where a launcher has started several processes
    (SLURM, Open MPI, or JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID), they share
    the frames of one folder that all of them see.

    Example: splatjax turntable head.ply --material skin --frames 72 --output head
    """

    #: The folder to write to; it is made where its parent exists.
    output: Path = Path("turntable")
    #: Number of frames.
    frames: int = 36
    turn: Annotated[tyro.conf.EnumChoicesFromValues[Turn], tyro.conf.arg(help=_TURN)] = Turn.OBJECT
    degrees: Annotated[float, tyro.conf.arg(help=_DEGREES)] = 360.0
    #: Frames per second of turntable.webp, from 0.1 to 60.
    fps: float = 24.0

    def run(self) -> None:
        """Load, plan, render what is missing, join."""
        self._check()
        self._check_record()
        missing = [
            i for i in range(self.frames) if not all(path.exists() for path in self._paths(i))
        ]
        if len(missing) < self.frames:
            note(
                f"{self.frames - len(missing)} of {self.frames} frames are there already, and kept"
            )
        share = own_share()  # which waits: all have seen the same frames missing
        own = share.of(missing)
        if own:
            self._render(own)
        if share.count > 1 and not all(
            path.exists() for i in range(self.frames) for path in self._paths(i)
        ):
            note(
                "other processes are still at work; the one that finds every frame there joins "
                "them, or the same command again"
            )
            print(*(path for i in own for path in self._paths(i)), sep="\n")
            return
        animation = self.output / "turntable.webp"
        with stage(f"writing {animation}"):
            write_animation(
                animation,
                [self._paths(i)[1] for i in range(self.frames)],
                frames_per_second=self.fps,
            )
        print(*(path for i in range(self.frames) for path in self._paths(i)), animation, sep="\n")

    def _check(self) -> None:
        self.check()
        if not 1 <= self.frames <= _MOST_FRAMES:
            raise ValueError(f"--frames is {self.frames}; it must lie between 1 and {_MOST_FRAMES}")
        if max(self.width, self.height) > _LARGEST:
            raise ValueError(
                f"--width and --height are {self.width} and {self.height}; turntable.webp holds at "
                f"most {_LARGEST}"
            )
        if self.degrees == 0 or not math.isfinite(self.degrees):
            raise ValueError(f"--degrees is {self.degrees:g}; nothing would turn")
        if not 0.1 <= self.fps <= 60:
            raise ValueError(f"--fps is {self.fps:g}; it must lie between 0.1 and 60")
        if self.output.exists() and not self.output.is_dir():
            raise ValueError(f"{self.output}: is a file; give the name of a folder")
        if not self.output.parent.is_dir():
            raise FileNotFoundError(
                f"{self.output}: there is no folder {self.output.parent}; make it first"
            )

    def _paths(self, frame: int) -> tuple[Path, Path]:
        return self.output / f"frame_{frame:04}.exr", self.output / f"frame_{frame:04}.png"

    def azimuths(self, frame: int) -> tuple[float, float]:
        """Give the azimuths of camera and light."""
        turned = self.degrees * frame / self.frames
        return (
            self.azimuth + (0 if self.turn is Turn.LIGHT else turned),
            self.light_azimuth + (0 if self.turn is Turn.CAMERA else turned),
        )

    def _render(self, missing: list[int]) -> None:
        splats, material = self.load()
        channels = material.gaussians.weights.shape[1]
        places = [self.azimuths(i) for i in range(self.frames)]
        scenes = [sj.Scene(splats, self.lights(channels, *place), material) for place in places]
        cameras = [self.camera(splats, azimuth) for azimuth, _ in places]
        with stage(
            f"planning {self.frames} frames"
        ):  # those that are there, too: the rest will be as if never interrupted
            plan = sj.plan(scenes, cameras)
        self.output.mkdir(exist_ok=True)
        write_record(self.output / _RECORD, self._record())
        try:
            with progress(
                f"rendering {splats.count} splats at {self.width} x {self.height}", len(missing)
            ) as one_more:
                for i in missing:
                    frame = draw(scenes[i], cameras[i], plan)
                    self.write(self._paths(i)[0], frame, material)
                    one_more()
        except (KeyboardInterrupt, OSError):
            note(f"the frames in {self.output} are whole; run the same command again to continue")
            raise
        self.say_what_was_handed_over(frame, material)

    def _check_record(self) -> None:
        """Raise `ValueError` when the folder holds frames that are made of something else."""
        path = self.output / _RECORD
        if not path.exists():
            stray = next(self.output.glob("frame_*"), None)
            if stray is not None:
                raise ValueError(
                    f"{stray}: nothing says what it is made of; name another --output, or delete "
                    "the frames"
                )
            return
        record, found = self._record(), read_record(path)
        differing = [
            f"{name} is {record.get(name)}, but was {found.get(name)}"
            for name in sorted(record.keys() | found.keys())
            if record.get(name) != found.get(name)
        ]
        if differing:
            raise ValueError(
                f"{path}: the frames beside it are others: {'; '.join(differing)}; name another "
                "--output, or delete that folder"
            )

    def manifest(self) -> dict[str, Any]:
        """Give all that the frames depend on; their speed is no matter of theirs."""
        found = super().manifest() | {"--turn": self.turn.value}
        return {name: value for name, value in found.items() if name != "--fps"}

    def _record(self) -> dict[str, Any]:
        """Give the same in short."""
        material = self.manifest()["contents of --material"].encode()
        digest = f"{len(material)} bytes, SHA-256 {hashlib.sha256(material).hexdigest()}"
        return self.manifest() | {"contents of --material": digest}
