"""`splatjax recover`: from pictures of a known shape to a material."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import tyro
from rich.console import Console

import splatjax as sj
from splatjax._format import counted
from splatjax.io import (
    fingerprint,
    material_path,
    own_version,
    picture_paths,
    read_record,
    write_record,
)

from ._models import Model
from ._options import MaterialNames, OptionalFloat, OptionalPath
from ._outputs import FIGURES, check_output, save_figure
from ._report import note, stage

_START = (
    "Materials to start from, within a factor of three in both coefficients: names, "
    "or paths of TOML files. The best end counts."
)
_LARGEST_ETA = 3.0
"""Of any translucent solid: diamond has 2.4."""
_MODELS = {Model.DIPOLE: sj.Dipole, Model.BETTER_DIPOLE: sj.BetterDipole}


@dataclass(frozen=True, kw_only=True)
class Recover:
    """Find the absorption and scattering of a material from pictures of a known shape.

    Both come with error bars; what the pictures do not fix is said, and which one to take next.
    They are listed in a TOML file, each with its camera, its lights, and what is known of noise and
    intensity:

        [[pictures]]
        file = "left.exr"
        noise = 0.01             # over the picture's root mean square, if it is known
        intensity = "unknown"    # or "known", the default, or "unknown color"
        camera = { position = [0, 0, 500], target = [0, 0, 0], fov = 25 }
        [[pictures.lights]]
        kind = "directional"
        direction = [1, -0.3, -0.5]
        irradiance = [3.14, 3.14, 3.14]

    A light is also of kind "point" (position, intensity) or "beam" (origin, direction, power,
    variance).

    Albedo of the splats is not used: the coefficients carry all color. Interrupt it, and the same
    command goes on from the best medium it knew.

    Example: splatjax recover head.ply pictures.toml --start skin1 marble --output mine.toml
    --report mine.png
    """

    #: PLY file of splats, in mm (`splatjax sample` makes one).
    splats: tyro.conf.Positional[Path]
    #: TOML file that lists the pictures.
    pictures: tyro.conf.Positional[Path]
    start: Annotated[MaterialNames, tyro.conf.arg(help=_START)] = ("skin1", "marble")
    #: Index of refraction, which is not searched. Without it, that of the first start.
    eta: OptionalFloat = None
    #: TOML file to write the material to.
    output: Path = Path("recovered.toml")
    #: Picture to write of what was seen, what was recovered and what is left: .png, .pdf or .svg.
    report: OptionalPath = None
    #: dipole or better-dipole.
    model: tyro.conf.EnumChoicesFromValues[Model] = Model.DIPOLE
    #: Number of Gaussians.
    count: int = 6
    #: Let pixels that are far off count less: highlights, dust, what the model does not know.
    robust: bool = False
    #: Strength of the specular lobe, if the pictures show one.
    specular: float = 0.0
    #: Of the specular lobe.
    roughness: float = 0.3
    #: Say which picture would tell most, of some that could be taken from where the first was.
    suggest: bool = True

    def run(self) -> None:
        """Load, recover, say, write."""
        check_output(self.output, (".toml",))
        if self.report is not None:
            check_output(self.report, FIGURES)
        if self.model not in _MODELS:
            raise ValueError(
                f"--model {self.model.value} cannot be searched; take "
                f"{' or '.join(m.value for m in _MODELS)}"
            )
        if not self.start:
            raise ValueError("--start names no material; give one or more (`splatjax materials`)")
        if self.eta is not None and not 1 <= self.eta <= _LARGEST_ETA:
            raise ValueError(
                f"--eta is {self.eta:g}; it must lie between 1 and {_LARGEST_ETA:g}: marble has "
                "1.5, skin 1.4"
            )
        for name in self.start:
            sj.load_medium(name)  # says at once what is wrong with it
        with stage(f"reading {self.splats} and {self.pictures}"):
            observations = sj.read_observations(self.pictures)
            splats = sj.read_splats(self.splats)
        splats = sj.Splats(splats.centers, splats.normals, splats.radii, splats.areas)
        with jax.enable_x64(True):
            self._run(observations, splats)

    def _run(self, observations: list[sj.Observation], splats: sj.Splats) -> None:
        starts = self._starts(observations[0].picture.shape[2])
        surface = sj.Material(
            sj.SumOfGaussians(jnp.ones(1), jnp.ones((1, starts[0].eta.shape[0]))),
            eta=starts[0].eta[0],
            specular=self.specular,
            roughness=self.roughness,
        )
        begin, kept, made = time.perf_counter(), self._kept(), self._made()

        def say(said: str, medium: sj.Medium) -> None:
            note(f"{time.perf_counter() - begin:6.1f} s  {said}")
            if medium is starts[0]:  # nothing is found yet
                return
            found = {
                "sigma_a": medium.sigma_a.tolist(),
                "sigma_s_prime": medium.sigma_s_prime.tolist(),
            }
            write_record(kept, {"made of": made, **found})

        recovery = sj.recover(
            observations,
            splats,
            starts,
            surface=surface,
            model=_MODELS[self.model],
            count=self.count,
            loss=sj.HuberLoss() if self.robust else sj.SquaredLoss(),
            progress=say,
            throw=False,
        )
        if recovery.result != optx.RESULTS.successful:
            raise ValueError(
                f"{self.pictures}: the search did not settle in {self._effort(recovery)}; the same "
                "command goes on where it stopped, or --start names materials that are nearer"
            )
        note(f"{time.perf_counter() - begin:6.1f} s  found, after {self._effort(recovery)}")
        Console(highlight=False, soft_wrap=True).print(recovery.summary(), markup=False)
        if self.suggest:
            self._suggest(recovery, observations, splats)
        self._save(recovery)
        kept.unlink(missing_ok=True)
        print(self.output)
        if self.report is not None:
            from splatjax.plots import plot_recovery  # loads matplotlib

            save_figure(
                plot_recovery(
                    recovery, title=f"{self.output.stem}: {counted(len(observations), 'picture')}"
                ),
                self.report,
            )
            print(self.report)

    def _starts(self, channels: int) -> list[sj.Medium]:
        """Give the media to start from: where an interrupted search had come to, if there was
        one.
        """
        known = [sj.load_medium(name) for name in self.start]
        for name, medium in zip(self.start, known, strict=True):
            if medium.eta.shape[0] != channels:
                raise ValueError(
                    f"--start {name} has {medium.eta.shape[0]} channels, the pictures have "
                    f"{channels}; name another"
                )
        eta = known[0].eta if self.eta is None else jnp.full_like(known[0].eta, self.eta)
        starts = [sj.Medium(medium.sigma_a, medium.sigma_s_prime, eta) for medium in known]
        kept = self._kept()
        if not kept.exists():
            return starts
        record = read_record(kept)
        if record.get("made of") != self._made():
            note(f"{kept}: is of another search, and is not used")
            return starts
        note(f"{kept}: an interrupted search goes on")
        return [
            sj.Medium(jnp.asarray(record["sigma_a"]), jnp.asarray(record["sigma_s_prime"]), eta)
        ]

    def _effort(self, recovery: sj.Recovery) -> str:
        return f"{counted(recovery.rounds, 'round')} and {counted(recovery.steps, 'step')}"

    def _kept(self) -> Path:
        return self.output.with_suffix(".search.json")

    def _made(self) -> dict[str, Any]:
        """Give all that a search depends on."""
        files = [
            self.splats,
            *picture_paths(self.pictures),
            *(material_path(name) for name in self.start),
        ]
        options = {
            "model": self.model.value,
            "count": self.count,
            "robust": self.robust,
            "eta": self.eta,
            "specular": self.specular,
        }
        return {
            "files": [fingerprint(file) for file in files],
            **options,
            "roughness": self.roughness,
            "splatjax": own_version(),
        }

    def _suggest(
        self, recovery: sj.Recovery, observations: list[sj.Observation], splats: sj.Splats
    ) -> None:
        candidates = sj.default_candidates(
            splats, observations[0].camera, observations[0].picture.shape[2]
        )
        with stage(f"looking at {len(candidates)} pictures that could be taken next"):
            predictions = sj.next_pictures(recovery, splats, candidates, model=_MODELS[self.model])
        print("what one more picture would do, the best first:")
        for prediction in predictions:
            print(f"  {prediction}")

    def _save(self, recovery: sj.Recovery) -> None:
        errors = recovery.relative_errors()
        sj.save_material(
            recovery.material,
            self.output,
            profile=_MODELS[self.model](recovery.medium),
            source={
                "provenance": (
                    f"recovered by splatjax {own_version()} from the pictures of "
                    f"{self.pictures.name}, on the shape {self.splats.name}"
                ),
                "relative_error_of_sigma_a": np.asarray(errors[0]).tolist(),
                "relative_error_of_sigma_s_prime": np.asarray(errors[1]).tolist(),
                "chi_squared": float(recovery.chi_squared),
            },
            fit={
                "variances_of": "all channels",
                "weights_of": "non-negative, sum held to the total reflectance",
            },
        )
