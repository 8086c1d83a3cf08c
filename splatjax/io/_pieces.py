"""Pieces of a mesh, as files hold them: each of one material; and how they become one mesh."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from splatjax.geometry import Mesh, Textures, unit, vertex_normals

_FARTHEST = 1e12  # beyond, areas overflow
_MOST_TILES = 1e6  # that a texture is repeated
Picture = Float[np.ndarray, "height width 3"]
Wrap = Literal["wrap", "edge", "symmetric"]
"""How a texture goes on beyond its border: as `numpy.pad` calls it."""


class Piece(NamedTuple):
    """Triangles of one material, in the file's unit.

    `normals` may be of any length; those of length zero, and all if there are none, are made of the
    triangles. `uvs` have v up. `colors` of vertices and the material's own `color` are linear and
    are multiplied with the texture, which is read when it is called for; `wraps` says how it goes
    on along u and v.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"] | None = None
    uvs: Float[np.ndarray, "faces 3 2"] | None = None
    colors: Float[np.ndarray, "vertices 3"] | None = None
    texture: Callable[[], Picture] | None = None
    color: tuple[float, ...] = (1.0, 1.0, 1.0)
    wraps: tuple[Wrap, Wrap] = ("wrap", "wrap")


def join_pieces(
    path: Path, pieces: Sequence[Piece], mm_per_unit: float, *, upside_down: bool
) -> Mesh:
    """Make one mesh of pieces, in mm.

    **Raises:** `ValueError` when there is no triangle, values are not finite, or faces name
    vertices that are not there.
    """
    pieces = [piece for piece in pieces if len(piece.faces)]
    if not pieces:
        raise ValueError(
            f"{path}: holds no triangle; give a triangle mesh, or read points with read_splats"
        )
    meshes = [_mesh(path, piece, mm_per_unit, upside_down) for piece in pieces]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    textured = all(
        mesh.uvs is not None or piece.texture is None
        for mesh, piece in zip(meshes, pieces, strict=True)
    )
    if not textured:
        raise ValueError(
            f"{path}: names a texture for faces without texture coordinates; give them "
            "coordinates, or no texture"
        )
    uvs = None
    if any(mesh.uvs is not None for mesh in meshes):
        uvs = np.concatenate(
            [
                np.full((len(mesh.faces), 3, 2), np.nan) if mesh.uvs is None else mesh.uvs
                for mesh in meshes
            ]
        )
    colors = None
    if any(mesh.colors is not None for mesh in meshes):
        colors = np.concatenate(
            [np.ones_like(mesh.vertices) if mesh.colors is None else mesh.colors for mesh in meshes]
        )
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
        uvs,
        colors,
        np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        if len(meshes) > 1
        else None,
    )


def own_albedo(pieces: Sequence[Piece]) -> Textures:
    """Give the albedo that pieces wear: textures, where there are none their plain colors; nothing
    if none has a texture.
    """
    pieces = [piece for piece in pieces if len(piece.faces)]
    if all(piece.texture is None for piece in pieces):
        return Textures()
    colors = [np.asarray(piece.color)[None, None] for piece in pieces]
    worn = [
        piece.texture() * color if piece.texture else color
        for piece, color in zip(pieces, colors, strict=True)
    ]
    return Textures(albedo=worn[0] if len(worn) == 1 else tuple(worn))


def check_places(path: Path, places: Float[np.ndarray, "n 3"]) -> None:
    """Refuse places of vertices that are not finite, or so far away that they can be none."""
    if not (np.abs(places) < _FARTHEST).all():
        raise ValueError(
            f"{path}: has vertices that are not finite, or reach {_FARTHEST:g} units; mend or "
            "remove them"
        )


def moderate(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Scale vectors of any length so that squares of their components neither overflow nor vanish;
    those of zero stay.
    """
    x, y, z = np.abs(vectors).T
    greatest = np.maximum(np.maximum(x, y), z)[:, None]
    with np.errstate(invalid="ignore"):  # infinite ones become no numbers, and are refused as such
        return vectors / np.where(greatest > 0, greatest, 1.0)


def _mesh(path: Path, piece: Piece, mm_per_unit: float, upside_down: bool) -> Mesh:
    count = len(piece.vertices)
    check_places(path, piece.vertices)
    if piece.normals is not None and not np.isfinite(piece.normals).all():
        raise ValueError(f"{path}: has normals that are not finite; mend or remove them")
    if piece.faces.min() < 0 or piece.faces.max() >= count:
        raise ValueError(
            f"{path}: a face names vertex {piece.faces.max()} of {count}; write the file again"
        )
    vertices = np.asarray(piece.vertices, np.float64) * mm_per_unit
    normals = None if piece.normals is None else moderate(piece.normals)
    if normals is None or (normals == 0).all(axis=1).any():
        made = vertex_normals(vertices, piece.faces)
        normals = (
            made
            if normals is None
            else np.where((normals == 0).all(axis=1, keepdims=True), made, normals)
        )
    uvs = piece.uvs
    if uvs is not None:
        if not (np.abs(uvs) < _MOST_TILES).all():
            raise ValueError(
                f"{path}: has texture coordinates that are not finite, or reach {_MOST_TILES:g}; "
                "mend them"
            )
        uvs = np.stack([uvs[..., 0], 1 - uvs[..., 1] if upside_down else uvs[..., 1]], axis=-1)
    if piece.colors is not None and not ((piece.colors >= 0) & (piece.colors <= 1)).all():
        raise ValueError(f"{path}: has colors of vertices outside [0, 1]; mend or remove them")
    return Mesh(
        vertices,
        np.asarray(piece.faces, np.int64),
        unit(np.asarray(normals, np.float64)),
        uvs,
        piece.colors,
    )
