"""`splatjax fit`: from optical coefficients to a sum of Gaussians."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import optimistix as optx
import tyro
from rich.console import Console
from rich.table import Table

import splatjax as sj
from splatjax._format import channel_names, counted
from splatjax.fitting import AbstractWeights
from splatjax.io import own_version, read_picture, surface_and_source
from splatjax.scattering import measure_laser_dot

from ._fit_all import fit_all
from ._models import Model, Reference, reference
from ._options import OptionalFloat, OptionalPath
from ._outputs import FIGURES, check_output, save_figure
from ._report import note, stage

_COEFFICIENTS, _PROFILE, _PHOTOGRAPH = "coefficients", "a measured profile", "a photograph"
_KINDS = {".csv": _PROFILE, ".exr": _PHOTOGRAPH}
_OPTIONS = {
    _COEFFICIENTS: ("model", "cut", "photons", "single_scattering"),
    _PROFILE: ("mm_per_unit",),
    _PHOTOGRAPH: ("mm_per_pixel", "power"),
}
"""What each kind of input alone has use for."""
_MEDIUM = (
    "Name of a material (`splatjax materials`), or path: of a TOML file with a [medium] or "
    "[[layers]], of a CSV file with radii "
    "and a column per channel, or of an EXR file with a linear photograph of a laser dot."
)
_ALL = (
    "Fit all media of a CSV file, whose columns are sigma_a, sigma_s_prime (1/mm), eta, and a name "
    "if you like; --output is a "
    "CSV file then. Batches that are finished stay: after an interruption, run the same command "
    "again. Where a launcher has "
    "started several processes (docs/devices.md), they share the work."
)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit a sum of Gaussians to a diffusion profile, and print it with its errors.

    The profile is that of a medium, that of layers, a measured one, or that of a laser dot in a
    photograph. Double precision. Variances are shared by the channels. Weights are not negative,
    and their sum is held at the total reflectance of the profile, so that the picture keeps its
    energy, unless --free is given. To measured profiles, whose totals are not known, weights are
    fitted freely, but not below zero.

    A medium is taken for what --model says: the dipole, which publications use, or one that comes
    nearer to the truth, or the truth itself (docs/which_profile.md).

    Examples: splatjax fit marble --count 6 --output marble.toml --plot marble.png
              splatjax fit media.csv --all --output fits.csv
    """

    medium: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help=_MEDIUM)]
    #: Number of Gaussians.
    count: int = 6
    #: Take the least number of Gaussians, up to 12, that leaves no channel a larger error (Eq. 4),
    #: instead of --count.
    error: OptionalFloat = None
    #: Of coefficients: what makes a profile of them. The layers of a material are multipoles, or
    #: are walked by Monte Carlo.
    model: tyro.conf.EnumChoicesFromValues[Model] = Model.DIPOLE
    #: Of photon beams and Monte Carlo, which are infinite at the origin: the fit begins at so many
    #: mean free paths, or at 0.2.
    cut: OptionalFloat = None
    #: Of Monte Carlo: how many walk.
    photons: int = 1_000_000
    #: Of photon beams and Monte Carlo: keep light that scatters once as a term of its own, and fit
    #: Gaussians to the rest.
    single_scattering: bool = False
    #: Leave the weights free: the least error of Eq. 3, which may miss some of the energy.
    free: bool = False
    #: Of a CSV file: its unit of length, mm.
    mm_per_unit: float = 1.0
    #: Of a photograph: the size of a pixel on the surface, mm.
    mm_per_pixel: OptionalFloat = None
    #: Of a photograph: the light that enters the material, in W if the picture is in W/(mm^2 sr).
    power: float = 1.0
    all: Annotated[bool, tyro.conf.arg(help=_ALL)] = False
    #: TOML file to write the material to.
    output: OptionalPath = None
    #: Picture to write of profile, fit and error: .png, .pdf or .svg.
    plot: OptionalPath = None

    def run(self) -> None:
        """Fit, print, write."""
        if self.all:
            self._run_all()
            return
        if self.output is not None:
            check_output(self.output, (".toml",))
        if self.plot is not None:
            check_output(self.plot, FIGURES)
        with jax.enable_x64(True):
            self._run()

    def _run_all(self) -> None:
        if self.output is None:
            raise ValueError("--all needs --output, a CSV file for what is fitted")
        check_output(self.output, (".csv",))
        usual = Fit(
            medium=self.medium, all=True, count=self.count, free=self.free, output=self.output
        )
        if usual != self:
            raise ValueError(
                "--all fits dipoles by --count and --free alone; leave the other options out"
            )
        if not 1 <= self.count <= 8:
            raise ValueError(f"--count is {self.count}; with --all it lies between 1 and 8")
        weights = (
            sj.FreeWeights() if self.free else sj.NonNegativeWeights(sj.FixedTotalReflectance())
        )
        with jax.enable_x64(True):
            fit_all(Path(self.medium), self.output, self.count, weights)

    def _check_options(self) -> None:
        """Refuse what has no effect on this kind of input."""
        kind = _KINDS.get(Path(self.medium).suffix.lower(), _COEFFICIENTS)
        given = {field.name for field in fields(self) if getattr(self, field.name) != field.default}
        for other, names in _OPTIONS.items():
            for name in names:
                if other != kind and name in given:
                    option = f"--{name.replace('_', '-')}"
                    raise ValueError(
                        f"{option} is for {other}, and {self.medium} is taken for {kind}; leave it "
                        "out"
                    )

    def _run(self) -> None:
        self._check_options()
        if self.count > (most := sj.LeastCount.largest):
            raise ValueError(
                f"--count is {self.count}; it lies between 1 and {most}, as many as --error takes"
            )
        if self.error is not None and not self.error > 0:
            raise ValueError(f"--error is {self.error:g}; it must be positive, such as 0.01")
        coefficients = self._coefficients()
        if isinstance(coefficients, sj.Tabulated):
            made = Reference(coefficients, sj.L2_QUADRATURE)
        else:
            made = reference(
                coefficients, self.model, self.cut, self.photons, self.single_scattering
            )
        profile = made.profile
        count = self.count if self.error is None else sj.LeastCount(self.error)
        wanted = (
            counted(self.count, "Gaussian")
            if self.error is None
            else f"Gaussians to an error of {self.error:g}"
        )
        if (
            isinstance(coefficients, sj.Tabulated)
            and self.error is None
            and 2 * self.count > len(coefficients.radii)
        ):
            note(
                f"{self.medium} has {len(coefficients.radii)} radii, too few to tell {wanted} "
                "apart: give a smaller --count"
            )
        with stage(f"fitting to {self.medium}: {wanted}"):
            weights = self._weights(coefficients)
            fitted = jax.block_until_ready(
                sj.fit_gaussians(profile, count, weights=weights, rule=made.rule, throw=False)
            )
            if fitted.result != optx.RESULTS.successful:
                raise ValueError(self._unsettled(len(fitted.gaussians.variances)))
        _print(fitted)
        total = fitted.gaussians.total_reflectance()
        if float(jnp.max(total)) > 1 + 1e-3:
            note(
                f"{self.medium} sends back {_numbers(total, '.3g')} times the light it is given: "
                "are its unit and power right?"
            )
        if self.output is not None:
            self._save(self.output, coefficients, made, fitted)
            print(self.output)
        if self.plot is not None:
            from splatjax.plots import plot_fit  # loads matplotlib

            found = len(fitted.gaussians.variances)
            figure = plot_fit(
                profile,
                fitted.gaussians,
                rule=made.rule,
                title=f"{self.medium}, {counted(found, 'Gaussian')}",
            )
            save_figure(figure, self.plot)
            print(self.plot)

    def _unsettled(self, count: int) -> str:
        told = f"{self.medium}: the search for {counted(count, 'Gaussian')} did not settle"
        if self.model is Model.MONTE_CARLO:
            return (
                f"{told}; {self.photons} photons tell too little apart:"
                " give more --photons, or a smaller --count"
            )
        return f"{told}; give a smaller --count"

    def _coefficients(self) -> sj.Dipole | sj.LayeredMultipole | sj.Tabulated:
        match Path(self.medium).suffix.lower():
            case ".csv":
                return sj.read_profile(self.medium, mm_per_unit=self.mm_per_unit)
            case ".exr":
                if self.mm_per_pixel is None:
                    raise ValueError(
                        f"{self.medium}: how large is a pixel on the surface? give --mm-per-pixel"
                    )
                image = read_picture(self.medium)
                try:
                    return measure_laser_dot(image, self.mm_per_pixel, power=self.power).profile
                except ValueError as error:
                    raise ValueError(f"{self.medium}: {error}") from None
            case _:
                return sj.load_profile(self.medium)

    def _weights(self, profile: sj.AbstractProfile) -> AbstractWeights:
        if self.free:
            return sj.FreeWeights()
        return sj.NonNegativeWeights(
            sj.FreeWeights() if isinstance(profile, sj.Tabulated) else sj.FixedTotalReflectance()
        )

    def _save(
        self,
        output: Path,
        coefficients: sj.Dipole | sj.LayeredMultipole | sj.Tabulated,
        made: Reference,
        fitted: sj.FitResult,
    ) -> None:
        # The index of a surface is that of the medium it bounds, if one is known; the rest is what
        # the file says, if it says it.
        measured = isinstance(coefficients, sj.Tabulated)
        fitted_to = f"{'profile' if measured else 'coefficients'} of {self.medium}"
        source = {"provenance": f"fitted by splatjax {own_version()} to the {fitted_to}"}
        how = {
            "variances_of": "all channels",
            "weights_of": self._weights_of(measured),
            "error": fitted.error,
            "energy_error": fitted.energy_error,
        }
        if measured:
            sj.save_material(
                sj.Material(fitted.gaussians),
                output,
                source=source,
                fit={"profile": "measured"} | how,
            )
        else:
            medium = (
                coefficients.medium
                if isinstance(coefficients, sj.Dipole)
                else coefficients.top.medium
            )
            surface, said = surface_and_source(self.medium)
            source = said | {
                "provenance": "; ".join(
                    [*filter(None, [said.get("provenance")]), source["provenance"]]
                )
            }
            material = sj.Material(
                fitted.gaussians,
                **({"eta": medium.eta[0]} | surface),
                single_scattering=made.single,
            )
            known = (sj.Dipole, sj.BetterDipole, sj.PhotonBeam, sj.LayeredMultipole)
            if not isinstance(made.profile, known):
                model = (
                    "photon beam"
                    if self.model is Model.PHOTON_BEAM
                    else f"Monte Carlo, {self.photons} photons"
                )
                how["profile"] = (
                    model if made.single is None else f"{model}, without single scattering"
                )
            profile = made.profile if isinstance(made.profile, known) else coefficients
            sj.save_material(material, output, profile=profile, source=source, fit=how)

    def _weights_of(self, measured: bool) -> str:
        if self.free:
            return "free"
        return "non-negative" if measured else "non-negative, sum held to the total reflectance"


def _print(fitted: sj.FitResult) -> None:
    table = Table(box=None, pad_edge=False)
    names = ", ".join(channel_names(fitted.gaussians.weights.shape[1]))
    for title in ("variance, mm^2", f"weights ({names})"):
        table.add_column(title, justify="right", no_wrap=True)
    for variance, weights in zip(fitted.gaussians.variances, fitted.gaussians.weights, strict=True):
        table.add_row(f"{float(variance):.6g}", _numbers(weights, ".5f"))
    table.add_row("sum", _numbers(fitted.gaussians.total_reflectance(), ".5f"))
    table.add_row("error (Eq. 4)", _numbers(fitted.error, ".2e"))
    table.add_row("energy error", _numbers(fitted.energy_error, ".2e"))
    Console(highlight=False).print(table)


def _numbers(values: jax.Array, form: str) -> str:
    return "  ".join(f"{float(value):{form}}" for value in values)
