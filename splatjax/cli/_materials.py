"""`splatjax materials`: what is in the library."""

import re
from dataclasses import dataclass
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

import splatjax as sj
from splatjax.io import material_path, surface_and_source

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
        table = Table(box=None, pad_edge=False)
        for title in ("material", "known", "total reflectance", "widest, mm", "eta", "source"):
            justify = "right" if title in ("total reflectance", "widest, mm", "eta") else "left"
            table.add_column(title, justify=justify, no_wrap=True)
        for name in sj.list_materials():
            material = sj.load_material(name)
            reflectance = "  ".join(f"{float(share):.3f}" for share in material.total_reflectance())
            widest = float(material.gaussians.variances.max()) ** 0.5
            table.add_row(
                name,
                _known(name),
                reflectance,
                f"{widest:.3g}",
                f"{float(material.eta):.3g}",
                _publication(name),
            )
        console = Console(highlight=False)
        if not console.is_terminal:
            console.width = 200  # in a pipe, a line stays whole
        console.print(table)


def _known(name: str) -> str:
    try:
        return (
            "layers" if isinstance(sj.load_profile(name), sj.LayeredMultipole) else "coefficients"
        )
    except ValueError:
        return "Gaussians"


def _publication(name: str) -> str:
    """Give the first author's name and the year of where a material comes from."""
    authors, year = re.findall(r"^(.+?) (\d{4})", surface_and_source(name)[1]["citation"])[0]
    first, *others = re.split(r", | and ", authors)
    return f"{first}{' et al.' if others else ''} {year}"
