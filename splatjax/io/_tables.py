"""Tables in files: TOML, with errors that list valid entries, and measured profiles and media in
CSV.
"""

import csv
import dataclasses
import difflib
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tomli_w
from jaxtyping import Array, Float

from splatjax.scattering import Tabulated

from ._files import StrPath, atomic_path, check_units, existing_file, expect, naming

Made = TypeVar("Made")


def read_toml(path: Path, remedy: str) -> dict[str, Any]:
    """Read all tables of a TOML file.

    **Raises:** `OSError` if the file cannot be opened, `ValueError` if it is not TOML.
    """
    try:
        return tomllib.loads(existing_file(path).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is not a TOML file ({error}); {remedy}") from None


class Table:
    """A table of a TOML file that checks entries as they are read.

    **Raises:** `ValueError` for anything but a table, and for an entry that is not in `names`.
    """

    def __init__(self, path: Path, name: str, entries: Any, names: Iterable[str]):
        self.path, self.name, self.entries = path, name, entries
        self.folder = path.parent  # folder for relative paths in the table
        self.where = f"{path}: [{name}]" if name else f"{path}:"
        self.expect(isinstance(entries, dict), f"must be a table; it is {entries!r}")
        unknown = sorted(entries.keys() - names)
        if unknown:
            raise ValueError(
                f"{self.where} has an unknown entry {unknown[0]!r}; {nearest(unknown[0], names)}"
            )

    def table(self, name: str, names: Iterable[str]) -> "Table":
        return Table(self.path, f"{self.name} {name}".strip(), self.entries.get(name), names)

    def only(self, names: Iterable[str]) -> "Table":
        return Table(self.path, self.name, self.entries, names)

    def table_of_kind(self, name: str, kinds: Mapping[str, set[str]]) -> "Table":
        """Return a table within this one. The first entry of `kinds` that it has, or the last,
        determines which other entries it may have.
        """
        table = self.table(name, set().union(*kinds.values()))
        return table.only(kinds[next((k for k in kinds if k in table.entries), [*kinds][-1])])

    def tables(self, name: str, names: Iterable[str], least: int = 1) -> "list[Table]":
        """Return a list of tables within this one. Errors number them from 1."""
        value = self.entries.get(name)
        self.expect(
            isinstance(value, list) and len(value) >= least,
            f"{name} must be one table or more; it is {value!r}",
        )
        return [
            Table(self.path, f"{self.name} {name} {number}".strip(), entries, names)
            for number, entries in enumerate(value, start=1)
        ]

    def expect(self, holds: Any, fault: str) -> None:
        """Raise `ValueError` with the table and the fault unless a condition holds."""
        if not holds:
            raise ValueError(f"{self.where} {fault}")

    def one_of(self, name: str, choices: Iterable[Any], default: Any = None) -> Any:
        """Return an entry that must be one of the choices."""
        value = self.entries.get(name, default)
        near = difflib.get_close_matches(str(value).lower(), map(str, choices), n=1)
        self.expect(
            (type(value), value) in [(type(choice), choice) for choice in choices],
            f"{name} must be {' or '.join(map(_as_toml, choices))}; it is {_as_toml(value)}"
            f"{f'; did you mean {near[0]!r}?' if near else ''}",
        )
        return value

    def numbers(self, name: str, default: float | list[float] | None = None) -> Array:
        """Return a number, a list of numbers or rows of numbers, in JAX's default precision.

        Records (see `make`) check ranges and shapes.
        """
        value = self.entries.get(name, default)
        kinds = {type(leaf) for leaf in jax.tree.leaves(value)}
        if kinds and kinds <= {int, float}:
            with suppress(TypeError, ValueError, OverflowError):  # rows of unequal length
                return jnp.asarray(rounded(value))
        self.expect(value is not None, f"{name} is missing; add it")
        raise ValueError(
            f"{self.where} {name} must be a number, a list of numbers or rows of equal length; it "
            f"is {_as_toml(value)}"
        )

    def number(self, name: str, default: float | None = None) -> float:
        values = self.numbers(name, default)
        self.expect(values.ndim == 0, f"{name} must be one number; it is {values.tolist()}")
        return float(values)

    def whole(self, name: str, default: float | None = None) -> int:
        value = self.number(name, default)
        self.expect(value % 1 == 0, f"{name} must be a whole number; it is {value:g}")
        return int(value)

    def vector(self, name: str, default: list[float] | None = None) -> Array:
        values = self.numbers(name, default)
        self.expect(values.shape == (3,), f"{name} must be three numbers; it is {values.tolist()}")
        return values

    def text(self, name: str) -> str:
        value = self.entries.get(name)
        self.expect(isinstance(value, str), f"{name} must be a name in quotes; it is {value!r}")
        return value

    def make(self, make: Callable[..., Made], *args: Any, **named: Any) -> Made:
        """Call a function; its errors name the table."""
        with naming(self.where.rstrip(":")):
            return make(*args, **named)

    def record(self, cls: Any, **given: Any) -> Any:
        """Make a record of a class from the entries of the fields that are not given. A missing
        entry takes the default of the field.
        """
        for field in dataclasses.fields(cls):
            is_read = field.default is dataclasses.MISSING or field.name in self.entries
            if field.init and is_read and field.name not in given:
                given[field.name] = self._field(field.name, field.type)
        return self.make(cls, **given)

    def _field(self, name: str, kind: Any) -> Any:
        """Read the entry of a field of a given type: a Boolean, a number, or numbers."""
        if kind is bool:
            return self.one_of(name, (True, False))
        if kind is int:
            return self.whole(name)
        is_scalar = kind is float or getattr(kind, "dim_str", None) == ""
        return self.number(name) if is_scalar else self.numbers(name)


def write_toml(path: StrPath, tables: Mapping[str, Any]) -> None:
    """Write tables to a TOML file, with arrays of numbers on one line, atomically."""
    number = r"-?(?:[\d.]+(?:e[+-]?\d+)?|inf|nan)"
    text = re.sub(
        rf"\[\s+((?:{number},\s+)+)\]",
        lambda rows: "[" + ", ".join(rows[1].replace(",", " ").split()) + "]",
        tomli_w.dumps(tables),
    )
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _as_toml(value: Any) -> str:
    return {"True": "true", "False": "false", "None": "missing"}.get(repr(value), repr(value))


def nearest(name: str, choices: Iterable[str]) -> str:
    """Suggest the known name nearest to an unknown name, or list all known names."""
    choices = sorted(choices)
    near = [n for own in (name.lower(), name) for n in difflib.get_close_matches(own, choices, 1)]
    return f"did you mean {near[0]!r}?" if near else f"known are {', '.join(choices)}"


def rounded(values: Any) -> np.ndarray:
    """Round numbers to JAX's default precision. Numbers out of range become infinite or 0."""
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(values, np.float64).astype(jnp.result_type(float))


# Units of length in the column names of a table.
_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 1e-3, "µm": 1e-3, "inch": 25.4}
_COLUMNS = "sigma_a", "sigma_s_prime", "eta"


