"""`splatjax render`: from splats and a material to a picture with all its layers."""

from dataclasses import dataclass
from pathlib import Path

import splatjax as sj

from ._outputs import check_output
from ._report import stage
from ._shot import Shot, draw


@dataclass(frozen=True, kw_only=True)
class Render(Shot):
    """Render splats, or the built-in bust, under a light and a weak fill: an EXR file with every layer, and a PNG file beside it.

    The camera looks at the middle of the splats from far enough to see all of them. Angles are in degrees: azimuth turns
    about the vertical axis, 0 is the front (+z) and 90 the side of +x; elevation rises above the horizon. If the splats carry
    albedo, the weights of the material are divided by their sums, so that color comes from the albedo alone.

    Example: splatjax render head.ply --material skin --azimuth 30 --width 1024 --height 1024 --output head.exr
    """

    output: Path = Path("out.exr")
    """The EXR file to write; the PNG file has the same name but for its end."""

    def run(self) -> None:
        """Load, render, write."""
        check_output(self.output, (".exr",))
        self.check()
        splats, material = self.load()
        lights = self.lights(material.gaussians.weights.shape[1], self.azimuth, self.light_azimuth)
        scene, camera = sj.Scene(splats, lights, material), self.camera(splats, self.azimuth)
        with stage("planning"):
            plan = sj.plan(scene, camera)
        with stage(f"rendering {splats.count} splats at {self.width} x {self.height}"):
            frame = draw(scene, camera, plan)
        self.say_what_was_handed_over(frame, material)
        with stage(f"writing {self.output} and {self.output.with_suffix('.png')}"):
            written = self.write(self.output, frame, material)
        print(*written, sep="\n")
