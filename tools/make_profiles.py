"""Fit the materials in profiles/ again: `python tools/make_profiles.py [name ...]`, all of them by
default; `python tools/make_profiles.py --starts` tabulates where fits of dipoles start.

Each file keeps its coefficients, [surface] and [source]; [fit] is replaced by six Gaussians for the
dipole, or the multipole of the layers, with exact Fresnel moments, their variances shared by the
channels, the weights of each channel non-negative and summing to its total reflectance; fitted in
float64. A material without coefficients was published as Gaussians, and is left unchanged.

The starts, profiles/dipole_starts.npz, are the best fits of 1 to 8 Gaussians over reduced albedo
and index of refraction, by the full search, in float64.
"""

import sys
import tomllib
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import splatjax as sj
from splatjax.io import atomic_path, profiles_folder

COUNT, DIGITS = 6, 8
ROOTS = np.linspace(0, 0.98, 15)  # of 1 - albedo'
ETAS = np.linspace(1.0, 2.0, 5)
SETTINGS = {
    "variances_of": "all channels",
    "weights_of": "non-negative, sum held to the total reflectance",
}


def fit_material(name: str) -> sj.fitting.FitResult:
    """Return the fit that a material is shipped with."""
    with jax.enable_x64(True):
        weights = sj.fitting.NonNegativeWeights(sj.fitting.FixedTotalReflectance())
        return sj.fit_gaussians(sj.load_profile(name), COUNT, weights=weights)


def write(name: str, path: Path, tables: dict) -> sj.fitting.FitResult:
    """Write a material's file with a new fit."""
    fitted = fit_material(name)
    with jax.enable_x64(True):
        gaussians = jax.tree.map(lambda leaf: rounded(leaf, DIGITS), fitted.gaussians)
        settings = SETTINGS | {"error": rounded(fitted.error, 4)}
        material, profile = sj.Material(gaussians, **tables["surface"]), sj.load_profile(name)
    sj.save_material(material, path, profile=profile, source=tables["source"], fit=settings)
    return fitted


def rounded(values: jax.Array, digits: int) -> jax.Array:
    """Round to so many significant digits."""
    round_one = np.vectorize(lambda x: float(f"{x:.{digits - 1}e}"))
    return jnp.asarray(round_one(np.asarray(values)))


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
    for name in names or sj.list_materials():
        path = profiles_folder() / f"{name}.toml"
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        if {"medium", "layers"} & set(tables):
            print(f"{name}: E = {', '.join(f'{x:.2e}' for x in write(name, path, tables).error)}")


if __name__ == "__main__":
    main(sys.argv[1:])