def read_profile(path: StrPath, *, mm_per_unit: float = 1.0) -> Tabulated:
    r"""Read a measured profile from a CSV file with a column of radii and one column of values per
    channel.

    Empty lines and lines that begin with `#` are ignored. The first line may contain names; a unit
    in it must agree with `mm_per_unit`. Radii must ascend.

    **Arguments:** `mm_per_unit`: length of the file's unit, mm. Radii are in this unit, and values
    in its inverse square.

    **Returns:** a `Tabulated` in JAX's default precision, mm and 1/mm^2.

    **Raises:** `FileNotFoundError`; `ValueError`, with line and cause, for invalid content.
    """
    check_units(path, mm_per_unit)
    rows = _read_rows(path, "a profile is a CSV of radii and values")
    if rows and _number(rows[0][1][0]) is None:
        (where, names), *rows = rows
        for unit, size in _MM.items():
            is_named = re.search(rf"(?<![A-Za-z]){unit}(?![A-Za-z])", ",".join(names))
            expect(
                not is_named or np.isclose(size, mm_per_unit, rtol=1e-6, atol=0),
                where,
                f"gives the unit {unit}, and mm_per_unit is {mm_per_unit:g}; give mm_per_unit = "
                f"{size:g} (--mm-per-unit {size:g}), or correct the unit",
            )
    expect(len(rows) >= 2, path, f"has {len(rows)} lines of numbers; give at least two radii")
    table, count = [], len(rows[0][1])
    for where, cells in rows:
        table.append([_number(cell) for cell in cells])
        expect(
            1 < len(cells) == count and np.isfinite(rounded(table[-1])).all(),
            where,
            f"{', '.join(cells)} must be a radius and a value for each of {count - 1} channels",
        )
    radii, values = np.split(np.asarray(table), [1], axis=1)
    with naming(path):
        return Tabulated(
            jnp.asarray(radii[:, 0] * mm_per_unit, float),
            jnp.asarray(values / mm_per_unit**2, float),
        )


