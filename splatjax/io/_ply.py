"""Splats in PLY files, read at once or, for files larger than memory, in parts."""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatjax._display import srgb_to_linear
from splatjax.geometry import complete_splats, unit
from splatjax.scene import Splats

from ._files import (
    StrPath,
    atomic_path,
    check_suffix,
    check_units,
    existing_file,
    expect,
    naming,
    with_y_up,
)
from ._gaussian_scenes import GAUSSIAN_COLUMNS, spz_columns, surface_columns
from ._trimesh import FORMATS, load_with_trimesh, one_sentence

_SHORTEST, _LONGEST = 1e-9, 1e9  # mm; outside this range areas overflow or underflow in float32
_COVER = (
    "sample splats from it first: `splatjax sample {} --mm-per-unit ... --output ...`, in Python "
    "sj.sample_mesh"
)
_COMPLETE = (
    "complete the file first: splatjax.write_splats(complete, splatjax.read_splats(path)) "
    "estimates normals, radii and areas, and `splatjax sample` of a mesh writes them"
)
_GAUSSIAN_SPLATTING = {"f_dc_0", "scale_0", "rot_0"}
# Vertex columns of a PLY file for each field of splats.
_COLUMNS = {
    "centers": [("x", "y", "z")],
    "normals": [("nx", "ny", "nz")],
    "radii": [("radius",), ("radii",)],
    "areas": [("area",), ("areas",)],
    "albedo": [
        ("red", "green", "blue"),
        ("r", "g", "b"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ],
    "specular": [("specular",)],
    "roughness": [("roughness",)],
}
_WEIGHT = re.compile(r"weight_([1-9]\d{0,3})_([1-9]\d{0,3})")
_POWERS = {"centers": 1, "radii": 1, "areas": 2}  # of the unit of length
_VALID = {
    "centers": (lambda x: np.abs(x) <= _LONGEST, "within 1e9 mm (check mm_per_unit)"),
    "normals": (lambda n: n.any(axis=0), "longer than zero"),
    "radii": (lambda r: (r > _SHORTEST**2) & (r < _LONGEST**2), "positive (check mm_per_unit)"),
    "areas": (lambda a: (a > _SHORTEST**2) & (a < _LONGEST**2), "positive (check mm_per_unit)"),
    "albedo": (lambda c: (c >= 0) & (c <= 1), "in [0, 1]; floats are linear, integers sRGB"),
    "specular": (lambda f: (f >= 0) & (f <= 1e6), "a factor from 0 to 1e6"),
    "roughness": (lambda f: (f >= 0) & (f <= 1e6), "a factor from 0 to 1e6"),
    "weights": (lambda f: (f >= 0) & (f <= 1e6), "factors from 0 to 1e6"),
}


def read_splats(
    path: StrPath, *, mm_per_unit: float = 1.0, up: str = "y", opacity: float = 0.5
) -> Splats:
    r"""Read splats from the vertices of a PLY file, which may be ASCII or binary with either byte
    order, with properties in any order.

    | property | contents |
    | --- | --- |
    | `x y z` | center, in the file's unit |
    | `nx ny nz` | normal, normalized on reading; estimated from neighbors if absent |
    | `radius` (or `radii`) | in the file's unit; from the local density if absent |
    | `area` (or `areas`) | in the file's unit squared; from the local density if absent |
    | `red green blue` | albedo: integers are sRGB up to the type's maximum, floats are linear |
    | `specular`, `roughness` | factors of the specular strength and roughness of the material |
    | `weight_1_1`, `weight_1_2`, ... | factors of the material's weights: Gaussian, channel |

    Other properties and elements are ignored. A file with faces and without radii raises an error,
    because a mesh must be sampled (`sample_mesh`).

    The ellipsoids of a Gaussian-splatting scene (`f_dc_0`, `scale_0`, `rot_0`, ..., or an SPZ file,
    which requires gsply) become discs: the shortest axis is the normal, and the other two determine
    the radius. A warning reports that the colors contain the light of the scene.

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm.
    - `up`: the file's upward axis, `"y"` or `"z"`; splats have +y up.
    - `opacity`: ellipsoids with a lower opacity are omitted.

    **Returns:** splats in mm, in JAX's default precision and in Morton order.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file is not PLY, is truncated, has no
    points, or has values that are not finite or radii or areas that are not positive.
    """
    path = existing_file(path)
    check_units(path, mm_per_unit, up)
    kind = path.suffix[1:].lower()
    expect(
        kind in ("ply", "spz"),
        path,
        f"is a mesh; {_COVER.format(path)}"
        if kind in FORMATS
        else "is not a PLY or SPZ file; give one of splats (scenes: `splatjax render`)",
    )
    with one_sentence(path):
        is_spz = kind == "spz"
        columns = {} if is_spz else load_with_trimesh(path, "ply")["columns"]
        vertices = spz_columns(path) if is_spz else columns.get("vertex", {})
        if vertices.keys() >= GAUSSIAN_COLUMNS:
            vertices = surface_columns(path, vertices, opacity)
        fields = _splat_fields(path, vertices, mm_per_unit, up)
    centers = fields.pop("centers")
    _check_places(path, centers, estimated=fields["radii"] is None or fields["areas"] is None)
    is_mesh = fields["radii"] is None and columns.get("face")
    expect(not is_mesh, path, f"is a mesh; {_COVER.format(path)}")
    with naming(path):
        return complete_splats(centers, **fields)


def write_splats(path: StrPath, splats: Splats) -> None:
    r"""Write splats to a binary PLY file in mm, as float32, atomically.

    An albedo of three channels is written as linear `red green blue` floats, clipped to [0, 1].

    **Raises:** `FileNotFoundError` if the folder does not exist; `ValueError` for another suffix
    than `.ply`, for an albedo that does not have three channels, and for values that `read_splats`
    refuses.
    """
    check_suffix(path, ".ply")
    path, names, columns = Path(path), [], []
    for field, aliases in _COLUMNS.items():
        values = getattr(splats, field)
        if values is not None:
            table = np.asarray(values, "<f4").reshape(splats.count, -1)
            expect(
                table.shape[1] == len(aliases[0]),
                path,
                f"{field} has {table.shape[1]} channels; a PLY file stores {', '.join(aliases[0])}",
            )
            table = np.clip(table, 0, 1) if field == "albedo" else table
            _values(path, field, dict(zip(aliases[0], table.T, strict=True)), 1.0)
            names += aliases[0]
            columns.append(table)
    if splats.weights is not None:
        names += map(
            "weight_{}_{}".format, *(1 + np.indices(splats.weights.shape[1:])).reshape(2, -1)
        )
        columns.append(np.asarray(splats.weights, "<f4").reshape(splats.count, -1))
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment lengths in mm",
        "comment red green blue are linear albedo, Rec. 709 primaries",
        f"element vertex {splats.count}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    with atomic_path(path) as temporary:
        temporary.write_bytes("\n".join(header).encode() + np.hstack(columns).tobytes())


class SplatFile:
    r"""Complete splats in a binary PLY file, read in parts for `splatjax.render_streamed`.

    The order of the file is kept, so splats that are near in space should be near in the file.
    (`read_splats` sorts them, a stream cannot.)

    **Arguments:**

    - `path`: a PLY file whose first element is the vertices, with `x y z`, `nx ny nz`, `radius` and
      `area` as in `read_splats`, and without lists.
    - `part`: number of splats per part; each takes about 1 kB of memory.
    - `mm_per_unit`: length of the file's unit, mm.
    - `up`: the file's upward axis, `"y"` or `"z"`.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file is not a binary PLY file, is
    truncated, or lacks one of these properties.
    """

    def __init__(
        self, path: StrPath, part: int = 1_000_000, *, mm_per_unit: float = 1.0, up: str = "y"
    ):
        self.path, self.part, self.mm_per_unit, self.up = existing_file(path), part, mm_per_unit, up
        check_units(self.path, mm_per_unit, up)
        expect(part >= 1, path, f"part is {part}; give at least one splat")
        with one_sentence(self.path), open(path, "rb") as file:
            from trimesh.exchange.ply import _parse_header  # slow, so imported only here

            elements, is_text, _ = _parse_header(file)
            name, vertices = next(iter(elements.items()))
            kinds = vertices["properties"]
            expect(
                not is_text and name == "vertex" and not any("LIST" in k for k in kinds.values()),
                path,
                f"its vertices are not the first element, in binary without lists; {_COMPLETE}",
            )
            self.count, self._offset = vertices["length"], file.tell()
            expect(self.count, path, "has no vertices; give at least one")
            self._names, self._columns = tuple(kinds), np.dtype(list(kinds.items()))
            self._rows(0, self.count)  # raises if the file is truncated
        for field in ("normals", "radii", "areas"):
            expect(
                any(kinds.keys() >= set(names) for names in _COLUMNS[field]),
                path,
                f"its vertices have no {' '.join(_COLUMNS[field][0])}, which cannot be estimated "
                f"part by part; {_COMPLETE}",
            )

    def __call__(self) -> Iterator[Splats]:
        """Yield all splats from the beginning, in mm and in JAX's default precision, in parts of
        equal size; the last may be smaller.

        **Raises:** `ValueError` for values that `read_splats` rejects; the total extent is checked
        at the end.
        """
        corners = []
        for begin in range(0, self.count, self.part):
            rows = self._rows(begin, min(self.part, self.count - begin))
            where = self.path.with_name(f"{self.path.name}, from vertex {begin}")
            columns: dict[str, np.ndarray] = {name: rows[name] for name in self._names}
            fields = _splat_fields(where, columns, self.mm_per_unit, self.up)
            corners += [fields["centers"].min(axis=0), fields["centers"].max(axis=0)]
            yield Splats(**fields)
        _check_places(self.path, np.stack(corners), estimated=False)

    def _rows(self, begin: int, count: int) -> np.memmap:
        """Map only one part of the file. All pages that are read from a larger map would count as
        memory.
        """
        offset = self._offset + begin * self._columns.itemsize
        return np.memmap(self.path, self._columns, "r", offset, count)


def _splat_fields(
    path: Path, columns: Mapping[str, np.ndarray], mm_per_unit: float, up: str
) -> dict[str, Any]:
    """Convert columns to fields of splats in mm with +y up. Missing fields are `None`.

    **Raises:** `ValueError` for values that are invalid for splats.
    """
    expect(
        not columns.keys() >= _GAUSSIAN_SPLATTING,
        path,
        "is a Gaussian-splatting scene, and lacks some of f_dc_0 to f_dc_2, scale_0 to scale_2, "
        "rot_0 to rot_3 and opacity, or is read in parts; give all of them to read_splats",
    )
    single = {
        name: column
        for name, column in columns.items()
        if column.dtype.kind in "iuf" and column.ndim == 1
    }
    fields: dict[str, Any] = dict.fromkeys([*_COLUMNS, "weights"])
    for field, aliases in _COLUMNS.items():
        names = next((names for names in aliases if single.keys() & set(names)), aliases[0])
        if single.keys() >= set(names):
            scale = mm_per_unit ** _POWERS.get(field, 0)
            fields[field] = _values(path, field, {name: single[name] for name in names}, scale)
        elif single.keys() & set(names) or field == "centers":
            raise ValueError(
                f"{path}: its vertices have {', '.join(single) or 'no rows'}, and not all of "
                f"{' '.join(names)}; write all of them"
            )
    factors = sorted(
        (tuple(map(int, match.groups())), match[0])
        for match in map(_WEIGHT.fullmatch, single)
        if match
    )
    if factors:
        shape = factors[-1][0]
        places = [place for place, _ in factors]
        as_many = len(places) == math.prod(shape)
        expect(
            as_many and places == [(k + 1, c + 1) for k, c in np.ndindex(shape)],
            path,
            f"its vertices only have {', '.join(name for _, name in factors)}; write one for each "
            "Gaussian and channel",
        )
        fields["weights"] = _values(
            path, "weights", {name: single[name] for _, name in factors}, 1.0
        ).reshape(-1, *shape)
    vectors = {name: fields[name] for name in ("centers", "normals") if fields[name] is not None}
    return fields | {name: with_y_up(values, up) for name, values in vectors.items()}


def _check_places(path: Path, centers: Float[np.ndarray, "n 3"], *, estimated: bool) -> None:
    """Raise `ValueError` for points that JAX's default precision does not resolve."""
    low, high = centers.min(axis=0), centers.max(axis=0)
    reach, extent = float(np.abs([low, high]).max()), float((high - low).max())
    resolved = float(jnp.finfo(jnp.result_type(float)).eps) * reach
    expect(
        extent >= 1e3 * _SHORTEST or not estimated,
        path,
        f"the extent of its points is {extent:.3g} mm; give its unit (mm_per_unit), or scale it",
    )
    expect(
        extent == 0 or extent >= 1e4 * resolved,
        path,
        f"its points are {reach:.3g} mm from the origin, where single precision resolves "
        f"{resolved:.2g} mm, and their extent is {extent:.3g} mm; move them to the origin",
    )


def _values(
    path: Path, field: str, columns: dict[str, np.ndarray], scale: float
) -> Float[np.ndarray, "*shape"]:
    with np.errstate(invalid="ignore"):  # from signaling NaN
        values = scale * np.stack(list(columns.values())).astype(np.float64)
    kind, *other_kinds = {column.dtype for column in columns.values()}
    is_encoded = field == "albedo" and not other_kinds and kind.kind in "iu"
    if is_encoded:
        values = values / np.iinfo(kind).max
    holds, expected = _VALID[field]
    bad = np.flatnonzero(~(np.isfinite(values) & holds(values)).all(axis=0))
    if len(bad):
        raise ValueError(
            f"{path}: {' '.join(columns)} of vertex {bad[0]} is "
            f"{' '.join(f'{value:g}' for value in values[:, bad[0]])} ({len(bad)} such "
            f"vertices); it must be finite and {expected}; fix it, or remove it"
        )
    if field == "normals":
        return unit((values / np.abs(values).max(axis=0)).T)
    values = srgb_to_linear(values) if is_encoded else values
    return values.T if len(columns) > 1 else values[0]
