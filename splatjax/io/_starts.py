"""The table of starts that comes with the package."""

import functools

import jax.numpy as jnp
import numpy as np

from splatjax.fitting import DipoleStarts

from ._materials import profiles_folder


def dipole_starts() -> DipoleStarts:
    r"""Give where fits of 1 to 8 Gaussians to dipoles start: one descent then finds what a search
    would.

        fit_gaussians(Dipole(medium), 6, spread=VariancesPerChannel(), start=dipole_starts()(medium,
        6))

    **Returns:** a `DipoleStarts` in JAX's default precision. `tools/make_profiles.py` made it.
    """
    tables, dtype = _tables(), jnp.result_type(float)
    counts = sum(name.startswith("log_variances_") for name in tables)
    log_variances = tuple(
        jnp.asarray(tables[f"log_variances_{count}"], dtype) for count in range(1, counts + 1)
    )
    return DipoleStarts(
        jnp.asarray(tables["roots"], dtype), jnp.asarray(tables["etas"], dtype), log_variances
    )


@functools.cache
def _tables() -> dict[str, np.ndarray]:
    with np.load(profiles_folder() / "dipole_starts.npz") as file:
        return dict(file)
