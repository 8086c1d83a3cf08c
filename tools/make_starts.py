"""Tabulate anew where fits of dipoles start: `python tools/make_starts.py`; writes
profiles/dipole_starts.npz.

The best fits of 1 to 8 Gaussians over reduced albedo and index of refraction, by the full search,
in float64.
"""

import jax
import jax.numpy as jnp
import numpy as np

from splatjax.fitting import VariancesPerChannel, fit_gaussians
from splatjax.io import atomic_path, profiles_folder
from splatjax.scattering import Dipole, Medium

ROOTS = np.linspace(0, 0.98, 15)  # of 1 - albedo'
ETAS = np.linspace(1.0, 2.0, 5)
COUNTS = range(1, 9)


def main() -> None:
    absorbed, eta = (each.ravel() for each in np.meshgrid(ROOTS**2, ETAS, indexing="ij"))
    tables = {}
    with jax.enable_x64(True):
        medium = Medium(*(jnp.asarray(each) for each in (absorbed, 1 - absorbed, eta)))
        for count in COUNTS:
            fitted = fit_gaussians(Dipole(medium), count, spread=VariancesPerChannel())
            log_variances = np.log(np.asarray(fitted.gaussians.variances)).reshape(
                len(ROOTS), len(ETAS), count
            )
            tables[f"log_variances_{count}"] = log_variances.astype(np.float32)
            print(
                f"{count} Gaussians: E from {fitted.error.min():.1e} to {fitted.error.max():.1e}",
                flush=True,
            )
    path = profiles_folder() / "dipole_starts.npz"
    with atomic_path(path) as written, open(written, "wb") as file:
        np.savez_compressed(file, roots=ROOTS, etas=ETAS, **tables)
    print(path)


if __name__ == "__main__":
    main()
