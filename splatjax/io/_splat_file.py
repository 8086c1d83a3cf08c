"""Splats of a PLY file that is larger than memory, a part at a time."""

import os
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np

from splatjax.scene import Splats

from ._files import check_units, existing_file
from ._ply import COLUMNS, check_places, splat_fields
from ._trimesh import one_sentence

_PART = 1_000_000
_COMPLETE = (
    "complete the file first: splatjax.write_splats(complete, splatjax.read_splats(path)) "
    "estimates normals, radii and areas, and `splatjax sample` of a mesh writes them"
)


class SplatFile:
    r"""Complete splats in a binary PLY file, read a part at a time: what `splatjax.render_streamed`
    asks for.

    Their order is that of the file: splats that are near in space should be near in it
    (`read_splats` sorts, a stream cannot).

    **Arguments:**

    - `path`: a PLY file whose vertices have `x y z`, `nx ny nz`, `radius` and `area`, as
      `read_splats` reads them, stand first, and have no lists.
    - `part`: splats of a part; about 1 kB of memory each.
    - `mm_per_unit`: length of the file's unit, mm.
    - `up`: the file's upward axis, `"y"` or `"z"`.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file is no binary PLY, is cut short,
    or lacks one of these.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        part: int = _PART,
        *,
        mm_per_unit: float = 1.0,
        up: str = "y",
    ):
        self.path, self.part, self.mm_per_unit, self.up = existing_file(path), part, mm_per_unit, up
        check_units(self.path, mm_per_unit, up)
        if part < 1:
            raise ValueError(f"{path}: part is {part}; it must be at least one splat")
        with one_sentence(self.path), open(path, "rb") as file:
            from trimesh.exchange.ply import _parse_header  # only where it is needed

            elements, is_text, _ = _parse_header(file)
            name, vertices = next(iter(elements.items()))
            kinds = vertices["properties"]
            if is_text or name != "vertex" or any("LIST" in kind for kind in kinds.values()):
                raise ValueError("its vertices do not stand first, as binary without lists")
            self.count, self._offset = vertices["length"], file.tell()
            self._names, self._columns = tuple(kinds), np.dtype(list(kinds.items()))
            self._rows(0, self.count)  # raises where the file is cut short
        for field in ("normals", "radii", "areas"):
            if not any(kinds.keys() >= set(names) for names in COLUMNS[field]):
                raise ValueError(
                    f"{path}: its vertices have no {' '.join(COLUMNS[field][0])}, which cannot be "
                    f"estimated part by part; {_COMPLETE}"
                )

    def __call__(self) -> Iterator[Splats]:
        """Yield all splats from the beginning, in mm and in JAX's default precision, in parts of
        one size but the last.

        **Raises:** `ValueError` when numbers are not finite, or not as `read_splats` reads them;
        how large the whole is turns out at the end.
        """
        corners, dtype = [], jnp.result_type(float)
        for begin in range(0, self.count, self.part):
            rows = self._rows(begin, min(self.part, self.count - begin))
            where = self.path.with_name(f"{self.path.name}, from vertex {begin}")
            columns: dict[str, np.ndarray] = {name: rows[name] for name in self._names}
            try:
                fields = splat_fields(where, columns, self.mm_per_unit, self.up)
            except ValueError as error:
                raise ValueError(f"{error}; or {_COMPLETE}") from None
            corners += [fields["centers"].min(axis=0), fields["centers"].max(axis=0)]
            arrays: dict[str, Any] = {
                name: jnp.asarray(values, dtype)
                for name, values in fields.items()
                if values is not None
            }
            yield Splats(**arrays)
        check_places(self.path, np.stack(corners), estimated=False)

    def _rows(self, begin: int, count: int) -> np.memmap:
        """Map a part alone: pages of a larger map that were read would count as memory."""
        offset = self._offset + begin * self._columns.itemsize
        return np.memmap(self.path, self._columns, "r", offset, count)