def read_media(path: StrPath) -> tuple[list[str], Float[np.ndarray, "media 3"]]:
    r"""Read media from a CSV file with a line of column names and then one line per medium of one
    channel.

    Columns are `sigma_a` and `sigma_s_prime` (1/mm), `eta`, and optionally `name`. Empty lines are
    ignored.

    **Returns:** the names (numbers if the file has no names), and the three coefficients of each
    medium.

    **Raises:** `FileNotFoundError`; `ValueError`, with line and cause, for invalid content.
    """
    contents = f"media are a CSV of {', '.join(_COLUMNS)}, and optionally name"
    (_, head), *rows = _read_rows(path, contents) or [("", [])]
    expect(
        {*_COLUMNS} <= {*head} <= {*_COLUMNS, "name"} and rows,
        path,
        f"has the columns {', '.join(head)}, with {len(rows)} rows; {contents}",
    )
    names, media = [], []
    for where, cells in rows:
        entries = dict(zip(head, cells, strict=False))
        medium = np.asarray([_number(entries.get(name, "")) for name in _COLUMNS], float)
        is_valid = np.isfinite(medium).all() and medium[0] >= 0 and (medium[1:] > 0).all()
        expect(
            len(cells) == len(head) and is_valid,
            where,
            f"{', '.join(cells)} must be {', '.join(head)}, positive; sigma_a may be 0",
        )
        names.append(entries.get("name") or str(len(media) + 1))
        media.append(medium)
    return names, np.asarray(media)


def write_columns(path: StrPath, columns: Mapping[str, Iterable]) -> None:
    """Write a CSV table atomically, with enough digits to restore the numbers exactly.

    **Raises:** `FileNotFoundError` if the folder does not exist.
    """
    plain = (
        [cell if isinstance(cell, str) else repr(float(cell)) for cell in column]
        for column in columns.values()
    )
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *zip(*plain, strict=True)])


def read_columns(path: StrPath) -> dict[str, tuple[str, ...]]:
    """Read the cells of a table that `write_columns` wrote."""
    with open(path, newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    return dict(zip(head, zip(*rows, strict=True), strict=True))


def _read_rows(path: StrPath, contents: str) -> list[tuple[str, list[str]]]:
    """Read the rows of a CSV file and their line numbers, without empty lines and comments (`#`).

    **Raises:** `FileNotFoundError`, or `ValueError` if it is not text.
    """
    try:
        lines = existing_file(path).read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is not a text file: {error}; {contents}") from None
    rows = csv.reader(lines)
    return [
        (f"{path}: line {rows.line_num}", [cell.strip() for cell in row])
        for row in rows
        if any(map(str.strip, row)) and not row[0].lstrip().startswith("#")
    ]


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None
