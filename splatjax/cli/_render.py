"""`splatjax render`: from splats and a material to a picture with all its layers."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import splatjax as sj

from ._terminal import check_options, check_output, stage
from ._view import ViewOptions, draw


@dataclass(frozen=True, kw_only=True)
class Render(ViewOptions):
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
        is_valid = self.stream == 0 or (self.stream > 0 and self.splats is not None)
        expected = "be a number of splats of a PLY file, which must be named"
        check_options(self, {"stream": (is_valid, expected)})
        frame, material = (
            self._streamed(self.splats) if self.splats and self.stream else self._at_once()
        )
        self.note_unresolved_layers(frame, material)
        with stage(f"writing {self.output} and {self.output.with_suffix('.png')}"):
            written = self.write(self.output, frame, material)
        print(*written, sep="\n")

    def _at_once(self) -> tuple[sj.Frame, sj.Material]:
        splats, material = self.load()
        camera = self.camera(lambda: [splats], self.azimuth)
        lights = self.lights(material, self.azimuth, self.light_azimuth)
        scene = sj.Scene(splats, lights, material)
        with stage("planning"):
            plan = sj.make_plan(scene, camera)
        with stage(f"rendering {splats.count} splats at {self.width} x {self.height}"):
            return draw(scene, camera, plan), material

    def _streamed(self, path: Path) -> tuple[sj.Frame, sj.Material]:
        file = sj.SplatFile(path, self.stream, up=self.up)
        material = self.displayable_material()

        def parts() -> Iterable[sj.Splats]:
            return map(self.adjusted, file())

        with stage(f"looking at {file.count} splats"):
            camera = self.camera(parts, self.azimuth)
        first = next(iter(parts()))
        material = self.material_for(first, material)
        lights = self.lights(material, self.azimuth, self.light_azimuth)
        with stage("rendering the stream", file.count) as report:
            frame = sj.render_streamed(
                parts, lights, material, camera, report=lambda what, done: report(done, what)
            )
        return frame, material
