"""Meshes from GLB, glTF, OBJ, PLY, STL and OFF files, with their maps."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from splatjax.geometry import Mesh, Textures, cut_below, sample_mesh as sample_surface
from splatjax.scene import Splats

from ._files import check_unit, existing_file
from ._gltf import read_gltf
from ._obj import read_obj
from ._pictures import read_color, read_factor, read_vectors
from ._pieces import Piece, join_pieces, own_albedo
from ._ply_mesh import read_ply_mesh
from ._room import check_room
from ._solids import read_off, read_stl
from ._tiles import tiled

_READERS: dict[str, Callable[[Path], list[Piece]]] = {
    ".glb": read_gltf,
    ".gltf": read_gltf,
    ".obj": read_obj,
    ".ply": read_ply_mesh,
    ".stl": read_stl,
    ".off": read_off,
}
MESHES_ALONE = frozenset(_READERS) - {".ply"}
"""Suffixes of files that hold meshes and no splats."""
_BYTES_PER_SPLAT = 2500.0  # while they are spread, measured: 1.2 GB for 683,549
Name = str | os.PathLike[str]


def sample_mesh(
    path: Name,
    count: int,
    *,
    mm_per_unit: float,
    albedo: Name | None = None,
    specular: Name | None = None,
    normal: Name | None = None,
    v_up: bool | None = None,
    crop_min_y: float | None = None,
    seed: int = 0,
    rounded: bool = True,
) -> Splats:
    r"""Cover the mesh in a file (GLB, glTF, OBJ, PLY, STL, OFF) with splats, its maps and the
    colors of its vertices baked in.

    **Arguments:**

    - `count`: of splats.
    - `mm_per_unit`: length of the file's unit, mm. glTF prescribes meters (1000), yet many scans
      ignore that.
    - `albedo`: picture, sRGB; `None`: the base color textures that the file itself carries, if any.
    - `specular`: gray picture, not decoded: factor on the material's specular strength.
    - `normal`: tangent-space normal map, not decoded; green points up.
    - `v_up`: whether v = 0 is the *lower* edge of a map. `None` means what the format prescribes:
      yes for all but glTF and GLB. Files converted without care need `True`: with the wrong choice
      the lips land on the chin.
    - `crop_min_y`: what lies below this height, in the file's unit, is cut off.
    - `seed`: another spread of the same quality.
    - `rounded`: put splats where the surface is that bends as the mesh's normals do; otherwise on
      its flat triangles, whose edges show where light ends. Edges stay where normals are more than
      40 degrees off their triangles.

    **Returns:** splats in mm; `splatjax.geometry.sample_mesh` says how they are spread.

    **Raises:** `FileNotFoundError`, or `ValueError` that names the file and says what is wrong and
    what would be right.
    """
    path = existing_file(path)
    check_room(f"{path}: {count} splats", _BYTES_PER_SPLAT * count, "take fewer")
    mesh, textures = read_textured_mesh(
        path,
        mm_per_unit=mm_per_unit,
        albedo=albedo,
        specular=specular,
        normal=normal,
        v_up=v_up,
        crop_min_y=crop_min_y,
    )
    dressed = any(
        picture is not None for picture in (textures.albedo, textures.specular, textures.normal)
    )
    try:
        return sample_surface(
            mesh, count, textures=textures if dressed else None, seed=seed, rounded=rounded
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_textured_mesh(
    path: Name,
    *,
    mm_per_unit: float,
    albedo: Name | None = None,
    specular: Name | None = None,
    normal: Name | None = None,
    v_up: bool | None = None,
    crop_min_y: float | None = None,
) -> tuple[Mesh, Textures]:
    """Read the mesh in a file, and its maps, as `sample_mesh` does; arguments and errors are its
    own.
    """
    mesh, textures = read_mesh(path, mm_per_unit=mm_per_unit, v_up=v_up, dressed=albedo is None)
    textures = Textures(
        albedo=textures.albedo if albedo is None else read_color(albedo),
        specular=None if specular is None else read_factor(specular),
        normal=None if normal is None else read_vectors(normal),
    )
    dressed = any(
        picture is not None for picture in (textures.albedo, textures.specular, textures.normal)
    )
    laid = any(each is not None for each in (albedo, specular, normal))
    if dressed and (mesh.uvs is None or (laid and np.isnan(mesh.uvs).any())):
        raise ValueError(
            f"{path}: has no texture coordinates, so no map can be laid on it; give a mesh with "
            "UVs, or no maps"
        )
    if albedo is not None and mesh.colors is not None:
        mesh = Mesh(mesh.vertices, mesh.faces, mesh.normals, mesh.uvs, None, mesh.parts)
    if crop_min_y is not None:
        top = mesh.vertices[:, 1].max() / mm_per_unit
        if not crop_min_y < top:
            raise ValueError(
                f"{path}: crop_min_y = {crop_min_y:g} leaves nothing; the mesh ends at y = {top:g} "
                "in the file's unit"
            )
        mesh = cut_below(mesh, crop_min_y * mm_per_unit)
    return mesh, textures


def read_mesh(
    path: Name, *, mm_per_unit: float, v_up: bool | None = None, dressed: bool = True
) -> tuple[Mesh, Textures]:
    """Read all triangles of a file as one mesh in mm and, if it is to come `dressed`, the base
    colors that it carries.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read, has no triangle,
    or values not finite.
    """
    path = existing_file(path)
    check_unit(path, mm_per_unit)
    kind = path.suffix.lower()
    if kind not in _READERS:
        raise ValueError(
            f"{path}: {kind or 'no suffix'} is no mesh format known here; give one of "
            f"{', '.join(_READERS)}"
        )
    pieces = _READERS[kind](path)
    prescribed = kind not in (".glb", ".gltf")
    upside_down = v_up is not None and v_up != prescribed
    if dressed:
        pieces = [tiled(path, piece, upside_down=upside_down) for piece in pieces]
    mesh = join_pieces(path, pieces, mm_per_unit, upside_down=upside_down)
    return mesh, own_albedo(pieces) if dressed else Textures()
