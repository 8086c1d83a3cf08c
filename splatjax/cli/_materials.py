"""`splatjax materials`, which lists the library, `splatjax export`, which writes materials and
scenes for other renderers, and `splatjax sample`, which converts a mesh with maps to splats.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

import splatjax as sj

from ._render import Render
from ._scene import is_scene
from ._terminal import (
    OptionalFloat,
    OptionalPath,
    UpAxis,
    check_options,
    check_output,
    check_unused,
    note,
    print_table,
    save_figure,
    stage,
)

_SCENES = {
    ".glb": sj.io.save_gltf,
    ".usd": sj.io.save_usd,
    ".usda": sj.io.save_usd,
    ".usdc": sj.io.save_usd,
}
_OPEN = 0.02  # least mean normal of an open surface; a closed surface has 0
_SMALLEST, _LARGEST = 1.0, 1e4  # mm, of usual bodies
_ACROSS = 8  # pictures in a row of a sheet


@dataclass(frozen=True)
class Materials:
    """List the materials of the library, or print one.

    `splatjax render --material` accepts their names, and so does `splatjax fit` if coefficients or
    layers are known.

    Examples: splatjax materials marble > mine.toml
              splatjax materials --pictures materials.jpg
    """

    material: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(
            metavar="[MATERIAL]",
            help="Print the file of this material (coefficients, source, Gaussians) as a "
            "starting point for a new material. Default: list all materials.",
            help_behavior_hint="",
        ),
    ] = None
    #: Also render each material on the built-in bust, 7 cm tall, in the studio, and write all
    #: pictures to this PNG or JPEG file.
    pictures: OptionalPath = None

    def run(self) -> None:
        check_output(self.pictures, (".png", ".jpg"))
        if self.material is not None:
            print(sj.io.material_path(self.material).read_text(encoding="utf-8"), end="")
            return
        titles = ("material", "known", "total reflectance", "widest, mm", "eta", "source")
        rows = [_row(name) for name in sj.list_materials()]
        print_table([titles, *rows])
        if self.pictures is not None:
            drawn = [_picture(name) for name, *_ in rows]
            drawn += [np.zeros_like(drawn[0])] * (-len(drawn) % _ACROSS)
            from splatjax.plots import plot_pictures  # loads matplotlib

            figure = plot_pictures(
                [drawn[i : i + _ACROSS] for i in range(0, len(drawn), _ACROSS)],
                [""] * _ACROSS,
                white=1.0,
                inches=1.6,
            )
            for axes, (name, *_, source) in zip(figure.axes, rows, strict=False):
                axes.set_title(f"{name}\n{source}", fontsize=6)
            for axes in figure.axes[len(rows) :]:
                axes.set_visible(False)
            save_figure(figure, self.pictures)


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a material for other renderers as JSON or MaterialX, or a scene as glTF or USD.

    JSON contains the Gaussians of a material in several forms, each with formula, unit and source:
    GPU Gems weights, a kernel for separable subsurface scattering, Burley's d, the shape parameter
    of Unity's HDRP, and Blender's radius. MaterialX contains an OpenPBR surface. glTF and USD
    contain material, body, camera and lights. USD needs usd-core, the extra `usd` of splatjax.

    Examples: splatjax export marble --output marble.mtlx --mm-per-unit 10
              splatjax export scene.toml --output scene.glb
    """

    #: Name of a material (`splatjax materials`), or path of a TOML file with a [fit] (for
    #: MaterialX, coefficients suffice); for glTF and USD, the TOML file of a scene or a picture of
    #: `splatjax render`.
    source: tyro.conf.Positional[str]
    #: JSON, MTLX, GLB, USD, USDA or USDC file to write.
    output: Path
    #: Length of the other renderer's unit, mm; only for MaterialX.
    mm_per_unit: float = 1.0
    #: Irradiance of 1 lux in the unit of the lights; only for glTF. Blender uses 1/683, 0.00146.
    lux: float = 1.0

    def run(self) -> None:
        check_output(self.output, (".json", ".mtlx", *_SCENES))
        suffix = self.output.suffix.lower()
        for name, only in (("mm_per_unit", ".mtlx"), ("lux", ".glb")):
            if suffix != only:
                check_unused(self, [name], f"{self.output} is no {only} file")
        save = _SCENES.get(suffix)
        if save is not None:
            check_options(
                self,
                {
                    "output": (
                        is_scene(Path(self.source)),
                        f"be JSON or MTLX for a material, which {self.source} is; the others are "
                        "for a scene or a picture of `splatjax render`",
                    )
                },
            )
            with stage(f"loading {self.source}"):
                scene, camera, _ = sj.io.load_scene(self.source)
                table = sj.io.scene_table(self.source)
                mesh = sj.io.mesh_of_scene(table)
                g = sj.io.load_mean_cosine(sj.io.material_of_scene(table))
            if mesh is None:
                note(
                    f"the body is a hexagon for each of its {scene.splats.count} splats, which do "
                    "not form a closed surface, so other renderers cannot scatter light below it; "
                    "give a scene whose [splats] has `mesh` instead of `file`"
                )
            own = {"lux": self.lux} if suffix == ".glb" else {"g": g}
            save(self.output, scene, camera, mesh=mesh, **own)
            print(self.output)
            return
        with jax.enable_x64(True):
            if suffix == ".mtlx":
                material, g = _with_coefficients(self.source), sj.io.load_mean_cosine(self.source)
                sj.io.save_materialx(self.output, material, mm_per_unit=self.mm_per_unit, g=g)
            else:
                sj.io.save_exports(sj.load_material(self.source), self.output)
        print(self.output)


