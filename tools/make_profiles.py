"""Fit the materials in profiles/ anew: `python tools/make_profiles.py [name ...]`, all of them by
default.

Each file keeps its coefficients, [surface] and [source]; [fit] is written anew: six Gaussians for
the dipole, or the multipole of the layers, with exact Fresnel moments, their variances shared by
the channels, the weights of each channel non-negative and summing to its total reflectance; fitted
in float64. A material without coefficients was published as Gaussians, and is left as it is.
"""

import sys
import tomllib

import jax
import numpy as np

from splatjax.fitting import FitResult, NonNegativeWeights, TotalReflectanceHeld, fit_gaussians
from splatjax.gaussians import SumOfGaussians
from splatjax.io import list_materials, load_profile, profiles_folder, save_material
from splatjax.scene import Material

COUNT = 6
DIGITS = 8
SETTINGS = {
    "variances_of": "all channels",
    "weights_of": "non-negative, sum held to the total reflectance",
}


def fit_material(name: str) -> FitResult:
    """Give the fit that a material is shipped with."""
    with jax.enable_x64(True):
        return fit_gaussians(
            load_profile(name), COUNT, weights=NonNegativeWeights(TotalReflectanceHeld())
        )


def write(name: str) -> FitResult:
    """Write a material's file with a new fit."""
    path = profiles_folder() / f"{name}.toml"
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    fitted = fit_material(name)
    with jax.enable_x64(True):
        gaussians = SumOfGaussians(
            _rounded(fitted.gaussians.variances), _rounded(fitted.gaussians.weights)
        )
        found = {"error": _rounded(fitted.error, 4)}
        material = Material(gaussians, **tables["surface"])
        profile = load_profile(name)
    save_material(material, path, profile=profile, source=tables["source"], fit=SETTINGS | found)
    return fitted


def _rounded(values: jax.Array, digits: int = DIGITS) -> jax.Array:
    return jax.numpy.asarray(
        np.vectorize(lambda x: float(f"{x:.{digits - 1}e}"))(np.asarray(values))
    )


def main(names: list[str]) -> None:
    for name in names or list_materials():
        if not {"medium", "layers"} & set(
            tomllib.loads((profiles_folder() / f"{name}.toml").read_text(encoding="utf-8"))
        ):
            print(f"{name}: as published")
            continue
        print(f"{name}: E = {', '.join(f'{x:.2e}' for x in write(name).error)}")


if __name__ == "__main__":
    main(sys.argv[1:])
