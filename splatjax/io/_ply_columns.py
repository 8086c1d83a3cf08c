"""What the columns of a PLY file's vertices mean."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ._color import srgb_to_linear
from ._ply_tables import PlyFile, Ragged

_COLORS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
Table = dict[str, np.ndarray | Ragged]


def vertex_table(path: Path, file: PlyFile) -> Table:
    """Give the columns of the vertices.

    **Raises:** `ValueError` when there are none.
    """
    table = file.elements.get("vertex")
    if table is None:
        raise ValueError(f"{path}: has no element `vertex`; a PLY file of points keeps them there")
    if not table or not len(next(iter(table.values()))):
        raise ValueError(
            f"{path}: is empty, it holds no vertex; give a file with at least one point"
        )
    return table


def places_of(path: Path, table: Table) -> Float[np.ndarray, "rows 3"]:
    """Give x, y and z of vertices.

    **Raises:** `ValueError` when one is missing, or not finite.
    """
    names = ("x", "y", "z")
    places = columns_of(path, table, names) if all(name in table for name in names) else None
    if places is None:
        raise ValueError(f"{path}: its vertices have no x, y, z; they have {', '.join(table)}")
    return places


def columns_of(
    path: Path, table: Table, names: tuple[str, ...]
) -> Float[np.ndarray, "rows columns"] | None:
    """Give columns that belong together as numbers; `None` when there is none of them.

    **Raises:** `ValueError` when only some are there, are lists, or hold what is not finite.
    """
    have = [name for name in names if name in table]
    if not have:
        return None
    if len(have) < len(names):
        lacking = next(name for name in names if name not in table)
        raise ValueError(
            f"{path}: its vertices have {' '.join(have)} without {lacking}; write all of them, or "
            "none"
        )
    found = [table[name] for name in names]
    if any(isinstance(each, Ragged) for each in found):
        raise ValueError(
            f"{path}: {' '.join(names)} of its vertices are lists; write single numbers"
        )
    with np.errstate(invalid="ignore"):  # of NaN that signals
        values = np.stack(found, axis=-1).astype(np.float64)
    finite = np.isfinite(values)
    if not finite.all():
        bad = np.flatnonzero(~finite.all(axis=-1))
        raise ValueError(
            f"{path}: {' '.join(names)} of vertex {bad[0]} is not finite ({len(bad)} such "
            "vertices); remove or mend them"
        )
    return values


def normals_of(
    path: Path, table: Table, then: str = "to have them estimated"
) -> Float[np.ndarray, "rows 3"] | None:
    """Give normals, of any length but zero; where they are left out, `then` says what is to be
    done.
    """
    normals = columns_of(path, table, ("nx", "ny", "nz"))
    if normals is None:
        return None
    x, y, z = normals.T == 0
    bad = np.flatnonzero(x & y & z)
    if len(bad):
        raise ValueError(
            f"{path}: the normal of vertex {bad[0]} has length zero ({len(bad)} such vertices); "
            "mend it,"
            f" or leave nx ny nz out {then}"
        )
    return normals


def colors_of(path: Path, table: Table) -> Float[np.ndarray, "rows 3"] | None:
    """Give linear colors: whole numbers are sRGB up to the greatest that their type holds, others
    are linear.
    """
    names = next((names for names in _COLORS if any(name in table for name in names)), None)
    values = None if names is None else columns_of(path, table, names)
    if names is None or values is None:
        return None
    kinds = sorted({np.asarray(table[name]).dtype.str for name in names})
    encoded = all(kind[1] in "iu" for kind in kinds)
    if encoded:
        if len(kinds) > 1:
            raise ValueError(f"{path}: {' '.join(names)} are of several types; write them as one")
        values = values / np.iinfo(kinds[0]).max
    if values.min() < 0 or values.max() > 1:
        raise ValueError(
            f"{path}: {' '.join(names)} range from {values.min():g} to {values.max():g}; floats "
            "are linear albedo in [0, 1],"
            " integers are sRGB"
        )
    return srgb_to_linear(values) if encoded else values
