"""A mesh cut off by a horizontal plane."""

import numpy as np

from ._mesh import Mesh, unit


def cut_below(mesh: Mesh, height: float) -> Mesh:
    """Give what lies above `y = height` (mm), triangles across the plane cut along it; the border stays open."""
    above = mesh.vertices[mesh.faces, 1] >= height
    corners_above = above.sum(axis=1)
    parts = [mesh.select(corners_above == 3)]
    for number in (1, 2):
        chosen = np.flatnonzero(corners_above == number)
        if len(chosen):
            lonely = (above[chosen] if number == 1 else ~above[chosen]).argmax(axis=1)
            parts.append(_cut(mesh, chosen, lonely, height, keep_lonely=number == 1))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate([part.normals for part in parts]),
        None if mesh.uvs is None else np.concatenate([part.uvs for part in parts if part.uvs is not None]),
    )


def _cut(mesh: Mesh, chosen: np.ndarray, lonely: np.ndarray, height: float, *, keep_lonely: bool) -> Mesh:
    """Cut triangles with one corner alone on its side: the tip is kept, or the two triangles that remain below it."""
    turn = (lonely[:, None] + np.arange(3)) % 3
    rows = np.arange(len(chosen))[:, None]
    faces = mesh.faces[chosen][rows, turn]
    corners = [mesh.vertices[faces], mesh.normals[faces]]
    if mesh.uvs is not None:
        corners.append(mesh.uvs[chosen][rows, turn])
    y = corners[0][..., 1]
    share = ((height - y[:, :1]) / (y[:, 1:] - y[:, :1]))[..., None]
    cut = [values[:, :1] * (1 - share) + values[:, 1:] * share for values in corners]  # on the edges lonely-second, lonely-third
    if keep_lonely:
        pieces = [np.concatenate([whole[:, :1], on_edge], axis=1) for whole, on_edge in zip(corners, cut, strict=True)]
    else:
        pieces = [
            np.concatenate(
                [
                    np.stack([on_edge[:, 0], whole[:, 1], whole[:, 2]], axis=1),
                    np.stack([on_edge[:, 0], whole[:, 2], on_edge[:, 1]], axis=1),
                ]
            )
            for whole, on_edge in zip(corners, cut, strict=True)
        ]
    vertices = pieces[0].reshape(-1, 3)
    uvs = pieces[2] if len(pieces) == 3 else None
    return Mesh(vertices, np.arange(len(vertices)).reshape(-1, 3), unit(pieces[1].reshape(-1, 3)), uvs)
