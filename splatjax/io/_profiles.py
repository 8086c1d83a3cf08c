"""Measured profiles."""

import csv
import math
import os
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from splatjax.scattering import Tabulated

from ._files import check_unit, existing_file
from ._tables import rounded

_UNITS = {"mm": 1.0, "cm": 10.0, "um": 1e-3, "µm": 1e-3}
"""Units of length that the names of a table's columns may speak of, mm."""


def read_profile(path: str | os.PathLike[str], *, mm_per_unit: float = 1.0) -> Tabulated:
    r"""Read a measured profile from a CSV file: a column of radii, and one of values for each
    channel.

    Empty lines and those that begin with `#` are left out; a first line of names may stand above.
    If it speaks of a unit of length, that must be the one given. Radii ascend.

    **Arguments:**

    - `path`: of the file.
    - `mm_per_unit`: of the file's unit of length, in which the radii are; values are counted in one
      over its square.

    **Returns:** a `Tabulated` in JAX's default precision, mm and 1/mm^2.

    **Raises:** `FileNotFoundError`, and `ValueError` for what is no such table: file, line and what
    is wrong.
    """
    path = existing_file(path)
    check_unit(path, mm_per_unit)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: is no text file: {error}; a profile is a CSV of radii and values"
        ) from None
    rows: list[list[float]] = []
    named = False
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = [cell.strip() for cell in next(csv.reader([line]))]
        if not rows and not named and not _is_number(cells[0]):
            named = True
            _check_named_unit(path, number, line, mm_per_unit)
            continue
        bad = next(
            (
                cell
                for cell in cells
                if not _is_number(cell) or not math.isfinite(rounded(float(cell)))
            ),
            None,
        )
        if bad is not None:
            raise ValueError(
                f"{path}: line {number}: {bad!r} is no number; give a radius and a value for each "
                "channel"
            )
        if len(cells) < 2 or (rows and len(cells) != len(rows[0])):
            wanted = f"{len(rows[0])} as above" if rows else "a radius and at least one value"
            raise ValueError(f"{path}: line {number}: has {len(cells)} numbers; expected {wanted}")
        rows.append([float(cell) for cell in cells])
    if len(rows) < 2:
        raise ValueError(
            f"{path}: has {len(rows)} lines of numbers; a profile needs two radii at least"
        )
    table = np.asarray(rows)
    dtype = jnp.result_type(float)
    try:
        return Tabulated(
            jnp.asarray(table[:, 0] * mm_per_unit, dtype),
            jnp.asarray(table[:, 1:] / mm_per_unit**2, dtype),
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _check_named_unit(path: Path, number: int, line: str, mm_per_unit: float) -> None:
    """Refuse names that speak of another unit of length than is given, such as `r (cm)`; mm where
    none is given.
    """
    for unit, size in _UNITS.items():
        if re.search(rf"(?<![A-Za-z]){unit}(?![A-Za-z])", line) and not math.isclose(
            size, mm_per_unit, rel_tol=1e-6
        ):
            raise ValueError(
                f"{path}: line {number} speaks of {unit}, and lengths are taken as {mm_per_unit:g} "
                "mm; "
                f"give mm_per_unit = {size:g} (--mm-per-unit {size:g}), or name the right unit"
            )


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
