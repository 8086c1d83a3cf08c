"""Splats of a PLY file that is larger than memory, a part at a time."""

import os
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import plyfile

from splatjax.geometry import unit
from splatjax.scene import Splats

from ._files import check_unit, existing_file
from ._library import readable
from ._pieces import moderate
from ._ply import AREA, RADIUS, check_place, factor_of, positive_of
from ._ply_columns import Table, colors_of, normals_of, places_of

_PART = 1_000_000
_COMPLETED = (
    "complete the file first: splatjax.write_splats(complete, splatjax.read_splats(path)) "
    "estimates nx ny nz, radius and area"
    " where they are left out, and `splatjax sample` of a mesh writes them"
)


class SplatFile:
    r"""Complete splats in a binary PLY file, read a part at a time: what `splatjax.render_streamed`
    asks for.

    Their order is that of the file: splats that are near in space should be near in it
    (`read_splats` sorts, a stream cannot).

    **Arguments:**

    - `path`: a PLY file whose vertices have `x y z`, `nx ny nz`, `radius` and `area`, as
      `read_splats` reads them, and no lists.
    - `part`: splats of a part; about 1 kB of memory each.
    - `mm_per_unit`: length of the file's unit, mm.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file is no binary PLY, or lacks one of
    these.
    """

    def __init__(
        self, path: str | os.PathLike[str], part: int = _PART, *, mm_per_unit: float = 1.0
    ):
        self.path, self.part, self.mm_per_unit = existing_file(path), part, mm_per_unit
        if part < 1:
            raise ValueError(f"part is {part}; it must be at least one splat")
        check_unit(self.path, mm_per_unit)
        with readable(self.path, "PLY"):
            elements = {
                element.name: element for element in plyfile.PlyData.read(str(self.path), mmap="r")
            }
        vertices = elements["vertex"].data if "vertex" in elements else None
        if not isinstance(vertices, np.memmap):
            raise ValueError(
                f"{path}: its vertices cannot be read in parts; write them as binary, without "
                "lists, at least one"
            )
        self.count, self._rows, self._offset = len(vertices), vertices.dtype, int(vertices.offset)
        names = self._names = self._rows.names or ()
        for needed in (("nx",), ("ny",), ("nz",), RADIUS, AREA):
            if not any(name in names for name in needed):
                raise ValueError(
                    f"{path}: its vertices have no {needed[0]}, which a part of them cannot tell; "
                    f"{_COMPLETED}"
                )

    def __call__(self) -> Iterator[Splats]:
        """Give all splats from the beginning, in mm and in JAX's default precision, in parts of one
        size but the last.

        **Raises:** `ValueError` when numbers are not finite, or not what `read_splats` asks for;
        how large the whole is turns out at the end.
        """
        corners = []
        for begin in range(0, self.count, self.part):
            size = min(self.part, self.count - begin)
            # not mapped: pages that were read would count as memory until something else needs it
            rows = np.fromfile(
                self.path, self._rows, size, offset=self._offset + begin * self._rows.itemsize
            )
            if len(rows) < size:
                raise ValueError(
                    f"{self.path}: is cut short: vertex {begin + len(rows)} of {self.count} is not "
                    "there"
                )
            places = (
                places_of(self._where(begin), {name: rows[name] for name in "xyz"})
                * self.mm_per_unit
            )
            corners += [[axis.min() for axis in places.T], [axis.max() for axis in places.T]]
            yield self._splats(begin, rows, places)
        check_place(self.path, np.stack(corners), estimated=False)

    def _where(self, begin: int) -> Path:
        return self.path.with_name(f"{self.path.name}, from vertex {begin}") if begin else self.path

    def _splats(self, begin: int, rows: np.ndarray, places: np.ndarray) -> Splats:
        where, scale = self._where(begin), self.mm_per_unit
        table: Table = {name: rows[name] for name in self._names}
        normals, albedo = normals_of(where, table, f"and {_COMPLETED}"), colors_of(where, table)
        assert normals is not None  # nx is there, and not without the others
        given = (
            places,
            unit(moderate(normals)),
            positive_of(where, table, RADIUS, scale, f"and {_COMPLETED}"),
            positive_of(where, table, AREA, scale**2, f"and {_COMPLETED}"),
        )
        rest = albedo, *(factor_of(where, table, name) for name in ("specular", "roughness"))
        dtype = jnp.result_type(float)
        return Splats(
            *(jnp.asarray(each, dtype) for each in given),
            *(None if each is None else jnp.asarray(each, dtype) for each in rest),
        )
