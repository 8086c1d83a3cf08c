"""Records of work that may be taken up again: what it was made of, as JSON."""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ._atomic import atomic_path


def fingerprint(path: str | os.PathLike[str]) -> str:
    """Give what tells the contents of a file from those of others: its size and its SHA-256.

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
