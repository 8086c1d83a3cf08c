"""`splatjax fit --all`: many media, a batch at a time; what is finished stays, and all of it
becomes one table.
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
from splatjax.fitting import AbstractWeights
from splatjax.io import (
    fingerprint,
    join_tables,
    own_version,
    read_column,
    read_media,
    read_record,
    write_columns,
    write_record,
)

from ._processes import own_share
from ._report import note, progress

_TOGETHER = 500  # media in one call
_RECORD = "fits.json"


def fit_all(media: Path, output: Path, count: int, weights: AbstractWeights) -> None:
    """Fit sums of Gaussians to the dipoles of the media of a table, and write one table.

    Batches lie in a folder beside it until all are there. Where a launcher has started several
    processes they share them.

    **Raises:** `ValueError` where the folder holds fits of something else.
    """
    record = {
        "media": fingerprint(media),
        "--count": count,
        "weights": type(weights).__name__,
        "splatjax": own_version(),
        "jax": jax.__version__,
    }
    folder = output.with_name(f"{output.name}.parts")
    if (folder / _RECORD).exists() and read_record(folder / _RECORD) != record:
        raise ValueError(
            f"{folder}: holds fits of something else; delete that folder, or name another --output"
        )
    names, coefficients = read_media(media)
    begins = range(0, len(names), _TOGETHER)
    parts = [folder / f"from_{begin:08}.csv" for begin in begins]
    missing = [i for i, part in enumerate(parts) if not part.exists()]
    if len(missing) < len(parts):
        note(f"{len(parts) - len(missing)} of {len(parts)} batches are there already, and kept")
    own = own_share().of(missing)  # which waits: all have seen the same batches missing
    if own:
        folder.mkdir(exist_ok=True)
        write_record(folder / _RECORD, record)
        with progress(
            f"fitting {count} Gaussians to {len(names)} media, {_TOGETHER} at a time", len(own)
        ) as one_more:
            for i in own:
                part = slice(begins[i], begins[i] + _TOGETHER)
                write_columns(
                    parts[i], {"name": names[part]} | _fitted(coefficients[part], count, weights)
                )
                one_more()
    if output.exists() and not folder.exists():  # joined by another process
        return
    if not all(part.exists() for part in parts):
        note(
            "other processes are still at work; the one that finds every batch there joins them, "
            "or the same command again"
        )
        return
    try:
        join_tables(output, parts)
    except (
        FileNotFoundError
    ) as error:  # another process found every batch at the same time, and has joined them
        if not output.exists() or str(error.filename) not in map(str, parts):
            raise
    shutil.rmtree(folder, ignore_errors=True)
    note(_how_many_converged(output))
    print(output)


def _how_many_converged(table: Path) -> str:
    converged = read_column(table, "converged")
    failed = int(np.sum(converged == 0))
    if not failed:
        return f"all {len(converged)} fits converged"
    return f"{failed} of {len(converged)} fits did not converge; in their rows `converged` is 0"


@eqx.filter_jit
def _fit_each(coefficients: Float[Array, "media 3"], starts, count: int, weights: AbstractWeights):
    def fit(row):
        medium = sj.Medium(row[0:1], row[1:2], row[2:3])
        start = sj.GivenVariances(starts(medium, count).variances[0])
        fitted = sj.fit_gaussians(
            sj.Dipole(medium), count, start=start, weights=weights, throw=False
        )
        return fitted, fitted.result == optx.RESULTS.successful

    return eqx.filter_vmap(fit)(coefficients)


def _fitted(
    coefficients: np.ndarray, count: int, weights: AbstractWeights
) -> dict[str, np.ndarray]:
    """Give the columns of a batch; a smaller one is filled up, so that one program serves all."""
    given = len(coefficients)
    whole = np.pad(coefficients, ((0, _TOGETHER - given), (0, 0)), mode="edge")
    found, converged = _fit_each(jnp.asarray(whole), sj.dipole_starts(), count, weights)
    columns = dict(zip(("sigma_a", "sigma_s_prime", "eta"), coefficients.T, strict=True))
    columns |= {f"variance_{i + 1}": found.gaussians.variances[:, i] for i in range(count)}
    columns |= {f"weight_{i + 1}": found.gaussians.weights[:, i, 0] for i in range(count)}
    columns |= {
        "error": found.error[:, 0],
        "energy_error": found.energy_error[:, 0],
        "converged": converged.astype(float),
    }
    return {name: np.asarray(column)[:given] for name, column in columns.items()}
