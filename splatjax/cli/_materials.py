"""`splatjax materials`: what is in the library."""

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

import splatjax as sj


@dataclass(frozen=True)
class Materials:
    """List the materials of the library: their names serve `splatjax render --material` and, where a medium stands behind
    them, `splatjax fit`."""

    def run(self) -> None:
        """Print one line per material."""
        table = Table(box=None, pad_edge=False)
        for title in ("material", "Gaussians", "widest, mm", "total reflectance", "eta"):
            table.add_column(title, justify="left" if title == "material" else "right", no_wrap=True)
        for name in sj.materials():
            material = sj.load_material(name)
            gaussians = material.gaussians
            reflectance = "  ".join(f"{float(share):.3f}" for share in material.total_reflectance())
            widest = float(gaussians.variances.max()) ** 0.5
            table.add_row(name, str(len(gaussians.variances)), f"{widest:.3g}", reflectance, f"{float(material.eta):.3g}")
        Console(highlight=False).print(table)
