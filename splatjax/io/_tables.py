"""Tables of TOML and CSV files, and the errors that say what an entry must be."""

import csv
import difflib
import os
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._files import existing_file

POSITIVE = "positive", lambda x: (x > 0) & (x < np.inf)
AT_LEAST_0 = "finite and at least 0", lambda x: (x >= 0) & (x < np.inf)
FINITE = "finite", np.isfinite
Rule = tuple[str, Callable[[np.ndarray], Any]]
"""What numbers must be, in words and as a function of their rounded values."""


def read_toml(path: Path, remedy: str) -> dict[str, Any]:
    """Read all tables of a TOML file.

    **Raises:** `ValueError` when it cannot be read.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); {remedy}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is no TOML file: {error}") from None


def read_rows(path: str | os.PathLike[str], contents: str) -> list[tuple[str, list[Any]]]:
    """Read the rows of a CSV file and where they stand; empty ones and comments (`#`) are left out.
    Cells that are numbers are converted.

    **Raises:** `FileNotFoundError`, or `ValueError` when it is no text.
    """
    try:
        lines = existing_file(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is no text file: {error}; {contents}") from None
    rows = csv.reader(lines)
    return [
        (f"{path}: line {rows.line_num}", [_converted(cell) for cell in row])
        for row in rows
        if any(map(str.strip, row)) and not row[0].lstrip().startswith("#")
    ]


def _converted(cell: str) -> float | str:
    try:
        return float(cell)
    except ValueError:
        return cell.strip()


class Table:
    """A table of a TOML file, whose entries are checked as they are read.

    **Raises:** `ValueError` for what is no table, and for an entry that is not among the `known`.
    """

    def __init__(self, path: Path, name: str, entries: Any, known: Iterable[str]):
        self.path, self.name, self.entries = path, name, entries
        self.where = f"{path}: [{name}]" if name else f"{path}:"
        if not isinstance(entries, dict):
            raise ValueError(f"{self.where} must be a table; it is {entries!r}")
        unknown = sorted(entries.keys() - known)
        if unknown:
            raise ValueError(
                f"{self.where} has an unknown entry {unknown[0]!r}; {nearest(unknown[0], known)}"
            )

    def table(self, name: str, known: Iterable[str]) -> "Table":
        """Return a table within this one."""
        return Table(self.path, f"{self.name} {name}".strip(), self.entries.get(name), known)

    def tables(self, name: str, known: Iterable[str]) -> "list[Table]":
        """Return a list of tables within this one, from 1."""
        given = self.entries.get(name)
        if not isinstance(given, list) or not given:
            raise ValueError(f"{self.where} {name} must be one table or more; it is {given!r}")
        return [
            Table(self.path, f"{self.name} {name} {number}".strip(), entries, known)
            for number, entries in enumerate(given, start=1)
        ]

    def one_of(self, name: str, choices: Iterable[Any], default: Any = None) -> Any:
        """Return an entry that is one of some choices."""
        value = self.entries.get(name, default)
        if (type(value), value) not in [(type(choice), choice) for choice in choices]:
            raise ValueError(
                f"{self.where} {name} must be {' or '.join(map(repr, choices))}; it is {value!r}"
            )
        return value

    def numbers(
        self,
        name: str,
        rule: Rule,
        shape: tuple[int | None, ...],
        default: float | None = None,
        *,
        fill: bool = True,
    ) -> Array:
        """Return numbers in JAX's default precision.

        **Arguments:**

        - `shape`: `None` stands for any count.
        - `default`: of an entry that is left out; `None`: it must be there.
        - `fill`: whether one number stands for all where the count is known.
        """
        given = self.entries.get(name, default)
        try:
            values = np.asarray(given)
        except ValueError:  # rows of several lengths
            values = np.asarray(None)
        if fill and values.ndim == 0 and None not in shape:
            values = np.broadcast_to(values, [n or 1 for n in shape])
        fits = values.ndim == len(shape) and values.size > 0 and values.dtype.kind in "iuf"
        fits = fits and all(n in (None, m) for n, m in zip(shape, values.shape, strict=True))
        fits = fits and not any(isinstance(value, bool) for value in np.asarray(given, object).flat)
        if not fits or not np.all(rule[1](rounded(values))):
            rows = "rows of " if len(shape) > 1 else ""
            count = f"{shape[0] or 'a list of'} {rows}numbers" if shape else "a number"
            raise ValueError(
                f"{self.where} {name} must be {count}, {rule[0]}; it is "
                f"{'missing' if given is None else repr(given)}"
            )
        return jnp.asarray(rounded(values))


def nearest(name: str, known: Iterable[str]) -> str:
    """Suggest the known name that is nearest to an unknown one, or list all of them."""
    known = sorted(known)
    near = difflib.get_close_matches(name.lower(), known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"


def rounded(values: Any) -> np.ndarray:
    """Round numbers to JAX's default precision: what is too large becomes infinite, what is too
    small 0.
    """
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(values, np.float64).astype(jnp.result_type(float))
