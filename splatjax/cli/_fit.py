"""`splatjax fit`: sums of Gaussians for optical coefficients; with --all, for many media in
batches, which are kept and joined to one table at the end.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import optimistix as optx
import tyro

import splatjax as sj
from splatjax._format import counted, format_numbers

from . import _models
from ._terminal import (
    FIGURES,
    OptionalFloat,
    OptionalPath,
    check_options,
    check_output,
    check_unused,
    complete,
    note,
    process_index_and_count,
    save_figure,
    stage,
)

_COEFFICIENTS, _PROFILE, _PHOTOGRAPH = "coefficients", "a measured profile", "a photograph"
# Error above which a note is printed, and the ratio of channel widths that explains it.
_KINDS = {".csv": _PROFILE, ".exr": _PHOTOGRAPH}
_OF_ALL = {"medium", "count", "model", "g", "output", "all"}
# Options for only one kind of input.
_OPTIONS = {
    _COEFFICIENTS: ("model", "photons", "g", "single_scattering"),
    _PROFILE: ("mm_per_unit",),
    _PHOTOGRAPH: ("mm_per_pixel", "power"),
}


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Fit a sum of Gaussians to a diffusion profile, and print it with its errors.

    The profile is that of a medium, of layers, of a measurement, or of a laser dot in a photograph.
    The fit uses double precision. All channels share the variances. Weights are non-negative and
    sum to the total reflectance of the profile, so that the picture keeps its energy. The total of
    a measured profile is unknown, so its weights are only non-negative.

    --model selects the profile of a medium: the photon beam, with the total and the angles of light
    transport; the dipole, which most publications use; or Monte Carlo light transport. See
    docs/which_profile.md.

    Examples: splatjax fit marble --count 6 --output marble.toml --plot marble.png
              splatjax fit media.csv --all --output fits.csv
    """

    medium: Annotated[
        tyro.conf.Positional[str],
        tyro.conf.arg(
            help="Name of a material (`splatjax materials`), or path of a TOML file with a "
            "[medium], [openpbr], [[layers]], [skin] or [burley], of a CSV file with radii and a "
            "column per channel, or of an EXR file with a linear photograph of a laser dot."
        ),
    ]
    #: Number of Gaussians.
    count: int = 6
    #: Largest error (Eq. 4) of any channel. The fit then uses the least number of Gaussians that
    #: reaches this error, up to 12, instead of --count.
    error: OptionalFloat = None
    #: Model of the profile of coefficients: photon-beam (default), dipole, better-dipole or
    #: monte-carlo. Layers use the multipole or monte-carlo.
    model: Annotated[
        _models.Model | None, tyro.conf.arg(metavar="MODEL", help_behavior_hint="")
    ] = None
    #: Mean cosine of the Henyey-Greenstein phase function, for photon beams and Monte Carlo. By
    #: default the value in the file, or 0.
    g: OptionalFloat = None
    #: Number of photons for Monte Carlo.
    photons: int = 1_000_000
    #: Keep light that is scattered once as a separate term, and fit Gaussians to the rest; for
    #: photon beams and Monte Carlo.
    single_scattering: bool = False
    #: Unit of length of a CSV file, mm.
    mm_per_unit: float = 1.0
    #: Width of a pixel of a photograph on the surface, mm.
    mm_per_pixel: OptionalFloat = None
    #: Power that enters the material in a photograph, in W if the picture is in W/(mm^2 sr).
    power: float = 1.0
    all: Annotated[
        bool,
        tyro.conf.arg(
            help="Fit all media of a CSV file, with the columns sigma_a, sigma_s_prime "
            "(1/mm), eta, and optionally a name; --output is then a CSV file. Finished "
            "batches are kept; after an interruption, run the same command again. If a "
            "launcher starts several processes (docs/devices.md), they share the work."
        ),
    ] = False
    #: TOML file to write the material to.
    output: OptionalPath = None
    #: File for a plot of profile, fit and error: .png, .pdf or .svg.
    plot: OptionalPath = None

    def run(self) -> None:
        check_output(self.output, (".csv",) if self.all else (".toml",))
        check_output(self.plot, FIGURES)
        most = 8 if self.all else sj.fitting.LeastCount.max_count
        check_options(
            self,
            {
                "model": (
                    not self.all or self.model != "monte-carlo",
                    "be photon-beam, dipole or better-dipole with --all",
                ),
                "count": (1 <= self.count <= most, f"lie between 1 and {most}"),
                "error": (self.error is None or self.error > 0, "be positive, such as 0.01"),
                "g": (self.g is None or abs(self.g) <= 0.95, "lie between -0.95 and 0.95"),
            },
        )
        if self.model != "monte-carlo":
            check_unused(self, ["photons"], "--model is not monte-carlo")
        with jax.enable_x64(True):
            self._run_all() if self.all else self._run()

    def _run_all(self) -> None:
        """Fit the media of a table in batches that are kept in a folder until all exist. The
        processes of a launcher share the batches.
        """
        if self.output is None:
            raise ValueError("--all needs --output, a CSV file for the fits")
        check_unused(self, vars(self).keys() - _OF_ALL, "--all takes only --count, --model and --g")
        model = _models.model_by_name(self.model, self.g or 0.0)
        names, coefficients = sj.io.read_media(Path(self.medium))
        path = self.output.with_name(f"{self.output.name}.parts")
        begins = range(0, len(names), _models.BATCH)
        parts = [path / f"from_{begin:08}.csv" for begin in begins]

        def fit(i: int) -> None:
            batch = slice(begins[i], begins[i] + _models.BATCH)
            sj.io.write_columns(
                parts[i],
                {"name": names[batch]} | _models.fit_batch(coefficients[batch], self.count, model),
            )

        done = complete(
            process_index_and_count(),
            path / "fits.json",
            {
                "media": sj.io.fingerprint(self.medium),
                "--count": self.count,
                "--model": self.model,
                "--g": self.g,
                "splatjax": sj.__version__,
                "jax": jax.__version__,
            },
            [(part,) for part in parts],
            lambda: fit,
            name="batches",
            what=f"fitting {self.count} Gaussians to {len(names)} media, {_models.BATCH} at a time",
        )
        if len(done) < len(parts):
            return
        try:
            tables = [sj.io.read_columns(part) for part in parts]
        except FileNotFoundError:  # another process joined the batches at the same time
            if not self.output.exists():
                raise
            return
        columns = {name: [cell for table in tables for cell in table[name]] for name in tables[0]}
        sj.io.write_columns(self.output, columns)
        shutil.rmtree(path, ignore_errors=True)
        failed = columns["converged"].count("0.0")
        note(
            f"{failed} of {len(names)} fits did not converge; in their rows `converged` is 0"
            if failed
            else f"all {len(names)} fits converged"
        )
        print(self.output)

    def _run(self) -> None:
        coefficients, target = self._target()
        fitted = self._fitted(target)
        _models.print_fit(fitted, target)
        if isinstance(coefficients, sj.Dipole):
            paths = format_numbers(1 / coefficients.medium.sigma_t_prime, ".3g")
            note(
                f"{self.medium}: mean free path {paths} mm; the fit hardly weights smaller radii, "
                "where errors of tens of percent are usual"
            )
        _models.note_error(self.medium, target, fitted)
        total = fitted.gaussians.total_reflectance()
        if float(total.max()) > 1 + 1e-3:
            note(
                f"{self.medium} reflects {format_numbers(total, '.3g')} times the light that "
                "it receives; check its unit and power"
            )
        if self.output is not None:
            self._save(self.output, coefficients, target, fitted)
            print(self.output)
        if self.plot is not None:
            from splatjax.plots import plot_fit  # loads matplotlib

            title = f"{self.medium}, {counted(len(fitted.gaussians.variances), 'Gaussian')}"
            figure = plot_fit(target.profile, fitted.gaussians, rule=target.rule, title=title)
            save_figure(figure, self.plot)

    def _target(self) -> tuple[_models.Coefficients | None, _models.Reference]:
        """Read the input, and return its coefficients (`None` if it is measured) and the profile to
        fit. Raise `ValueError` for options without effect on this kind of input.
        """
        kind = _KINDS.get(Path(self.medium).suffix.lower(), _COEFFICIENTS)
        for intended, names in _OPTIONS.items():
            if intended != kind:
                check_unused(self, names, f"{self.medium} is read as {kind}, not as {intended}")
        if kind == _COEFFICIENTS:
            coefficients = sj.load_profile(self.medium)
            needs_g = self.g is not None or self.model not in ("dipole", "better-dipole")
            g = self._mean_cosine() if needs_g else 0.0
            is_rgb = "wavelengths" not in sj.io.surface_and_source(self.medium)[0]
            with sj.io.naming(self.medium):
                return coefficients, _models.reference(
                    coefficients, self.model, self.photons, g, self.single_scattering, is_rgb
                )
        if kind == _PROFILE:
            measured = sj.io.read_profile(self.medium, mm_per_unit=self.mm_per_unit)
        elif self.mm_per_pixel is None:
            raise ValueError(
                f"{self.medium}: the size of a pixel on the surface is unknown; give --mm-per-pixel"
            )
        else:
            image = sj.io.read_picture(self.medium)
            with sj.io.naming(self.medium):
                measured = sj.scattering.measure_laser_dot(
                    image, self.mm_per_pixel, power=self.power
                ).profile
        if self.error is None and 2 * self.count > len(measured.radii):
            note(
                f"{self.medium} has {len(measured.radii)} radii, too few to determine "
                f"{counted(self.count, 'Gaussian')}; give a smaller --count"
            )
        return None, _models.Reference(
            measured,
            description="measured",
            weights=sj.fitting.NonNegativeWeights(sj.fitting.FreeWeights()),
        )

    def _fitted(self, target: _models.Reference) -> sj.fitting.FitResult:
        count = self.count if self.error is None else sj.fitting.LeastCount(self.error)
        goal = (
            counted(self.count, "Gaussian")
            if self.error is None
            else f"Gaussians to an error of {self.error:g}"
        )
        with stage(f"fitting to {self.medium}: {goal}"):
            fitted = sj.fit_gaussians(
                target.profile, count, weights=target.weights, rule=target.rule, throw=False
            )
            if jax.block_until_ready(fitted).result != optx.RESULTS.successful:
                more = f"more --photons than {self.photons}, or "
                raise ValueError(
                    f"{self.medium}: the search for "
                    f"{counted(len(fitted.gaussians.variances), 'Gaussian')} did not converge; "
                    f"give {more if self.model == 'monte-carlo' else ''}a smaller --count"
                )
        return fitted

    def _save(
        self,
        output: Path,
        coefficients: _models.Coefficients | None,
        target: _models.Reference,
        fitted: sj.fitting.FitResult,
    ) -> None:
        surface, source = dict[str, Any](), dict[str, Any]()
        if coefficients is not None:
            # The index of the surface is that of the medium, unless the file specifies it.
            is_layered = isinstance(coefficients, sj.LayeredMultipole)
            top = coefficients.top if is_layered else coefficients
            surface, source = sj.io.surface_and_source(self.medium)
            if not isinstance(top, sj.scattering.Burley):
                eta = top.eta if isinstance(top, sj.scattering.Skin) else top.medium.eta[0]
                surface.setdefault("eta", eta)
        fitted_by = (
            f"fitted by splatjax {sj.__version__} to the "
            f"{'profile' if coefficients is None else 'coefficients'} of {self.medium}"
        )
        before = source.get("provenance", "").split("; fitted by splatjax")[0]
        sj.save_material(
            sj.Material(
                fitted.gaussians, **surface, single_scattering=target.single, angles=target.angles
            ),
            output,
            profile=target.profile if target.description is None else coefficients,
            source=source | {"provenance": "; ".join(filter(None, [before, fitted_by]))},
            fit={
                **({} if target.description is None else {"profile": target.description}),
                "variances_of": "all channels",
                "weights_of": (
                    "non-negative"
                    if coefficients is None
                    else "non-negative, sum held to the total reflectance"
                ),
                "error": fitted.error,
                "energy_error": fitted.energy_error,
            },
            g=self._mean_cosine() if isinstance(coefficients, sj.Dipole) else 0.0,
        )

    def _mean_cosine(self) -> float:
        return sj.io.load_mean_cosine(self.medium) if self.g is None else self.g
