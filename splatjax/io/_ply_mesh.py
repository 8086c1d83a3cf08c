"""Meshes from PLY files."""

from functools import partial
from pathlib import Path

import numpy as np

from ._files import file_beside
from ._pictures import read_color
from ._pieces import Piece, check_places
from ._ply_columns import colors_of, columns_of, normals_of, places_of, vertex_table
from ._ply_tables import PlyFile, Ragged, read_ply
from ._polygons import check_fans, fans

_LISTS = ("vertex_indices", "vertex_index")
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
_TEXTURE = "texturefile "  # of the comment in which programs name it


def read_ply_mesh(path: Path) -> list[Piece]:
    """Read the polygons of a PLY file as one piece, with normals, colors and texture coordinates
    where it has them.

    **Raises:** `ValueError` when it is no PLY, has no vertices or faces, or faces that name what is
    not there.
    """
    file = read_ply(path)
    vertices = vertex_table(path, file)
    places = places_of(path, vertices)
    check_places(path, places)
    if "tristrips" in file.elements:
        raise ValueError(
            f"{path}: holds triangle strips, which are not read here; export single triangles"
        )
    lists = next(
        (
            file.elements.get("face", {})[name]
            for name in _LISTS
            if name in file.elements.get("face", {})
        ),
        None,
    )
    if not isinstance(lists, Ragged) or not len(lists.counts):
        raise ValueError(
            f"{path}: holds no triangle; give a triangle mesh, or read points with read_splats"
        )
    _check_lists(path, lists, len(places))
    faces = fans(lists.counts, lists.values.astype(np.int64))
    check_fans(path, places[faces], lists.counts - 2)
    uvs = _corner_coordinates(path, file, lists)
    if uvs is None:
        pairs = (columns_of(path, vertices, names) for names in _COORDINATES)
        found = next((pair for pair in pairs if pair is not None), None)
        uvs = None if found is None else found[faces]
    named = [
        comment[len(_TEXTURE) :].strip()
        for comment in file.comments
        if comment.lower().startswith(_TEXTURE)
    ]
    texture = partial(_texture, path, named[0]) if len(named) == 1 and uvs is not None else None
    return [
        Piece(places, faces, normals_of(path, vertices), uvs, colors_of(path, vertices), texture)
    ]


def _check_lists(path: Path, lists: Ragged, count: int) -> None:
    if lists.counts.min() < 3:
        raise ValueError(
            f"{path}: face {lists.counts.argmin()} has less than three corners; remove it"
        )
    if lists.values.dtype.kind not in "iu" or not (
        lists.values.min() >= 0 and lists.values.max() < count
    ):
        raise ValueError(
            f"{path}: a face names vertex {lists.values.max()} of {count}; write the file again"
        )


def _corner_coordinates(path: Path, file: PlyFile, lists: Ragged) -> np.ndarray | None:
    """Give the texture coordinates that some programs list in each face, a pair for each corner."""
    found = file.elements["face"].get("texcoord")
    if not isinstance(found, Ragged):
        return None
    if not (found.counts == 2 * lists.counts).all():
        raise ValueError(
            f"{path}: its faces do not list two texture coordinates for each corner; write the "
            "file again"
        )
    if not (lists.counts == 3).all():
        raise ValueError(
            f"{path}: lists texture coordinates in faces of more than three corners; export "
            "triangles"
        )
    with np.errstate(invalid="ignore"):  # of NaN that signals
        return found.values.astype(np.float64).reshape(-1, 3, 2)


def _texture(path: Path, name: str) -> np.ndarray:
    return read_color(file_beside(path, name))
