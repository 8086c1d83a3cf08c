"""`splatjax fit --all`: many media, a batch at a time; finished batches are kept, and become one
table in the end.
"""

import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

import splatjax as sj
from splatjax.io import fingerprint, read_columns, read_media, write_columns

from ._models import MEDIUM_WEIGHTS
from ._resumable import complete
from ._terminal import note

_BATCH = 500  # media in one call


def fit_all(media: Path, output: Path, count: int) -> None:
    """Fit sums of Gaussians to the dipoles of the media of a table, and write one table.

    Batches lie in a folder beside it until all are there. Where a launcher has started several
    processes they share them.

    **Raises:** `ValueError` where the folder holds fits of something else.
    """
    names, coefficients = read_media(media)
    record = {
        "media": fingerprint(media),
        "--count": count,
        "splatjax": sj.__version__,
        "jax": jax.__version__,
    }
    path, begins = output.with_name(f"{output.name}.parts"), range(0, len(names), _BATCH)
    parts = [path / f"from_{begin:08}.csv" for begin in begins]

    def fit(i: int) -> None:
        batch = slice(begins[i], begins[i] + _BATCH)
        columns = _fitted(coefficients[batch], count)
        write_columns(parts[i], {"name": names[batch]} | columns)

    what = f"fitting {count} Gaussians to {len(names)} media, {_BATCH} at a time"
    items = [(part,) for part in parts]
    done = complete(path / "fits.json", record, items, lambda: fit, name="batches", what=what)
    if len(done) < len(parts):
        return
    try:
        tables = [read_columns(part) for part in parts]
    except FileNotFoundError:  # another process has joined them at the same time
        if not output.exists():
            raise
        return
    columns = {name: [cell for table in tables for cell in table[name]] for name in tables[0]}
    write_columns(output, columns)
    shutil.rmtree(path, ignore_errors=True)
    failed = columns["converged"].count("0.0")
    note(
        f"{failed} of {len(names)} fits did not converge; in their rows `converged` is 0"
        if failed
        else f"all {len(names)} fits converged"
    )
    print(output)


@eqx.filter_jit
def _fit_each(coefficients: Float[Array, "media 3"], starts: sj.fitting.DipoleStarts, count: int):
    def fit(row):
        medium = sj.Medium(row[0:1], row[1:2], row[2:3])
        start = sj.fitting.GivenVariances(starts(medium, count).variances[0])
        profile = sj.Dipole(medium)
        fitted = sj.fit_gaussians(profile, count, start=start, weights=MEDIUM_WEIGHTS, throw=False)
        return fitted, fitted.result == optx.RESULTS.successful

    return eqx.filter_vmap(fit)(coefficients)


def _fitted(coefficients: np.ndarray, count: int) -> dict[str, np.ndarray]:
    """Return the columns of a batch. A smaller batch is padded, so that one program serves all."""
    given = len(coefficients)
    padded = np.pad(coefficients, ((0, _BATCH - given), (0, 0)), mode="edge")
    fitted, converged = _fit_each(jnp.asarray(padded), sj.io.dipole_starts(), count)
    columns = dict(zip(("sigma_a", "sigma_s_prime", "eta"), padded.T, strict=True))
    columns |= {f"variance_{i + 1}": fitted.gaussians.variances[:, i] for i in range(count)}
    columns |= {f"weight_{i + 1}": fitted.gaussians.weights[:, i, 0] for i in range(count)}
    columns |= {
        "error": fitted.error[:, 0],
        "energy_error": fitted.energy_error[:, 0],
        "converged": converged.astype(float),
    }
    return {name: np.asarray(column)[:given] for name, column in columns.items()}
