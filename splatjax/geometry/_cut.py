"""A mesh cut off by a horizontal plane."""

import numpy as np

from ._mesh import Mesh, unit


def cut_below(mesh: Mesh, height: float) -> Mesh:
    """Give what lies above `y = height` (mm), triangles across the plane cut along it; the border
    stays open.
    """
    above = mesh.vertices[mesh.faces, 1] >= height
    corners_above = above.sum(axis=1)
    parts = [mesh.select(corners_above == 3)]
    for number in (1, 2):
        chosen = np.flatnonzero(corners_above == number)
        if len(chosen):
            lonely = (above[chosen] if number == 1 else ~above[chosen]).argmax(axis=1)
            parts.append(_cut(mesh, chosen, lonely, height, keep_lonely=number == 1))
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])

    def joined(name: str) -> np.ndarray | None:
        return (
            None
            if getattr(mesh, name) is None
            else np.concatenate([getattr(part, name) for part in parts])
        )

    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=False)]),
        np.concatenate([part.normals for part in parts]),
        joined("uvs"),
        joined("colors"),
        joined("parts"),
    )


def _cut(
    mesh: Mesh, chosen: np.ndarray, lonely: np.ndarray, height: float, *, keep_lonely: bool
) -> Mesh:
    """Cut triangles with one corner alone on its side: the tip is kept, or the two triangles that
    remain below it.
    """
    turn = (lonely[:, None] + np.arange(3)) % 3
    rows = np.arange(len(chosen))[:, None]
    faces = mesh.faces[chosen][rows, turn]
    corners = {"vertices": mesh.vertices[faces], "normals": mesh.normals[faces]}
    if mesh.uvs is not None:
        corners["uvs"] = mesh.uvs[chosen][rows, turn]
    if mesh.colors is not None:
        corners["colors"] = mesh.colors[faces]
    y = corners["vertices"][..., 1]
    share = ((height - y[:, :1]) / (y[:, 1:] - y[:, :1]))[..., None]

    def pieces(whole: np.ndarray) -> np.ndarray:
        cut = (
            whole[:, :1] * (1 - share) + whole[:, 1:] * share
        )  # on the edges lonely-second, lonely-third
        if keep_lonely:
            return np.concatenate([whole[:, :1], cut], axis=1)
        return np.concatenate(
            [
                np.stack([cut[:, 0], whole[:, 1], whole[:, 2]], axis=1),
                np.stack([cut[:, 0], whole[:, 2], cut[:, 1]], axis=1),
            ]
        )

    found = {name: pieces(whole) for name, whole in corners.items()}
    vertices = found["vertices"].reshape(-1, 3)
    parts = None if mesh.parts is None else np.tile(mesh.parts[chosen], 1 if keep_lonely else 2)
    colors = found["colors"].reshape(-1, 3) if "colors" in found else None
    faces = np.arange(len(vertices)).reshape(-1, 3)
    return Mesh(
        vertices, faces, unit(found["normals"].reshape(-1, 3)), found.get("uvs"), colors, parts
    )
