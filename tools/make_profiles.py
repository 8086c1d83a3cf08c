"""Fit the materials in profiles/ again: `python tools/make_profiles.py [name ...]`, all of them by
default; `python tools/make_profiles.py --starts` tabulates where fits of dipoles start.

Each file is what `splatjax fit NAME --output FILE` writes, with eight Gaussians for media whose
light goes very far. A material without coefficients was published as Gaussians, and is unchanged.

The starts, profiles/dipole_starts.npz, are the best fits of 1 to 8 Gaussians to dipoles over
reduced albedo and index of refraction, by the full search, in float64.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.cli._fit import Fit
from splatjax.io import atomic_path, profiles_folder

COUNTS = {"cream": 8, "spectralon": 8}
ROOTS = np.linspace(0, 0.98, 15)  # of 1 - albedo'
ETAS = np.linspace(1.0, 2.0, 5)


def write(name: str, path: Path) -> None:
    """Write a material's file with a new fit."""
    Fit(medium=name, output=path, count=COUNTS.get(name, 6)).run()


def write_starts(path: Path) -> None:
    """Tabulate the logarithms of the best variances."""
    absorbed, eta = (grid.ravel() for grid in np.meshgrid(ROOTS**2, ETAS, indexing="ij"))
    tables, spread = {}, sj.fitting.VariancesPerChannel()
    with jax.enable_x64(True):
        medium = sj.Medium(jnp.asarray(absorbed), jnp.asarray(1 - absorbed), jnp.asarray(eta))
        for count in range(1, 9):
            fitted = sj.fit_gaussians(sj.Dipole(medium), count, spread=spread)
            shape = len(ROOTS), len(ETAS), count
            logarithms = np.log(np.asarray(fitted.gaussians.variances)).reshape(shape)
            tables[f"log_variances_{count}"] = logarithms.astype(np.float32)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, roots=ROOTS, etas=ETAS, **tables)


def main(names: list[str]) -> None:
    if names == ["--starts"]:
        write_starts(profiles_folder() / "dipole_starts.npz")
        return
    for name in names or sj.io.list_materials():
        path = profiles_folder() / f"{name}.toml"
        if {"[medium]", "[[layers]]", "[skin]"} & {*path.read_text(encoding="utf-8").splitlines()}:
            write(name, path)


if __name__ == "__main__":
    main(sys.argv[1:])
