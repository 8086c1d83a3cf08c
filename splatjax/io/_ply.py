"""Splats in PLY files."""

import os
from pathlib import Path

import numpy as np
import plyfile

from splatjax.geometry import complete_splats
from splatjax.scene import Splats

from ._atomic import atomic_path
from ._color import srgb_to_linear

_RADIUS = ("radius", "radii")
_AREA = ("area", "areas")
_COLOR = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_GAUSSIAN_SPLATTING = ("f_dc_0", "scale_0", "rot_0")


def read_splats(path: str | os.PathLike[str], *, mm_per_unit: float = 1.0) -> Splats:
    r"""Read splats from the vertices of a PLY file: ASCII or binary of either byte order, properties in any order.

    | property | what it is |
    | --- | --- |
    | `x y z` | center, in the file's unit |
    | `nx ny nz` | normal, made unit; estimated from neighbours when absent |
    | `radius` (or `radii`) | in the file's unit; from the local density when absent |
    | `area` (or `areas`) | in the file's unit squared; from the local density when absent |
    | `red green blue` | albedo: integers are sRGB up to the type's maximum, floats are linear |
    | `specular`, `roughness` | factors on the material's |

    Other properties and elements are left alone.

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm.

    **Returns:** splats in mm, in JAX's default precision and in Morton order.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file is no PLY, is cut short, has no points, values that are
    not finite, radii or areas that are not positive, or holds a Gaussian-splatting scene.
    """
    path = Path(path)
    _check_unit(path, mm_per_unit)
    vertices = _read_vertices(path)
    names = set(vertices.dtype.names or ())
    if all(name in names for name in _GAUSSIAN_SPLATTING):
        raise ValueError(
            f"{path}: is a Gaussian-splatting scene (f_dc, scale, rot, opacity): its fuzzy ellipsoids carry baked radiance and no"
            " surface; give a PLY of surface points (x y z, and nx ny nz, radius, red green blue where known)"
        )
    centers = _columns(path, vertices, ("x", "y", "z"))
    if centers is None:
        raise ValueError(f"{path}: its vertices have no x, y, z; they have {', '.join(vertices.dtype.names or ()) or 'nothing'}")
    normals = _columns(path, vertices, ("nx", "ny", "nz"))
    if normals is not None:
        normals = _unit_normals(path, normals)
    radii, areas = (_positive(path, vertices, names, aliases) for aliases in (_RADIUS, _AREA))
    albedo = next((found for found in (_colors(path, vertices, triple) for triple in _COLOR) if found is not None), None)
    specular, roughness = (_factor(path, vertices, name) for name in ("specular", "roughness"))
    try:
        return complete_splats(
            centers * mm_per_unit,
            normals=normals,
            radii=None if radii is None else radii * mm_per_unit,
            areas=None if areas is None else areas * mm_per_unit**2,
            albedo=albedo,
            specular=specular,
            roughness=roughness,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write_splats(path: str | os.PathLike[str], splats: Splats) -> None:
    r"""Write splats to a binary PLY file, in mm, as float32, whole or not at all.

    Albedo of three channels is written as linear `red green blue` floats (no loss), so that `read_splats` gives it back.

    **Raises:** `FileNotFoundError` when the folder does not exist, `ValueError` for an albedo that has not three channels.
    """
    path = Path(path)
    columns = {
        **dict(zip(("x", "y", "z"), np.asarray(splats.centers).T, strict=True)),
        **dict(zip(("nx", "ny", "nz"), np.asarray(splats.normals).T, strict=True)),
        "radius": np.asarray(splats.radii),
        "area": np.asarray(splats.areas),
    }
    if splats.albedo is not None:
        if splats.albedo.shape[-1] != 3:
            raise ValueError(f"{path}: albedo has {splats.albedo.shape[-1]} channels; a PLY holds red, green and blue")
        columns |= dict(zip(("red", "green", "blue"), np.asarray(splats.albedo).T, strict=True))
    for name in ("specular", "roughness"):
        if (values := getattr(splats, name)) is not None:
            columns[name] = np.asarray(values)
    table = np.empty(splats.count, [(name, "<f4") for name in columns])
    for name, values in columns.items():
        table[name] = values
    comments = ["lengths in mm", "red green blue are linear albedo, Rec. 709 primaries"]
    element = plyfile.PlyElement.describe(table, "vertex")
    with atomic_path(path) as temporary:
        plyfile.PlyData([element], text=False, byte_order="<", comments=comments).write(str(temporary))


def _check_unit(path: Path, mm_per_unit: float) -> None:
    if not (np.isfinite(mm_per_unit) and mm_per_unit > 0):
        raise ValueError(f"{path}: mm_per_unit is {mm_per_unit}; it must be the positive length of the file's unit in mm")


def _read_vertices(path: Path) -> np.ndarray:
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    try:
        data = plyfile.PlyData.read(str(path))
    except (plyfile.PlyParseError, ValueError, UnicodeDecodeError, EOFError, OverflowError, MemoryError) as error:
        raise ValueError(f"{path}: cannot be read as PLY ({error}); it is cut short or no PLY file, write it again") from error
    element = next((element for element in data.elements if element.name == "vertex"), None)
    if element is None:
        raise ValueError(f"{path}: has no element `vertex`; a PLY file of points keeps them there")
    if element.count == 0:
        raise ValueError(f"{path}: is empty, it holds no vertex; give a file with at least one point")
    return np.asarray(element.data)


def _columns(path: Path, vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
    have = vertices.dtype.names or ()
    if not all(name in have for name in names):
        return None
    values = np.stack([vertices[name] for name in names], axis=-1).astype(np.float64)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=-1))
    if len(bad):
        raise ValueError(
            f"{path}: {' '.join(names)} of vertex {bad[0]} is not finite ({len(bad)} such vertices); remove or mend them"
        )
    return values


def _unit_normals(path: Path, normals: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    bad = np.flatnonzero(length[:, 0] == 0)
    if len(bad):
        raise ValueError(
            f"{path}: the normal of vertex {bad[0]} has length zero ({len(bad)} such vertices); mend it, or leave out nx ny nz"
        )
    return normals / length


def _positive(path: Path, vertices: np.ndarray, names: set[str], aliases: tuple[str, ...]) -> np.ndarray | None:
    name = next((alias for alias in aliases if alias in names), None)
    values = None if name is None else _columns(path, vertices, (name,))
    if values is None:
        return None
    values = values[:, 0]
    bad = np.flatnonzero(values <= 0)
    if len(bad):
        raise ValueError(
            f"{path}: the {name} of vertex {bad[0]} is {values[bad[0]]:g} ({len(bad)} such vertices); it must be positive,"
            f" or leave {name} out to have it estimated"
        )
    return values


def _colors(path: Path, vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray | None:
    values = _columns(path, vertices, names)
    if values is None:
        return None
    kinds = {vertices.dtype[name] for name in names}
    if all(kind.kind in "iu" for kind in kinds):
        values = srgb_to_linear(values / max(np.iinfo(kind).max for kind in kinds))
    if values.min() < 0 or values.max() > 1:
        raise ValueError(
            f"{path}: {' '.join(names)} range from {values.min():g} to {values.max():g}; floats are linear albedo in [0, 1],"
            " integers are sRGB"
        )
    return values


def _factor(path: Path, vertices: np.ndarray, name: str) -> np.ndarray | None:
    values = _columns(path, vertices, (name,))
    if values is None:
        return None
    if values.min() < 0:
        raise ValueError(f"{path}: {name} reaches {values.min():g}; it is a factor on the material's and cannot be negative")
    return values[:, 0]
