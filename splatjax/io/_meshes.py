"""Meshes from files, with their maps, and splats that cover them."""

import os
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from splatjax._memory import check_memory
from splatjax.geometry import (
    Mesh,
    Textures,
    cut_below,
    sample_mesh as sample_surface,
    split_creases,
)
from splatjax.scene import Splats

from ._files import check_units, existing_file, naming
from ._images import read_color, read_map
from ._triangles import Piece, read_pieces

_LUMA = np.asarray([0.299, 0.587, 0.114])  # of encoded color, Rec. 601
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
    up: str = "y",
    crop_min_y: float | None = None,
    crease_angle: float = 40.0,
    seed: int = 0,
    rounded: bool = True,
) -> Splats:
    r"""Cover the mesh in a file (GLB, glTF, OBJ, PLY, STL, OFF) with splats, its maps and the
    colors of its vertices baked in.

    **Arguments:**

    - `count`: of splats.
    - `mm_per_unit`: length of the file's unit, mm. glTF prescribes meters (1000), yet many scans
      ignore that.
    - `albedo`: picture, sRGB, or linear if it holds floating-point numbers; `None`: the base color
      textures that the file itself carries, if any.
    - `specular`: gray picture, not decoded: factor on the material's specular strength.
    - `normal`: tangent-space normal map, not decoded; green points up.
    - `v_up`: whether v = 0 is the *lower* edge of a map. `None` means what the format prescribes:
      yes for all but glTF and GLB. Files converted without care need `True`: with the wrong choice
      the lips land on the chin.
    - `up`: the file's upward axis, `"y"` or `"z"`; splats have +y up.
    - `crop_min_y`: what lies below this height, in the file's unit, is cut off.
    - `crease_angle`: degrees from 0 to 180. Edges between triangles that differ by more are hard,
      where the file has no normals, or normals that are more than this off their triangles.
    - `seed`: another spread of the same quality.
    - `rounded`: put splats on the surface that bends as the mesh's normals do; otherwise on its
      flat triangles, whose edges show where light ends. Hard edges stay straight.

    **Returns:** splats in mm; `splatjax.geometry.sample_mesh` describes how they are spread.

    **Raises:** `FileNotFoundError`, or `ValueError` that names the file, the fault and the
    remedy.
    """
    path = existing_file(path)
    check_memory(f"{path}: {count} splats", _BYTES_PER_SPLAT * count, "take fewer")
    mesh, textures = read_textured_mesh(
        path,
        mm_per_unit=mm_per_unit,
        albedo=albedo,
        specular=specular,
        normal=normal,
        v_up=v_up,
        up=up,
        crop_min_y=crop_min_y,
        crease_angle=crease_angle,
    )
    with naming(path):
        return sample_surface(mesh, count, textures=textures, seed=seed, rounded=rounded)


def read_textured_mesh(
    path: Name,
    *,
    mm_per_unit: float,
    albedo: Name | None = None,
    specular: Name | None = None,
    normal: Name | None = None,
    v_up: bool | None = None,
    up: str = "y",
    crop_min_y: float | None = None,
    crease_angle: float = 40.0,
) -> tuple[Mesh, Textures]:
    """Read the mesh in a file, and its maps; arguments and errors are those of `sample_mesh`.

    **Returns:** the mesh, in mm, and its maps.
    """
    path = existing_file(path)
    check_units(path, mm_per_unit, up)
    if not 0 <= crease_angle <= 180:
        raise ValueError(f"{path}: crease_angle is {crease_angle}; give degrees from 0 to 180")
    pieces = read_pieces(path, up)
    flip_v = v_up is not None and v_up == (path.suffix[1:].lower() in ("glb", "gltf"))
    mesh = split_creases(_joined(pieces, mm_per_unit, flip_v), crease_angle)
    textures = Textures(
        albedo=_own_albedo(path, pieces) if albedo is None else read_color(albedo),
        specular=None if specular is None else read_map(specular) @ _LUMA,
        normal=None if normal is None else 2 * read_map(normal) - 1,
    )
    has_maps = any(name is not None for name in (albedo, specular, normal))
    if has_maps and (mesh.uvs is None or np.isnan(mesh.uvs).any()):
        raise ValueError(
            f"{path}: has no texture coordinates, so no map can be laid on it; give a mesh with "
            "UVs (in glTF, with a material), or no maps"
        )
    if albedo is not None:
        mesh = Mesh(mesh.vertices, mesh.faces, mesh.normals, mesh.uvs)
    if crop_min_y is not None:
        top = mesh.vertices[:, 1].max() / mm_per_unit
        if not crop_min_y < top:
            raise ValueError(
                f"{path}: crop_min_y = {crop_min_y:g} leaves nothing; the mesh ends at y = {top:g} "
                "in the file's unit"
            )
        mesh = cut_below(mesh, crop_min_y * mm_per_unit)
    return mesh, textures


def _joined(pieces: Sequence[Piece], mm_per_unit: float, flip_v: bool) -> Mesh:
    """Join pieces to one mesh in mm, each a part of it; normals of length zero stay."""
    starts = np.cumsum([0, *(len(piece.mesh.vertices) for piece in pieces[:-1])])
    faces = [piece.mesh.faces + start for piece, start in zip(pieces, starts, strict=True)]
    vertices, normals, uvs, colors = (
        np.concatenate([getattr(piece.mesh, name) for piece in pieces])
        for name in ("vertices", "normals", "uvs", "colors")
    )
    return Mesh(
        mm_per_unit * vertices,
        np.concatenate(faces),
        normals,
        None if np.isnan(uvs).all() else uvs * [1, -1 if flip_v else 1] + [0, 1.0 * flip_v],
        None if np.isnan(colors).all() else np.nan_to_num(colors, nan=1.0),
        np.repeat(np.arange(len(pieces)), [len(each) for each in faces]),
    )


def _own_albedo(path: Path, pieces: Sequence[Piece]) -> np.ndarray | tuple[np.ndarray, ...] | None:
    """Decode the textures of pieces, times their plain colors; `None` if no piece has a texture."""
    pictures = {None: np.ones((1, 1, 3))}
    with naming(path), TemporaryDirectory() as folder:
        for encoded in {piece.texture for piece in pieces if piece.texture}:
            (file := Path(folder, "texture")).write_bytes(encoded)
            pictures[encoded] = read_color(file)
    maps = tuple(pictures[piece.texture] * piece.color for piece in pieces)
    return None if len(pictures) == 1 else maps if len(maps) > 1 else maps[0]
