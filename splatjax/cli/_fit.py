"""`splatjax fit`: from optical coefficients to a sum of Gaussians."""

from dataclasses import dataclass

import jax
import tyro
from rich.console import Console
from rich.table import Table

import splatjax as sj

from ._outputs import OptionalPath, check_output
from ._report import stage


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit a sum of Gaussians to the diffusion profile of a medium (the dipole) or of layers (multipoles), and print it with its
    errors.

    Double precision. Variances are shared by the channels. Weights are not negative, and their sum is held at the total
    reflectance of the profile, so that the picture keeps its energy, unless --free is given.

    Example: splatjax fit marble --count 6 --output marble.toml --plot marble.png
    """

    medium: tyro.conf.Positional[str]
    """Name of a material (`splatjax materials`), or path of a TOML file with a [medium] or [[layers]]."""
    count: int = 6
    """Number of Gaussians."""
    free: bool = False
    """Leave the weights free: the least error of Eq. 3, which may miss some of the energy."""
    output: OptionalPath = None
    """TOML file to write the material to."""
    plot: OptionalPath = None
    """Picture to write of profile, fit and error: .png, .pdf or .svg."""

    def run(self) -> None:
        """Fit, print, write."""
        if self.output is not None:
            check_output(self.output, (".toml",))
        if self.plot is not None:
            check_output(self.plot, (".png", ".pdf", ".svg"))
        with jax.enable_x64(True):
            self._run()

    def _run(self) -> None:
        profile = sj.load_profile(self.medium)
        weights = sj.FreeWeights() if self.free else sj.NonNegativeWeights(sj.TotalReflectanceHeld())
        with stage(f"fitting {self.count} Gaussians to {self.medium}"):
            fitted = jax.block_until_ready(sj.fit_gaussians(profile, self.count, weights=weights))
        _print(fitted)
        if self.output is not None:
            # The surface keeps the library's defaults; its index is that of the medium it bounds.
            medium = profile.medium if isinstance(profile, sj.Dipole) else profile.top.medium
            material = sj.Material(fitted.gaussians, eta=medium.eta[0])
            source = {"provenance": f"fitted by splatjax {sj.__version__} to the coefficients of {self.medium}"}
            sj.save_material(material, self.output, profile=profile, source=source, fit=self._how(fitted))
            print(self.output)
        if self.plot is not None:
            from splatjax.io import atomic_path
            from splatjax.plots import plot_fit  # loads matplotlib

            figure = plot_fit(profile, fitted.gaussians, title=f"{self.medium}, {self.count} Gaussians")
            with atomic_path(self.plot) as written:
                figure.savefig(written)
            print(self.plot)

    def _how(self, fitted: sj.FitResult) -> dict[str, object]:
        return {
            "variances_of": "all channels",
            "weights_of": "free" if self.free else "non-negative, sum held to the total reflectance",
            "error": fitted.error,
            "energy_error": fitted.energy_error,
        }


def _print(fitted: sj.FitResult) -> None:
    table = Table(box=None, pad_edge=False)
    for title in ("variance, mm^2", "weights"):
        table.add_column(title, justify="right", no_wrap=True)
    for variance, weights in zip(fitted.gaussians.variances, fitted.gaussians.weights, strict=True):
        table.add_row(f"{float(variance):.6g}", _numbers(weights, ".5f"))
    table.add_row("sum", _numbers(fitted.gaussians.total_reflectance(), ".5f"))
    table.add_row("error (Eq. 4)", _numbers(fitted.error, ".2e"))
    table.add_row("energy error", _numbers(fitted.energy_error, ".2e"))
    Console(highlight=False).print(table)


def _numbers(values: jax.Array, form: str) -> str:
    return "  ".join(f"{float(value):{form}}" for value in values)
