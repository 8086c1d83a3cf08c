"""Files read by trimesh: what it raises becomes one sentence, and what it passes over a warning."""

import logging
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
from PIL import Image

from ._contents import CHECKS


@contextmanager
def one_sentence(path: Path) -> Generator[None, None, None]:
    """Turn whatever a library raises into an error that names the file, the reason and the remedy.

    **Raises:** `ValueError`; errors that already name the file pass.
    """
    log = logging.getLogger("trimesh")
    before = log.level
    log.setLevel(logging.CRITICAL)  # faults are raised here
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # NumPy's, of words among numbers
            yield
    except Exception as error:  # each reader fails in its own way
        if isinstance(error, (ValueError, OSError)) and str(error).startswith(str(path)):
            raise
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__} "
        raise ValueError(
            f"{path}: cannot be read ({kind}{' '.join(str(error).split())[:200]}); it is cut "
            "short, or of a kind that is not read: export it again"
        ) from None
    finally:
        log.setLevel(before)


def load_with_trimesh(path: Path, kind: str) -> dict[str, Any]:
    """Read a file of some kind by trimesh.

    Pictures and materials that are missing or unreadable are left out, with a warning.

    **Returns:** the arguments of its meshes, as the file has them; its `contents`; `triangles`,
    how many it promises, where it does; and of a PLY file `columns`, the properties of each
    element.

    **Raises:** `ValueError` for contents that trimesh would misread, and when it reads fewer rows
    than a PLY file promises.
    """
    from trimesh.exchange import load  # takes a second, so only where it is needed

    folder, data = _Folder(path), path.read_bytes()
    loaders, count = cast(dict[str, Any], load.mesh_loaders), CHECKS[kind](data)
    found = loaders[kind](BytesIO(data), resolver=folder, fix_texture=False)
    elements = found.get("metadata", {}).get("_ply_raw", {})
    columns = {name: _columns(name, element) for name, element in elements.items()}
    for fault in folder.faults:
        warnings.warn(f"{path}: {fault}, and its colors are left out", stacklevel=2)
    return found | {"triangles": count, "contents": data, "columns": columns}


def _columns(name: str, element: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the properties of an element of a PLY file: a number or a list for each row."""
    columns = {}
    for key in element["properties"] if element["length"] else ():
        column = np.asarray(element["data"][key])
        if column.dtype.names:
            sizes, column = column["f0"], column["f1"]
            if np.ptp(sizes):
                raise ValueError(f"{key} are lists of several lengths, such as mixed polygons")
        if len(column) != element["length"]:
            raise ValueError(f"its header promises {element['length']} rows of {name}")
        columns[key] = column[:, 0] if column.shape[1:] == (1,) else column
    return columns


class _Folder:
    """The files beside a mesh: a trimesh resolver that never leaves their folder."""

    def __init__(self, path: Path):
        self.file_name, self._folder = path.name, path.parent.resolve()
        self.faults: list[str] = []

    def get(self, name: str) -> bytes:
        plain = name.strip().replace("\\", "/")
        candidates = (plain, unquote(plain), plain.rsplit("/", 1)[-1])
        places = [(self._folder / candidate).resolve() for candidate in candidates]
        file = next((p for p in places if p.is_relative_to(self._folder) and p.is_file()), None)
        if file is None:
            self.faults.append(f"names {name!r}, which is not beside it")
            raise FileNotFoundError(f"it {self.faults[-1]}")
        data = file.read_bytes()
        try:
            if file.suffix.lower() not in (".mtl", ".bin"):
                Image.open(BytesIO(data)).close()
        except Exception:  # each decoder fails in its own way
            self.faults.append(f"names {name!r}, which is no picture that trimesh reads")
        return data

    __getitem__ = get
