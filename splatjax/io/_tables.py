"""Tables of TOML files, and the errors that say what an entry must be."""

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


class Table:
    """One table of a file, and what its entries must be."""

    def __init__(self, path: Path, name: str, table: Any):
        if not isinstance(table, dict):
            raise ValueError(f"{path}: [{name}] must be a table; it is {table!r}")
        self.where, self.table = f"{path}: [{name}]", table

    def entry(self, name: str, expected: str) -> Any:
        """Give whatever stands there."""
        if name not in self.table:
            raise ValueError(f"{self.where} has no {name}; it must be {expected}")
        return self.table[name]

    def only(self, known: set[str]) -> None:
        """Refuse what is not known."""
        unknown = sorted(set(self.table) - known)
        if unknown:
            raise ValueError(
                f"{self.where} has an unknown entry {unknown[0]!r}; {nearest(unknown[0], known)}"
            )

    def unit(self, expected: str, name: str = "unit") -> None:
        """Refuse numbers in another unit, and such as do not say theirs."""
        if name not in self.table:
            raise ValueError(
                f'{self.where} has no {name}; convert the numbers, and say {name} = "{expected}"'
            )
        if (found := self.table[name]) != expected:
            raise ValueError(
                f'{self.where} {name} must be "{expected}"; it is {found!r}: '
                "convert the numbers, then name the unit"
            )

    def numbers(self, name: str, expected: str, holds, channels: int | None = None) -> np.ndarray:
        """Give a list of numbers; a single one stands for all channels, if their number is
        given.
        """
        found = self.entry(name, f"a list of numbers, {expected}")
        if channels is not None and _is_number(found):
            found = [found] * channels
        if not isinstance(found, list) or not found or not all(_is_number(x) for x in found):
            raise ValueError(
                f"{self.where} {name} must be a list of numbers, {expected}; it is {found!r}"
            )
        values = np.asarray(found, np.float64)
        if not np.all(np.isfinite(rounded(values)) & holds(rounded(values))):
            raise ValueError(f"{self.where} {name} must be finite and {expected}; it is {found!r}")
        return values

    def thickness(self, name: str) -> np.ndarray:
        """Give a positive number of mm, which may be infinite."""
        found = self.entry(name, "a number of mm, or inf")
        if not _is_number(found) or not rounded(found) > 0:
            raise ValueError(f"{self.where} {name} must be positive (mm), or inf; it is {found!r}")
        return np.asarray(found, np.float64)

    def number(self, name: str, expected: str, holds, default: float) -> float:
        """Give one finite number, or what it is where the file says nothing."""
        found = self.table.get(name, default)
        if not _is_number(found) or not np.isfinite(rounded(found)) or not holds(rounded(found)):
            raise ValueError(f"{self.where} {name} must be a number, {expected}; it is {found!r}")
        return float(found)

    def matrix(self, name: str, rows: int) -> np.ndarray:
        """Give a list of lists of finite numbers: so many, all equally long."""
        found = self.entry(name, "a list of numbers per Gaussian, one per channel")
        regular = isinstance(found, list) and all(isinstance(row, list) and row for row in found)
        if not regular or not all(
            _is_number(x) and np.isfinite(rounded(x)) for row in found for x in row
        ):
            raise ValueError(
                f"{self.where} {name} must be a list of finite numbers per Gaussian, one per "
                f"channel; it is {found!r}"
            )
        if len(found) != rows or len({len(row) for row in found}) != 1:
            lengths = [len(row) for row in found]
            raise ValueError(
                f"{self.where} {name} must have {rows} rows, one per variance, of equal length; "
                f"its rows have {lengths}"
            )
        return np.asarray(found, np.float64)


def nearest(name: str, known: Iterable[str]) -> str:
    """Say which of the known names is nearest to one that is not; all of them, if none is near."""
    known = sorted(known)
    near = difflib.get_close_matches(name.lower(), known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def rounded(values: Any) -> np.ndarray:
    """Give numbers as they are in JAX's default precision: what is too large is infinite there,
    what is too small is 0.
    """
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(values, np.float64).astype(jnp.result_type(float))


def as_array(values: np.ndarray) -> Array:
    """Give an array in JAX's default precision."""
    return jnp.asarray(values, jnp.result_type(float))
