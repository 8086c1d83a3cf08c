"""`splatjax render`: from splats and a material to a picture with all its layers."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import splatjax as sj

from ._outputs import check_output
from ._report import stage, sweeps
from ._shot import Shot, draw, frame_parts, towards


@dataclass(frozen=True, kw_only=True)
class Render(Shot):
    """Render splats, or the built-in bust: an EXR file with every layer, and a PNG file beside it.

    They stand under a light and a weak fill. The camera looks at the middle of the splats from far
    enough to see all of them. Angles are in degrees: azimuth turns about the vertical axis, 0 is
    the front (+z) and 90 the side of +x; elevation rises above the horizon. If the splats carry
    albedo, the weights of the material are divided by their sums, so that color comes from the
    albedo alone; with --no-albedo it comes from the material alone.

    Examples: splatjax render head.ply --material skin --azimuth 30 --width 1024 --height 1024
    --output head.exr
              splatjax render --material marble --no-albedo --output marble.exr
    """

    #: The EXR file to write; the PNG file has the same name but for its end.
    output: Path = Path("out.exr")

    #: Read so many splats of the file at a time, and forget them: for files that are larger than
    #: memory. 0: all at once.
    stream: int = 0

    def run(self) -> None:
        """Load, render, write."""
        check_output(self.output, (".exr",))
        self.check()
        if self.stream:
            self._run_streamed()
            return
        splats, material = self.load()
        lights = self.lights(material.gaussians.weights.shape[1], self.azimuth, self.light_azimuth)
        scene, camera = sj.Scene(splats, lights, material), self.camera(splats, self.azimuth)
        with stage("planning"):
            plan = sj.plan(scene, camera)
        with stage(f"rendering {splats.count} splats at {self.width} x {self.height}"):
            frame = draw(scene, camera, plan)
        self._write(frame, material)

    def _run_streamed(self) -> None:
        if self.splats is None or self.stream < 0:
            raise ValueError(
                f"--stream is {self.stream}; it is a number of splats of a PLY file, which must be "
                "named"
            )
        file = sj.SplatFile(self.splats, self.stream, up=self.up)

        def parts() -> Iterator[sj.Splats]:
            return map(self.as_shown, file())

        with stage(f"looking at {file.count} splats"):
            camera = frame_parts(
                parts, towards(self.azimuth, self.elevation), self.fov, self.width, self.height
            )
        material = self.material_for(next(parts()), sj.load_material(self.material))
        lights = self.lights(material.gaussians.weights.shape[1], self.azimuth, self.light_azimuth)
        with sweeps(file.count) as report:
            frame = sj.render_streamed(parts, lights, material, camera, report=report)
        self._write(frame, material)

    def _write(self, frame: sj.Frame, material: sj.Material) -> None:
        self.say_what_was_handed_over(frame, material)
        with stage(f"writing {self.output} and {self.output.with_suffix('.png')}"):
            written = self.write(self.output, frame, material)
        print(*written, sep="\n")