def _with_coefficients(source: str) -> sj.Material:
    """Load a material for OpenPBR, which does not need Gaussians if there are coefficients."""
    try:
        medium = sj.load_medium(source)
    except ValueError:  # a material of Gaussians, layers or pigments
        return sj.load_material(source)
    surface: dict[str, Any] = {"eta": medium.eta[0]} | sj.io.surface_and_source(source)[0]
    unused = sj.SumOfGaussians([1.0], medium.eta[None])
    return sj.Material(unused, **surface, medium=medium)


def _row(name: str) -> tuple[str, ...]:
    material, (_, source) = sj.load_material(name), sj.io.surface_and_source(name)
    try:
        kinds = {sj.LayeredMultipole: "layers", sj.scattering.Skin: "pigments"}
        kind = kinds.get(type(sj.load_profile(name)), "coefficients")
    except ValueError:
        kind = "Gaussians"
    citation = source["citation"]
    authors, year = (re.findall(r"^(.+?) (\d{4})", citation) or [(citation, "")])[0]
    first, *coauthors = re.split(r", | and ", authors)
    return (
        name,
        kind,
        "  ".join(f"{float(total):.3f}" for total in material.total_reflectance()),
        f"{float(material.gaussians.variances.max()) ** 0.5:.3g}",
        f"{float(material.eta):.3g}",
        f"{first}{' et al.' if coauthors else ''} {year}".rstrip(),
    )


def _picture(name: str) -> np.ndarray:
    """Render a material on the bust, in the color of the material."""
    view = Render(material=name, albedo=False, count=20_000, scale=0.2, width=120, height=120)
    return np.asarray(sj.render(*view.open()).beauty)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Sample splats from a mesh with maps, and write them as PLY, in mm.

    The mesh is a GLB, glTF, OBJ, PLY, STL or OFF file.

    Example: splatjax sample head.glb --albedo color.jpg --mm-per-unit 53 --count 683549 --output
    head.ply
    """

    #: The file of the mesh.
    mesh: tyro.conf.Positional[Path]
    #: Length of the file's unit, mm; 1000 for meters.
    mm_per_unit: float
    #: The PLY file to write.
    output: Path
    #: Number of splats.
    count: int = 200_000
    #: Seed of the random positions.
    seed: int = 0
    #: Place splats on a curved surface that follows the normals of the mesh, instead of on flat
    #: triangles.
    rounded: bool = True
    #: Upward axis of the file; splats have +y up.
    up: UpAxis = "y"
    #: Angle between triangles above which an edge is hard, degrees, if the file has no normals, or
    #: normals that differ from their triangles by more than this.
    crease_angle: float = 40.0
    #: Map of the mesh's diffuse color, sRGB. By default the texture of the file, if any.
    albedo: OptionalPath = None
    #: Gray map of factors of the material's specular strength.
    specular: OptionalPath = None
    #: Gray map of the fraction of --second in the surface, from 0 (black) to 1 (white).
    share: OptionalPath = None
    #: With --share, the material with which the splats will be rendered.
    material: Annotated[str, tyro.conf.arg(metavar="MATERIAL")] = "skin_light"
    #: With --share, the second material.
    second: Annotated[str | None, tyro.conf.arg(metavar="MATERIAL", help_behavior_hint="")] = None
    #: Tangent-space normal map; green points up.
    normal: OptionalPath = None
    v_up: Annotated[
        bool | None,
        tyro.conf.arg(
            metavar="{True,False}",
            help="Whether v = 0 is the lower edge of a map. The format determines the default: "
            "true for OBJ, false for glTF and GLB. If the texture is upside down, give "
            "the opposite.",
            help_behavior_hint="",
        ),
    ] = None
    #: Height, in the file's unit, below which the mesh is removed.
    crop_min_y: OptionalFloat = None

    def run(self) -> None:
        check_output(self.output, (".ply",))
        check_options(
            self,
            {
                "second": (
                    (self.share is None) == (self.second is None),
                    "be a material if --share, a map, is given, and only then",
                )
            },
        )
        if self.share is None:
            check_unused(self, ["material"], "it is only for --share")
        excluded = {"mesh", "count", "output", "material", "second", "share"}
        options = {key: vars(self)[key] for key in vars(self).keys() - excluded}
        if self.second is not None:
            with jax.enable_x64(True):
                own, other = (sj.load_material(n).gaussians for n in (self.material, self.second))
                change = np.asarray(sj.fitting.weight_factors(own, other)) - 1
            options["parameters"] = {"share": self.share}
            options["weights"] = lambda values: 1 + values["share"][:, None, None] * change[None]
        with stage(f"sampling {self.mesh} with {self.count} splats"):
            splats = sj.sample_mesh(self.mesh, self.count, **options)
        with stage(f"writing {self.output}"):
            sj.write_splats(self.output, splats)
        carried = [
            name
            for name in ("albedo", "specular", "roughness", "weights")
            if getattr(splats, name) is not None
        ]
        size, area = np.ptp(np.asarray(splats.centers), axis=0), float(splats.areas.sum())
        if np.linalg.norm(splats.areas @ splats.normals) > _OPEN * area:
            note(
                f"{self.mesh}: its surface is open; too much light leaves near its borders, and it "
                "cannot be exported as a volume; close the holes, or keep them out of the picture"
            )
        note(
            f"{splats.count} splats on {area:.4g} mm^2, with "
            f"{', '.join(carried) or 'no maps'}; the body is {size[0]:.3g} mm wide, {size[1]:.3g} "
            f"high and {size[2]:.3g} deep"
        )
        if not _SMALLEST < np.max(size) < _LARGEST:
            note("this is an unusual size; check --mm-per-unit")
        print(self.output)
