"""Files that are written whole or not at all."""

import os
import secrets
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Generator[Path, None, None]:
    """Give a temporary path beside `path`, with its suffix, to write to; it takes the name `path` when the block ends well.

    When the block raises, the temporary file is removed and what stood at `path` before is untouched.

    **Raises:** `FileNotFoundError` when the folder does not exist, `NotADirectoryError` when it is none, `IsADirectoryError`
    when `path` is a folder.
    """
    path = Path(path)
    folder = path.parent
    if not folder.exists():
        raise FileNotFoundError(f"{path}: the folder {folder} does not exist; make it first, or name another")
    if not folder.is_dir():
        raise NotADirectoryError(f"{path}: {folder} is a file; name a folder that exists")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; name a file")
    temporary = folder / f".{path.stem}-{secrets.token_hex(4)}{path.suffix}"
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
