"""Files that are written whole or not at all."""

import os
import secrets
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Generator[Path, None, None]:
    """Give a temporary path beside `path`, with its suffix, to write to; it takes the name `path`
    when the block ends well.

    When the block raises, the temporary file is removed and what stood at `path` before is
    untouched. A process that is killed can remove nothing: what it leaves is removed when the same
    file is written next.

    **Raises:** `FileNotFoundError` when the folder does not exist, `NotADirectoryError` when it is
    none, `IsADirectoryError` when `path` is a folder, `OSError` that names `path` when it cannot be
    written.
    """
    path = Path(path)
    folder = path.parent
    if not folder.exists():
        raise FileNotFoundError(
            f"{path}: the folder {folder} does not exist; make it first, or name another"
        )
    if not folder.is_dir():
        raise NotADirectoryError(f"{path}: {folder} is a file; name a folder that exists")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; name a file")
    _remove_left_behind(path)
    temporary = folder / f".{path.stem}-{secrets.token_hex(4)}{path.suffix}"
    try:
        held, locked = _created(temporary)
        try:
            yield temporary
            os.fsync(held)
            if locked:  # up to the end, or another process takes it for what a kill has left behind
                os.replace(temporary, path)
        finally:
            os.close(held)
        if not locked:
            os.replace(temporary, path)
    except OSError as error:
        if error.filename not in (None, str(temporary), temporary):
            raise
        reason = error.strerror or " ".join(str(error).split())
        raise type(error)(
            error.errno,
            f"cannot be written: {reason}; what stood there before is untouched",
            str(path),
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _created(temporary: Path) -> tuple[int, bool]:
    """Create a file and hold it; say whether files can be held here. Where they cannot, what a kill
    leaves behind stays.
    """
    while True:
        file = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        try:
            _lock(file, wait=True)
        except OSError:
            return file, False
        if os.fstat(file).st_nlink > 0:
            return file, True
        os.close(file)  # another process found it before it was held, and has removed it


def _remove_left_behind(path: Path) -> None:
    """Remove temporary files of this one that nobody holds any more."""
    head, tail = f".{path.stem}-", path.suffix
    for name in os.listdir(path.parent):
        token = name[len(head) : len(name) - len(tail)]
        if (
            name.startswith(head)
            and name.endswith(tail)
            and len(token) == 8
            and set(token) <= set("0123456789abcdef")
        ):
            with suppress(OSError):
                left = os.open(path.parent / name, os.O_RDWR)
                try:
                    _lock(left)
                    os.unlink(path.parent / name)
                finally:
                    os.close(left)


def _lock(file: int, *, wait: bool = False) -> None:
    """Hold a file until it is closed or the process ends, however it ends.

    **Raises:** `OSError` when another holds it and is not waited for, or where files cannot be
    held.
    """
    try:
        import fcntl  # not on Windows
    except ImportError as error:
        raise OSError("files cannot be held here") from error
    fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
