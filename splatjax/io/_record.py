"""Records of work that may be taken up again: what it was made of, as JSON."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatjax.exports import data_sheet
from splatjax.scene import Material

from ._files import atomic_path


def fingerprint(path: str | os.PathLike[str]) -> str:
    """Return what distinguishes the contents of a file: its size and its SHA-256.

    **Raises:** `OSError` when the file cannot be read.
    """
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return f"{file.tell()} bytes, SHA-256 {digest}"


def write_record(path: str | os.PathLike[str], record: Mapping[str, Any]) -> None:
    """Write a record as JSON, whole or not at all.

    **Raises:** `FileNotFoundError` when the folder does not exist.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def read_record(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read what `write_record` wrote.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file is no record.
    """
    try:
        record = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"{path}: is no JSON file ({error}); delete it, or name another folder"
        ) from None
    if not isinstance(record, dict):
        raise ValueError(f"{path}: is no record; delete it, or name another folder")
    return record


def save_exports(material: Material, path: str | os.PathLike[str]) -> None:
    r"""Write a material's Gaussians in the terms of other renderers to a JSON file
    (`splatjax.exports.data_sheet`), whole or not at all.

    **Raises:** `ValueError` for a material with single scattering as a term of its own, which other
    renderers have no number for; `OSError` if the file cannot be written.
    """
    if material.single_scattering is not None:
        raise ValueError(
            f"{path}: the material has single scattering besides its Gaussians; fit it without, "
            "then export"
        )
    write_record(path, data_sheet(material.gaussians))
