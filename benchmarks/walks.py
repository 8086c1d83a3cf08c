"""How fast photons walk, beside plain C on one thread: `python -m benchmarks.walks`. Compile times
are given apart.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import splatjax as sj

CASES = {
    "skin1 green, half space": (4_000_000, 0.17, 0.88, 0.0, 1.3, float("inf")),
    "marble green, half space": (400_000, 0.0041, 2.62, 0.0, 1.5, float("inf")),
    "marble green, slab of 2 mm": (4_000_000, 0.0041, 2.62, 0.0, 1.5, 2.0),
    "van de Hulst's slab, g 0.75": (16_000_000, 1.0, 9.0, 0.75, 1.0, 0.2),
}
"""Photons, sigma_a, sigma_s (1/mm), g, eta, thickness (mm)."""


def arguments():
    parser = argparse.ArgumentParser(prog="python -m benchmarks.walks", description=__doc__)
    parser.add_argument(
        "--repeats", type=int, default=5, help="medians are given (default %(default)s)"
    )
    parser.add_argument(
        "--share", type=float, default=1.0, help="of the photons of each case (default %(default)s)"
    )
    return parser.parse_args()


def build(folder: Path) -> Path:
    """Compile the C walk, or say what is missing and leave."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise SystemExit("no C compiler (gcc or cc): there is nothing to compare with")
    program = folder / "walk"
    source = Path(__file__).with_name("walk.c")
    subprocess.run(
        [compiler, "-O3", "-march=native", "-ffast-math", "-o", program, source, "-lm"], check=True
    )
    return program


def walk(
    photons: int, sigma_a: float, sigma_s: float, g: float, eta: float, thickness: float, seed: int
):
    one = (jnp.asarray([each], jnp.float32) for each in (sigma_a, sigma_s * (1 - g), eta))
    phase = sj.HenyeyGreenstein(jnp.asarray(g, jnp.float32)) if g else sj.Isotropic()
    layer = sj.Layer(sj.Medium(*one), jnp.asarray(thickness, jnp.float32))
    begin = time.perf_counter()
    found = jax.block_until_ready(
        sj.monte_carlo([layer], photons, jax.random.key(seed), phase=phase)
    )
    return found, time.perf_counter() - begin


def main() -> None:
    options = arguments()
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        for name, (photons, *case) in CASES.items():
            photons = max(2, int(photons * options.share))
            words = [str(each if each < float("inf") else 1e30) for each in (photons, *case)]
            _, first = walk(2, *case, seed=0)
            ours, theirs, ratios = [], [], []
            for seed in range(options.repeats):
                found, seconds = walk(photons, *case, seed=seed)
                output = subprocess.run(
                    [program, *words], capture_output=True, text=True, check=True
                ).stdout
                reference = json.loads(output)
                flights = photons * reference["flights"] * 1e-6
                ours.append(flights / seconds)
                theirs.append(flights / reference["seconds"])
                ratios.append(ours[-1] / theirs[-1])
            value, error = (
                float(found.total_reflectance.value[0]),
                float(found.total_reflectance.deviation[0]),
            )
            print(
                f"{name}: {statistics.median(ours):.1f} million flights/s, C "
                f"{statistics.median(theirs):.1f}, "
                f"ratio {statistics.median(ratios):.2f}; R {value:.5f} +- {error:.5f}, C "
                f"{reference['reflectance']:.5f}; "
                f"{reference['flights']:.1f} flights a photon; first call {first:.1f} s",
                flush=True,
            )


if __name__ == "__main__":
    main()
