"""What every reader asks of a file before it looks inside."""

import math
import os
from pathlib import Path
from urllib.parse import unquote


def existing_file(path: str | os.PathLike[str]) -> Path:
    """Give the path of a file that is there.

    **Raises:** `FileNotFoundError`, or `IsADirectoryError` when it is a folder.
    """
    path = Path(path)
    if "\0" in str(path) or not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder; name a file")
    return path


def check_unit(path: Path, mm_per_unit: float) -> None:
    """Refuse a length of the unit (mm) that is none."""
    if not 0 < mm_per_unit < math.inf:
        raise ValueError(
            f"{path}: mm_per_unit is {mm_per_unit}; it must be the positive length of the file's "
            "unit in mm"
        )


def file_beside(path: Path, name: str, *, encoded: bool = False) -> Path:
    """Give the file that another one names: in the same folder or below it, wherever the other came
    from.

    **Arguments:**

    - `path`: of the file that names it.
    - `name`: as it stands there, with slashes of either kind.
    - `encoded`: whether it is a URI, with %20 for a space.

    **Raises:** `ValueError` for a name that leads out of the folder, `FileNotFoundError` when there
    is no such file.
    """
    plain = (unquote(name) if encoded else name).replace("\\", "/")
    if not plain or "\0" in plain:
        raise ValueError(f"{path}: names a file {name!r}; that is no name")
    folder = path.parent.resolve()
    found = (folder / plain).resolve()
    if plain[1:2] == ":" or not found.is_relative_to(folder):
        raise ValueError(
            f"{path}: names {name!r}, which lies outside its folder; put that file beside it, and "
            "name it so"
        )
    if not found.is_file():
        raise FileNotFoundError(
            f"{path}: names {name!r}, and there is no such file beside it; put it there"
        )
    return found
