"""`splatjax materials`: what is in the library; `splatjax export`: it in the terms of other
renderers.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import tyro

import splatjax as sj

from ._terminal import check_output, print_table


@dataclass(frozen=True)
class Materials:
    """List the materials of the library, or print one.

    Their names serve `splatjax render --material` and, where coefficients or layers are known,
    `splatjax fit`.

    Example: splatjax materials marble > mine.toml
    """

    material: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(
            metavar="[MATERIAL]",
            help="Print the file of this one: coefficients, source, Gaussians. A beginning of "
            "one's own. Without it, list all.",
            help_behavior_hint="",
        ),
    ] = None

    def run(self) -> None:
        if self.material is not None:
            print(sj.io.material_path(self.material).read_text(encoding="utf-8"), end="")
            return
        titles = ("material", "known", "total reflectance", "widest, mm", "eta", "source")
        print_table([titles, *map(_row, sj.list_materials())])


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write a material's Gaussians as JSON for other renderers.

    Each entry with formula, unit and source: GPU Gems weights, a kernel for separable subsurface
    scattering, Burley's d, the shape parameter of Unity's HDRP, Blender's radius.

    Example: splatjax export skin --output skin.json
    """

    #: Name of a material (`splatjax materials`), or path of a TOML file with a [fit].
    material: tyro.conf.Positional[str]
    #: JSON file to write.
    output: Path

    def run(self) -> None:
        check_output(self.output, (".json",))
        with jax.enable_x64(True):
            sj.io.save_exports(sj.load_material(self.material), self.output)
        print(self.output)


def _row(name: str) -> tuple[str, ...]:
    material, (_, source) = sj.load_material(name), sj.io.surface_and_source(name)
    try:
        layered = isinstance(sj.load_profile(name), sj.LayeredMultipole)
        known = "layers" if layered else "coefficients"
    except ValueError:
        known = "Gaussians"
    reflectance = "  ".join(f"{float(total):.3f}" for total in material.total_reflectance())
    widest = float(material.gaussians.variances.max()) ** 0.5
    authors, year = re.findall(r"^(.+?) (\d{4})", source["citation"])[0]
    first, *others = re.split(r", | and ", authors)
    publication = f"{first}{' et al.' if others else ''} {year}"
    return name, known, reflectance, f"{widest:.3g}", f"{float(material.eta):.3g}", publication
