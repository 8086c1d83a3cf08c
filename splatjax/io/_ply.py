"""Splats in PLY files."""

import os
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import plyfile

from splatjax.geometry import complete_splats, unit
from splatjax.scene import Splats

from ._atomic import atomic_path
from ._files import check_unit, existing_file
from ._mesh import MESHES_ALONE
from ._pieces import moderate
from ._ply_columns import Table, colors_of, columns_of, normals_of, places_of, vertex_table
from ._ply_tables import read_ply

RADIUS = ("radius", "radii")
AREA = ("area", "areas")
_SHORTEST, _LONGEST = 1e-9, 1e9  # mm: beyond, single precision loses areas
_LARGEST = 1e6
_COVER = (
    "cover it with splats first: `splatjax sample {} --mm-per-unit ... --output "
    "...`, or sample_mesh"
)
_GAUSSIAN_SPLATTING = ("f_dc_0", "scale_0", "rot_0")


def read_splats(path: str | os.PathLike[str], *, mm_per_unit: float = 1.0) -> Splats:
    r"""Read splats from the vertices of a PLY file: ASCII or binary of either byte order,
    properties in any order.

    | property | what it is |
    | --- | --- |
    | `x y z` | center, in the file's unit |
    | `nx ny nz` | normal, made unit; estimated from neighbors when absent |
    | `radius` (or `radii`) | in the file's unit; from the local density when absent |
    | `area` (or `areas`) | in the file's unit squared; from the local density when absent |
    | `red green blue` | albedo: integers are sRGB up to the type's maximum, floats are linear |
    | `specular`, `roughness` | factors on the material's |

    Other properties and elements are left alone; where there are faces and no radii, a warning says
    so.

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm.

    **Returns:** splats in mm, in JAX's default precision and in Morton order.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file is no PLY, is cut short, has no
    points, values that are not finite, radii or areas that are not positive, or holds a
    Gaussian-splatting scene.
    """
    path = existing_file(path)
    check_unit(path, mm_per_unit)
    if path.suffix.lower() in MESHES_ALONE:
        raise ValueError(f"{path}: is a mesh; {_COVER.format(path)}")
    file = read_ply(path)
    vertices = vertex_table(path, file)
    if all(name in vertices for name in _GAUSSIAN_SPLATTING):
        raise ValueError(
            f"{path}: is a Gaussian-splatting scene (f_dc, scale, rot, opacity): its fuzzy "
            "ellipsoids carry baked radiance and no"
            " surface; give a PLY of surface points (x y z, and nx ny nz, radius, red green blue "
            "where known)"
        )
    centers = places_of(path, vertices)
    normals = normals_of(path, vertices)
    radii, areas = (
        positive_of(path, vertices, RADIUS, mm_per_unit),
        positive_of(path, vertices, AREA, mm_per_unit**2),
    )
    check_place(path, centers * mm_per_unit, estimated=radii is None or areas is None)
    if radii is None and file.rows("face"):
        warnings.warn(
            f"{path}: has faces, and only their corners are taken, as points; "
            f"{_COVER.format(path)}",
            stacklevel=2,
        )
    albedo = colors_of(path, vertices)
    specular, roughness = (factor_of(path, vertices, name) for name in ("specular", "roughness"))
    try:
        return complete_splats(
            centers * mm_per_unit,
            normals=None if normals is None else unit(moderate(normals)),
            radii=radii,
            areas=areas,
            albedo=albedo,
            specular=specular,
            roughness=roughness,
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write_splats(path: str | os.PathLike[str], splats: Splats) -> None:
    r"""Write splats to a binary PLY file, in mm, as float32, whole or not at all.

    Albedo of three channels is written as linear `red green blue` floats (no loss), so that
    `read_splats` gives it back.

    **Raises:** `FileNotFoundError` when the folder does not exist, `ValueError` for an albedo that
    has not three channels.
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
            raise ValueError(
                f"{path}: albedo has {splats.albedo.shape[-1]} channels; a PLY holds red, green "
                "and blue"
            )
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
        plyfile.PlyData([element], text=False, byte_order="<", comments=comments).write(
            str(temporary)
        )


def check_place(path: Path, centers: np.ndarray, *, estimated: bool) -> None:
    """Refuse points that lie where numbers of JAX's default precision cannot tell them apart."""
    low, high = centers.min(axis=0), centers.max(axis=0)
    reach, extent = float(np.abs([low, high]).max()), float((high - low).max())
    if not reach <= _LONGEST:
        raise ValueError(
            f"{path}: its points reach {reach:.3g} mm; give its unit (mm_per_unit), or scale it"
        )
    if estimated and extent < 1e3 * _SHORTEST:
        raise ValueError(
            f"{path}: its {len(centers)} points lie within {extent:.3g} mm; give its unit "
            "(mm_per_unit), or scale it"
        )
    resolved = float(jnp.finfo(jnp.result_type(float)).eps) * reach
    if 0 < extent < 1e4 * resolved:
        raise ValueError(
            f"{path}: its points lie {reach:.3g} mm from the origin, where single precision tells "
            f"{resolved:.2g} mm apart, and it"
            f" is {extent:.3g} mm large; move it to the origin"
        )


def positive_of(
    path: Path,
    vertices: Table,
    aliases: tuple[str, ...],
    scale: float,
    then: str = "to have it estimated",
) -> np.ndarray | None:
    """Give radii or areas, in mm; where they are left out, `then` says what is to be done."""
    name = next((alias for alias in aliases if alias in vertices), None)
    values = None if name is None else columns_of(path, vertices, (name,))
    if values is None:
        return None
    values = values[:, 0]
    bad = np.flatnonzero(values <= 0)
    if len(bad):
        raise ValueError(
            f"{path}: the {name} of vertex {bad[0]} is {values[bad[0]]:g} ({len(bad)} such "
            "vertices); it must be positive,"
            f" or leave {name} out {then}"
        )
    if values.max() * scale > _LONGEST**2 or values.min() * scale < _SHORTEST**2:
        said = f"{name} ranges from {values.min():.3g} to {values.max():.3g}"
        raise ValueError(f"{path}: {said}; give its unit (mm_per_unit), or mend it")
    return values * scale


def factor_of(path: Path, vertices: Table, name: str) -> np.ndarray | None:
    """Give a column of factors on what the material has; `None` if there is none."""
    values = columns_of(path, vertices, (name,))
    if values is None:
        return None
    reached = values.min() if values.min() < 0 else values.max()
    if not 0 <= reached <= _LARGEST:
        raise ValueError(
            f"{path}: {name} reaches {reached:g}; it is a factor on the material's, from 0 to "
            f"{_LARGEST:g}"
        )
    return values[:, 0]
