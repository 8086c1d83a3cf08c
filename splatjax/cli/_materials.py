"""`splatjax materials`: what is in the library."""

import re
from dataclasses import dataclass
from typing import Annotated

import tyro

import splatjax as sj
from splatjax.io import material_path, surface_and_source

from ._report import print_table

_MATERIAL = (
    "Print the file of this one: coefficients, source, Gaussians. A beginning of "
    "one's own. Without it, list all."
)


@dataclass(frozen=True)
class Materials:
    """List the materials of the library, or print one.

    Their names serve `splatjax render --material` and, where coefficients or layers are known,
    `splatjax fit`.

    Example: splatjax materials marble > mine.toml
    """

    material: Annotated[
        tyro.conf.Positional[str | None],
        tyro.conf.arg(metavar="[MATERIAL]", help=_MATERIAL, help_behavior_hint=""),
    ] = None

    def run(self) -> None:
        """Print one line per material, or the file of one."""
        if self.material is not None:
            print(material_path(self.material).read_text(encoding="utf-8"), end="")
            return
        columns = {
            "material": "left",
            "known": "left",
            "total reflectance": "right",
            "widest, mm": "right",
            "eta": "right",
            "source": "left",
        }
        print_table(columns, map(_row, sj.materials()))


def _row(name: str) -> tuple[str, ...]:
    material = sj.load_material(name)
    reflectance = "  ".join(f"{float(total):.3f}" for total in material.total_reflectance())
    widest = float(material.gaussians.variances.max()) ** 0.5
    numbers = reflectance, f"{widest:.3g}", f"{float(material.eta):.3g}"
    return name, _known(name), *numbers, _publication(name)


def _known(name: str) -> str:
    try:
        profile = sj.load_profile(name)
    except ValueError:
        return "Gaussians"
    return "layers" if isinstance(profile, sj.LayeredMultipole) else "coefficients"


def _publication(name: str) -> str:
    """Return the first author and the year of a material's publication."""
    citation = surface_and_source(name)[1]["citation"]
    authors, year = re.findall(r"^(.+?) (\d{4})", citation)[0]
    first, *others = re.split(r", | and ", authors)
    return f"{first}{' et al.' if others else ''} {year}"
