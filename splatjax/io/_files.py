"""Checks of paths and units, atomic writing, JSON records, and conversion of records to tables of
plain numbers.
"""

import dataclasses
import hashlib
import json
import os
import secrets
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from splatjax.exports import data_sheet, plain_numbers
from splatjax.scene import Material

StrPath: TypeAlias = str | os.PathLike[str]


def expect(holds: Any, where: StrPath, fault: str) -> None:
    """Raise `ValueError` with a file, or a place in it, and the fault unless a condition holds."""
    if not holds:
        raise ValueError(f"{where}: {fault}")


def existing_file(path: StrPath) -> Path:
    """Return the path of an existing file.

    **Raises:** `FileNotFoundError`, or `IsADirectoryError` if the path is a folder.
    """
    path = Path(path)
    if "\0" in str(path) or not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; give a file")
    return path


def check_suffix(path: StrPath, *suffixes: str) -> None:
    """Raise `ValueError` unless the name of an output file has one of the suffixes."""
    is_known = Path(path).suffix.lower() in suffixes
    expect(is_known, path, f"the name of this file must end in {' or '.join(suffixes)}")


@contextmanager
def naming(where: StrPath) -> Generator[None, None, None]:
    """Prepend a file, or a place in it, to errors about its contents."""
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        kind = FileNotFoundError if isinstance(error, FileNotFoundError) else ValueError
        raise kind(f"{where}: {error}") from None


def check_units(path: StrPath, mm_per_unit: float, up: str = "y") -> None:
    """Raise `ValueError` for an invalid unit of length (mm) or upward axis."""
    expect(
        0 < mm_per_unit < np.inf,
        path,
        f"mm_per_unit is {mm_per_unit}; give the positive length of the file's unit in mm",
    )
    expect(up in ("y", "z"), path, f'up is {up!r}; it must be "y" or "z", the file\'s upward axis')


def with_y_up(vectors: Float[np.ndarray, "n 3"], up: str) -> Float[np.ndarray, "n 3"]:
    """Rotate vectors of a file so that its upward axis becomes +y."""
    return vectors if up == "y" else vectors[:, [0, 2, 1]] * [1, 1, -1]


@contextmanager
def atomic_path(path: StrPath) -> Generator[Path, None, None]:
    """Yield a temporary path beside `path` with the same suffix, and rename it to `path` if the
    block succeeds.

    If the block raises, the temporary file is removed and an existing file at `path` is unchanged.
    Only a killed process leaves the temporary file behind.

    **Raises:** `FileNotFoundError` if the folder does not exist; another `OSError` that names
    `path`, such as `IsADirectoryError`, if it cannot be written.
    """
    path = Path(path)
    folder = path.parent
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{path}: there is no folder {folder}; make it first, or give another"
        )
    temporary = folder / f".{path.stem}-{secrets.token_hex(8)}{path.suffix}"
    try:
        temporary.touch(exist_ok=False)
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        if error.filename not in (None, str(temporary), temporary):
            raise
        reason = error.strerror or " ".join(str(error).split())
        raise type(error)(
            error.errno,
            f"cannot be written: {reason}; an existing file is unchanged",
            str(path),
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def fingerprint(path: StrPath) -> str:
    """Return the size and the SHA-256 digest of a file.

    **Raises:** `OSError` if the file cannot be read.
    """
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return f"{file.tell()} bytes, SHA-256 {digest}"


def write_record(path: StrPath, record: Mapping[str, Any]) -> None:
    """Write a record as JSON, atomically.

    **Raises:** `FileNotFoundError` if the folder does not exist.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def read_record(path: StrPath) -> dict[str, Any]:
    """Read a record that `write_record` wrote.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file is not a record.
    """
    try:
        record = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path}: is not a JSON file ({error}); delete it, or give another folder"
        ) from None
    expect(isinstance(record, dict), path, "is not a record; delete it, or give another folder")
    return record


def record_names(cls: Any) -> list[str]:
    """Return the names of the fields of a class that its constructor takes."""
    return [field.name for field in dataclasses.fields(cls) if field.init]


def plain_record(record: Any, **given: Any) -> dict[str, Any]:
    """Convert a record to a table for `Table.record`: its fields as plain numbers, without those
    that are `None`. Given entries replace fields.
    """
    values = {name: getattr(record, name) for name in record_names(record)} | given
    return {name: plain_numbers(value) for name, value in values.items() if value is not None}


def save_exports(material: Material, path: StrPath) -> None:
    r"""Write the Gaussians of a material as parameters of other renderers
    (`splatjax.exports.data_sheet`) to a JSON file, atomically.

    **Raises:** `ValueError` for a material with separate single scattering, for which other
    renderers have no parameter; `OSError` if the file cannot be written.
    """
    expect(
        material.single_scattering is None,
        path,
        "the material has single scattering besides its Gaussians; fit it without, then export",
    )
    write_record(path, data_sheet(material.gaussians))
