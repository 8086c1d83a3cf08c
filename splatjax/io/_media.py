"""Many media in one table, and what is fitted to them in another."""

import csv
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ._atomic import atomic_path
from ._files import existing_file

_COLUMNS = "sigma_a", "sigma_s_prime", "eta"


def read_media(path: str | os.PathLike[str]) -> tuple[list[str], Float[np.ndarray, "media 3"]]:
    r"""Read media from a CSV file: a first line of names, then a line for each medium of one
    channel.

    Columns are `sigma_a` and `sigma_s_prime` (1/mm), `eta`, and `name` if there is one. Empty lines
    are left out.

    **Returns:** the names, numbers where there are none, and the three coefficients of each.

    **Raises:** `FileNotFoundError`, and `ValueError` for what is no such table: file, line and what
    is wrong.
    """
    path = existing_file(path)
    try:
        lines = [
            row
            for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
            if any(map(str.strip, row))
        ]
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path}: is no text file: {error}; media are a CSV of {', '.join(_COLUMNS)}"
        ) from None
    head = [cell.strip() for cell in lines[0]] if lines else []
    lacking = [name for name in _COLUMNS if name not in head]
    if lacking:
        raise ValueError(
            f"{path}: its first line has no {lacking[0]}; it must name the columns "
            f"{', '.join(_COLUMNS)}"
        )
    if len(lines) < 2:
        raise ValueError(f"{path}: holds no medium below the names of its columns")
    names, values = [], np.empty((len(lines) - 1, 3))
    for i, row in enumerate(lines[1:]):
        if len(row) != len(head):
            raise ValueError(
                f"{path}: medium {i + 1} has {len(row)} cells, and there are {len(head)} columns; "
                "mend that line"
            )
        cells = dict(zip(head, row, strict=True))
        names.append(cells.get("name", "").strip() or str(i + 1))
        values[i] = [_number(path, i + 1, name, cells[name]) for name in _COLUMNS]
    return names, values


def _number(path: Path, medium: int, name: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < 0 or (value == 0 and name != "sigma_a"):
        expected = "0 or more" if name == "sigma_a" else "positive"
        raise ValueError(
            f"{path}: {name} of medium {medium} is {cell.strip()!r}; it must be {expected}"
        )
    return value


def write_columns(path: str | os.PathLike[str], columns: Mapping[str, Iterable]) -> None:
    """Write a CSV table, whole or not at all; numbers so that they are read back as they are.

    **Raises:** `FileNotFoundError` when the folder does not exist.
    """
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(
            zip(*([_plain(cell) for cell in column] for column in columns.values()), strict=True)
        )


def read_column(path: str | os.PathLike[str], name: str) -> Float[np.ndarray, " rows"]:
    """Read a column of numbers that `write_columns` has written."""
    with open(path, newline="", encoding="utf-8") as file:
        return np.asarray([float(row[name]) for row in csv.DictReader(file)])


def join_tables(path: str | os.PathLike[str], parts: Sequence[Path]) -> None:
    """Write tables with the same columns as one, in their order, whole or not at all."""
    with atomic_path(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        for i, part in enumerate(parts):
            head, rest = part.read_text(encoding="utf-8").split("\n", 1)
            file.write(rest if i else f"{head}\n{rest}")


def _plain(cell) -> str:
    return cell if isinstance(cell, str) else repr(float(cell))
