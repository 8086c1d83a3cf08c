"""`splatjax recover`: a material from pictures of a known shape."""

import functools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import tyro

import splatjax as sj
from splatjax._format import counted

from ._models import model_by_name
from ._terminal import (
    FIGURES,
    OptionalFloat,
    OptionalPath,
    check_options,
    check_output,
    note,
    save_figure,
    stage,
)

# Largest index of refraction of a translucent solid; diamond has 2.4.
_LARGEST_ETA = 3.0
_COEFFICIENTS = ("sigma_a", "sigma_s_prime")


@dataclass(frozen=True, kw_only=True)
class Recover:
    """Recover the absorption and scattering of a material from pictures of a known shape.

    The result includes error bars, the combinations that the pictures do not determine, and the
    best picture to take next. A TOML file lists the pictures with their cameras and lights, and
    optionally noise and intensity:

        [[pictures]]
        file = "left.exr"
        noise = 0.01             # relative to the picture's root mean square, if it is known
        intensity = "unknown"    # or "known", the default, or "unknown color"
        camera = { position = [0, 0, 500], target = [0, 0, 0], fov = 25 }
        [[pictures.lights]]
        kind = "directional"
        direction = [1, -0.3, -0.5]
        irradiance = [3.14, 3.14, 3.14]

    Other kinds of lights are "point" (position, intensity), "spot" (position, direction,
    intensity), "beam" (origin, direction, power, variance), "rectangle" (center, edges, radiance),
    "disk" (center, direction, radius, radiance), "sphere" (center, radius, radiance) and
    "environment" (image).

    The albedo of the splats is not used; the coefficients determine all color. After an
    interruption, run the same command again to continue from the best medium so far.

    Example: splatjax recover head.ply pictures.toml --start skin1 marble --output mine.toml
    --report mine.png
    """

    #: PLY file of splats, in mm (`splatjax sample` writes one).
    splats: tyro.conf.Positional[Path]
    #: TOML file that lists the pictures.
    pictures: tyro.conf.Positional[Path]
    start: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="MATERIAL [MATERIAL ...]",
            help="Materials to start from, within a factor of three in both coefficients, as "
            "names or paths of TOML files. The best result is kept.",
        ),
    ] = ("skin1", "marble")
    #: Index of refraction, which is not fitted. By default that of the first start.
    eta: OptionalFloat = None
    #: TOML file to write the material to.
    output: Path = Path("recovered.toml")
    #: File for a plot of the input, the recovered picture and the residual: .png, .pdf or .svg.
    report: OptionalPath = None
    #: Model of the profile of the coefficients (docs/which_profile.md).
    model: Literal["photon-beam", "dipole", "better-dipole"] = "photon-beam"
    #: Mean cosine of the phase function, for photon beams.
    g: float = 0.0
    #: Number of Gaussians.
    count: int = 6
    #: Reduce the weight of outliers, such as highlights, dust and effects outside the model.
    robust: bool = False
    #: Strength of the specular lobe, if the pictures show one.
    specular: float = 0.0
    #: Roughness of the specular lobe.
    roughness: float = 0.3
    #: Report the best picture to take next, among candidates with the camera of the first picture.
    suggest: bool = True

    def run(self) -> None:
        check_output(self.output, (".toml",))
        check_output(self.report, FIGURES)
        most = sj.fitting.LeastCount.max_count
        check_options(
            self,
            {
                "eta": (
                    self.eta is None or 1 <= self.eta <= _LARGEST_ETA,
                    f"lie between 1 and {_LARGEST_ETA:g}: marble has 1.5, skin 1.4",
                ),
                "g": (abs(self.g) <= 0.95, "lie between -0.95 and 0.95"),
                "count": (1 <= self.count <= most, f"lie between 1 and {most}"),
                "start": (
                    len(self.start) > 0,
                    "name one or more materials (`splatjax materials` lists them)",
                ),
            },
        )
        model_by_name(self.model, self.g)  # raise errors before the pictures are read
        for name in self.start:
            sj.load_medium(name)
        with stage(f"reading {self.splats} and {self.pictures}"):
            observations = sj.io.read_observations(self.pictures)
            splats = sj.read_splats(self.splats)
        splats = sj.Splats(splats.centers, splats.normals, splats.radii, splats.areas)
        with jax.enable_x64(True):
            self._run(observations, splats)

    def _run(self, observations: list[sj.inverse.Observation], splats: sj.Splats) -> None:
        search = self.output.with_suffix(".search.json")
        files = [
            self.splats,
            *sj.io.picture_paths(self.pictures),
            *map(sj.io.material_path, self.start),
        ]
        dependencies = {
            "files": [sj.io.fingerprint(file) for file in files],
            "model": self.model,
            "g": self.g,
            "count": self.count,
            "robust": self.robust,
            "eta": self.eta,
            "specular": self.specular,
            "roughness": self.roughness,
            "splatjax": sj.__version__,
        }
        starts = self._starts(search, dependencies, observations[0].picture.shape[2])
        note(
            f"not fitted: the index of refraction, {float(starts[0].eta[0]):g} (--eta), and the "
            f"strength of the specular lobe, {self.specular:g} (--specular)"
        )
        begin = time.perf_counter()

        def report(message: str, medium: sj.Medium) -> None:
            note(f"{time.perf_counter() - begin:6.1f} s  {message}")
            if medium is not starts[0]:
                values = {name: getattr(medium, name).tolist() for name in _COEFFICIENTS}
                sj.io.write_record(search, {"made of": dependencies, **values})

        gaussians = sj.SumOfGaussians(jnp.ones(1), jnp.ones((1, starts[0].eta.shape[0])))
        message = "compiling for a minute or two; cached for later runs"
        with sj.cache.watched_compiling(functools.cache(functools.partial(note, message))):
            recovery = sj.inverse.recover(
                observations,
                splats,
                starts,
                surface=sj.Material(gaussians, starts[0].eta[0], self.specular, self.roughness),
                model=model_by_name(self.model, self.g),
                count=self.count,
                loss=sj.inverse.HuberLoss() if self.robust else sj.inverse.SquaredLoss(),
                progress=report,
            )
        settled = recovery.result == optx.RESULTS.successful
        effort = f"{counted(recovery.rounds, 'round')} and {counted(recovery.steps, 'step')}"
        note(
            f"{time.perf_counter() - begin:6.1f} s  {'found' if settled else 'ended'}, "
            f"after {effort}"
        )
        if not settled:
            report("kept", recovery.medium)
            note(
                f"{self.pictures}: the search did not converge, and this is its best round; "
                "run the same command again to resume, or give closer materials as --start"
            )
        print(recovery.summary())
        if self.suggest:
            self._suggest(recovery, observations, splats)
        self._save(recovery)
        if settled:
            search.unlink(missing_ok=True)
        print(self.output)
        if self.report is not None:
            from splatjax.plots import plot_recovery  # loads matplotlib

            title = f"{self.output.stem}: {counted(len(observations), 'picture')}"
            save_figure(plot_recovery(recovery, title=title), self.report)

    def _starts(self, search: Path, dependencies: dict[str, Any], channels: int) -> list[sj.Medium]:
        """Return the media to start from, or the best medium of an interrupted search if there is
        one.
        """
        media = [sj.load_medium(name) for name in self.start]
        for name, medium in zip(self.start, media, strict=True):
            if medium.eta.shape[0] != channels:
                raise ValueError(
                    f"--start {name} has {medium.eta.shape[0]} channels, but the pictures have "
                    f"{channels}; give another material"
                )
        eta = media[0].eta if self.eta is None else jnp.full_like(media[0].eta, self.eta)
        starts = [sj.Medium(medium.sigma_a, medium.sigma_s_prime, eta) for medium in media]
        if not search.exists():
            return starts
        record = sj.io.read_record(search)
        if record.get("made of") != dependencies:
            note(f"{search}: belongs to another search and is not used")
            return starts
        note(f"{search}: resuming an interrupted search")
        return [sj.Medium(*(jnp.asarray(record[name]) for name in _COEFFICIENTS), eta)]

    def _suggest(
        self,
        recovery: sj.inverse.Recovery,
        observations: list[sj.inverse.Observation],
        splats: sj.Splats,
    ) -> None:
        first = observations[0]
        candidates = sj.inverse.default_candidates(splats, first.camera, first.picture.shape[2])
        with stage(f"evaluating {len(candidates)} pictures that could be taken next"):
            predictions = sj.inverse.next_pictures(recovery, splats, candidates)
        print("predicted gain of one more picture, best first:")
        print(*(f"  {prediction}" for prediction in predictions), sep="\n")

    def _save(self, recovery: sj.inverse.Recovery) -> None:
        errors, model = recovery.relative_errors(), recovery.model
        sj.save_material(
            recovery.material,
            self.output,
            profile=model.profile(recovery.medium),
            source={
                "provenance": (
                    f"recovered by splatjax {sj.__version__} from the pictures of "
                    f"{self.pictures.name}, on the shape {self.splats.name}"
                ),
                "relative_error_of_sigma_a": np.asarray(errors[0]).tolist(),
                "relative_error_of_sigma_s_prime": np.asarray(errors[1]).tolist(),
                **({"chi_squared": float(recovery.chi_squared)} if recovery.noise_is_known else {}),
            },
            fit={
                **({} if model.description is None else {"profile": model.description}),
                "variances_of": "all channels",
                "weights_of": "non-negative, sum held to the total reflectance",
            },
            g=self.g,
        )
