"""`splatjax figure`: the figures of the paper, made anew."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import splatjax as sj

from ._mesh_maps import MeshMaps
from ._options import MaterialName, MaterialNames, OptionalFloat
from ._outputs import FIGURES, check_output, save_figure
from ._report import stage
from ._shot import Shot, check_scale, in_color, towards

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

    from splatjax.baselines import TexturedMesh
    from splatjax.plots import Subject

_DISTANCE = 900.0  # mm: that of a portrait
_TEXELS = 1024  # along an edge of the bust's textures
_ROOM = 1.04  # of the picture over the body's outline
_SCENE = (
    "PLY files of splats, in mm (`splatjax sample` makes them). Figure 6 shows the bust and all of "
    "them, the others the first; "
    "without one, the bust. Figure 8 takes a mesh with texture coordinates (GLB, glTF, OBJ) and "
    "the maps below."
)
_SCALE = (
    "Size of the bodies: at 0.5 a head is half as large, and the light goes twice as far in it. So "
    "do fewer splats for narrow "
    "layers."
)


@dataclass(frozen=True, kw_only=True)
class Figure(MeshMaps):
    """Make a figure of the paper anew, from the built-in bust or from scanned heads: 1 or 3 to 8.

    1: splats, the surface without and with scattering. 3: the layers of a profile. 4: the layers of
    a picture. 5: fewer splats for wider layers. 6: bodies in four materials. 7: earlier point-based
    methods and this one. 8: texture-space diffusion and this one, half and half. docs/figures.md
    shows them.

    Examples: splatjax figure 7 --scene head.ply --output figure_7.png
              splatjax figure 8 --scene head.glb --mm-per-unit 53 --albedo color.jpg --output
              figure_8.png
    """

    #: Of the figure.
    number: tyro.conf.Positional[int]
    #: The PNG, PDF or SVG file to write.
    output: Path = Path("figure.png")
    scene: Annotated[
        tuple[Path, ...],
        tyro.conf.arg(metavar="PATH [PATH ...]", help=_SCENE, help_behavior_hint=""),
    ] = ()
    #: Of figure 8: length of the mesh file's unit, mm: 1000 for meters.
    mm_per_unit: OptionalFloat = None
    #: Name of a material (`splatjax materials`), or path of a TOML file.
    material: MaterialName = "skin"
    #: Of figure 6; the first is drawn with the body's own color.
    materials: MaterialNames = ("skin", "marble", "ketchup", "wholemilk")
    #: Of a picture in the figure, pixels along each side.
    width: int = 512
    #: Number of splats of the built-in bust, and of a mesh.
    count: int = 200_000
    scale: Annotated[float, tyro.conf.arg(help=_SCALE)] = 1.0
    #: Of figure 7: what is shown closer, as shares of the height and of the width of the body's
    #: outline.
    close_up: tuple[float, float] = (0.48, 0.34)
    #: Of the camera, degrees.
    azimuth: float = 25.0
    #: Of the place the light comes from, degrees.
    light_azimuth: float = -35.0

    def run(self) -> None:
        """Draw, write."""
        check_output(self.output, FIGURES)
        laid = {
            name: value
            for name, value in {**self.worn(), "mm_per_unit": self.mm_per_unit}.items()
            if value is not None
        }
        if laid and not (self.number == 8 and self.scene):
            option = next(iter(laid)).replace("_", "-")
            raise ValueError(
                f"--{option} is of the mesh of figure 8 alone; give that by --scene, or leave it "
                "out"
            )
        check_scale(self.scale)
        figures = self._figures()
        if self.number not in figures:
            known = ", ".join(str(number) for number in figures)
            raise ValueError(f"there is no figure {self.number} to make; give one of {known}")
        with stage(f"drawing figure {self.number}"):
            drawing = figures[self.number]()
        save_figure(drawing, self.output)
        print(self.output)

    def _figures(self) -> dict[int, Callable[[], "Drawing"]]:
        from splatjax import plots  # loads matplotlib

        material = in_color(sj.load_material(self.material))
        return {
            1: lambda: plots.figure_1(self._subject(), material),
            3: lambda: plots.figure_3(material.gaussians, title=self.material),
            4: lambda: plots.figure_4(self._subject(), material),
            5: lambda: plots.figure_5(self._subject()),
            6: lambda: plots.figure_6(
                self._subjects(),
                {name: in_color(sj.load_material(name)) for name in self.materials},
            ),
            7: lambda: plots.figure_7(self._subject(), material, place=self.close_up),
            8: lambda: plots.figure_8(*self._both_ways(), material),
        }

    def _subject(self) -> "Subject":
        return self._placed(self.scene[0] if self.scene else None)

    def _subjects(self) -> list["Subject"]:
        return [self._placed(path) for path in (None, *self.scene)]

    def _placed(self, path: Path | None) -> "Subject":
        """Give the splats of a file, or the bust, under the lights and before the camera of all
        figures.
        """
        shot = self._shot(path)
        splats = shot.splats_to_show()
        return self._before_the_camera("bust" if path is None else path.stem, splats, shot)

    def _both_ways(self) -> "tuple[Subject, TexturedMesh]":
        """Give the mesh of a file, or the bust's, as splats and as triangles."""
        from splatjax.baselines import TexturedMesh, bust_with_textures
        from splatjax.geometry import sample_mesh
        from splatjax.io import read_textured_mesh

        path = self.scene[0] if self.scene else None
        shot = self._shot(None)
        if path is None:
            mesh, textures = bust_with_textures(_TEXELS)
        elif self.mm_per_unit is None:
            raise ValueError(
                f"--mm-per-unit is missing: say how many mm a unit of {path} is (1000 for meters)"
            )
        else:
            mesh, textures = read_textured_mesh(path, mm_per_unit=self.mm_per_unit, **self.worn())
        triangles = TexturedMesh.of(mesh, textures)
        splats = sample_mesh(mesh, self.count, textures=textures)
        subject = self._before_the_camera("bust" if path is None else path.stem, splats, shot)
        return subject, replace(triangles, vertices=self.scale * triangles.vertices)

    def _shot(self, path: Path | None) -> Shot:
        shot = Shot(
            splats=path,
            output=self.output,
            width=self.width,
            height=self.width,
            azimuth=self.azimuth,
            light_azimuth=self.light_azimuth,
            light_elevation=25.0,
            count=self.count,
        )
        shot.check()
        return shot

    def _before_the_camera(self, name: str, splats: sj.Splats, shot: Shot) -> "Subject":
        from splatjax.plots import Subject

        lights = shot.lights(3, self.azimuth, self.light_azimuth)
        camera = portrait(splats, towards(self.azimuth, 0.0), self.width)
        return Subject(name, splats, lights, camera).scaled(self.scale)


def portrait(splats: sj.Splats, direction: jax.Array, width: int) -> sj.Camera:
    """Place a camera in a direction so that the outline of the splats just fits a square
    picture.
    """
    centers = splats.centers
    middle = (centers.min(axis=0) + centers.max(axis=0)) / 2
    eye, fov = middle + _DISTANCE * direction.astype(middle.dtype), 40.0
    for _ in range(3):  # looking elsewhere moves the outline a little
        camera = sj.Camera.look_at(eye, middle, fov=fov, width=width, height=width)
        right, down, forward = camera.rotation @ (centers - eye[None]).T
        across, along = np.asarray(right / forward), np.asarray(down / forward)
        box = [
            (low + high) / 2
            for low, high in ((across.min(), across.max()), (along.min(), along.max()))
        ]
        middle = eye + camera.rotation.T @ jnp.asarray([*box, 1.0], middle.dtype)
        reach = _ROOM * max(np.ptp(across), np.ptp(along)) / 2
        fov = float(2 * np.degrees(np.arctan(reach)))
    return sj.Camera.look_at(eye, middle, fov=fov, width=width, height=width)
