"""Tables of TOML files, and the errors that say what an entry must be."""

import difflib
import tomllib
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._files import naming

Made = TypeVar("Made")


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

    def numbers(self, name: str, default: float | None = None) -> Array:
        """Return a number, a list of numbers or rows of them, in JAX's default precision.

        Ranges and shapes are checked by the records that are made of them (`make`).
        """
        given = self.entries.get(name, default)
        kinds = {type(leaf) for leaf in jax.tree.leaves(given)}
        if kinds and kinds <= {int, float}:
            with suppress(TypeError, ValueError, OverflowError):  # rows of several lengths
                return jnp.asarray(rounded(given))
        raise ValueError(
            f"{self.where} {name} must be a number, a list of numbers or rows of equal length; it "
            f"is {'missing' if given is None else repr(given)}"
        )

    def number(self, name: str, default: float | None = None) -> float:
        values = self.numbers(name, default)
        if values.ndim:
            raise ValueError(f"{self.where} {name} must be one number; it is {values.tolist()}")
        return float(values)

    def make(self, make: Callable[..., Made], *args: Any, **named: Any) -> Made:
        """Make a record of entries; errors that it raises name the table."""
        with naming(self.where):
            return make(*args, **named)


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
