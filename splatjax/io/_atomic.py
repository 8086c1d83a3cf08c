"""Files that are written whole or not at all."""

import os
import platform
import re
import secrets
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Generator[Path, None, None]:
    """Yield a temporary path beside `path`, with its suffix, to write to; it takes the name `path`
    when the block ends well.

    When the block raises, the temporary file is removed and what stood at `path` before is
    untouched. A process that is killed can remove nothing: what it leaves is removed when the same
    file is written next on the same machine.

    **Raises:** `FileNotFoundError` when the folder does not exist, another `OSError` that names
    `path` when it cannot be written, such as `IsADirectoryError`.
    """
    path = Path(path)
    folder = path.parent
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{path}: there is no folder {folder}; make it first, or name another"
        )
    head = f".{path.stem}-{platform.node()}-"
    temporary = folder / f"{head}{os.getpid()}-{secrets.token_hex(4)}{path.suffix}"
    try:
        _remove_left_behind(folder, head, path.suffix)
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
            f"cannot be written: {reason}; what stood there before is untouched",
            str(path),
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _remove_left_behind(folder: Path, head: str, suffix: str) -> None:
    """Remove temporary files of processes that no longer run."""
    for name in os.listdir(folder) if os.name == "posix" else ():
        parts = re.fullmatch(rf"{re.escape(head)}(\d+)-[0-9a-f]{{8}}{re.escape(suffix)}", name)
        if parts:
            try:
                os.kill(int(parts[1]), 0)  # only asks whether it runs
            except ProcessLookupError:
                (folder / name).unlink(missing_ok=True)
            except OSError:  # it is someone else's
                continue
