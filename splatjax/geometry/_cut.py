"""A mesh cut off by a horizontal plane."""

from typing import Any

import numpy as np

from ._mesh import Mesh, unit


def cut_below(mesh: Mesh, height: float) -> Mesh:
    """Return what lies above `y = height` (mm), triangles across the plane cut along it; the border
    stays open. Each triangle has vertices of its own.
    """
    y = mesh.corners()[..., 1]
    is_above = y >= height
    whole = np.flatnonzero(is_above.all(axis=1))
    faces, shares = [whole], [np.broadcast_to(np.eye(3), (len(whole), 3, 3))]
    for tip_above in (True, False):  # the tip of a triangle is kept, or the two triangles below it
        chosen = np.flatnonzero(is_above.sum(axis=1) == (1 if tip_above else 2))
        turn = ((is_above[chosen] == tip_above).argmax(axis=1)[:, None] + np.arange(3)) % 3
        tip, one, other = np.moveaxis(np.eye(3)[turn], 1, 0)
        cuts = []
        for end in (one, other):
            above, below = (tip, end) if tip_above else (end, tip)
            high, low = (np.einsum("fc,fc->f", at, y[chosen]) for at in (above, below))
            # By the corner below, so that neighbors cut the edge between them alike.
            share = ((high - height) / (high - low))[:, None]
            cuts.append((1 - share) * above + share * below)
        first, second = cuts
        halves = [(first, one, other), (first, other, second)]
        for triangle in [(tip, first, second)] if tip_above else halves:
            faces.append(chosen)
            shares.append(np.stack(triangle, axis=1))
    kept, share = np.concatenate(faces), np.concatenate(shares)

    def at_corners(values: Any) -> Any:
        return None if values is None else np.einsum("fkc,fci->fki", share, values[kept])

    at_vertices = [
        at_corners(each[mesh.faces]).reshape(-1, 3) for each in (mesh.vertices, mesh.normals)
    ]
    colors = None if mesh.colors is None else at_corners(mesh.colors[mesh.faces]).reshape(-1, 3)
    numbers = np.arange(3 * len(kept)).reshape(-1, 3)
    parts = None if mesh.parts is None else mesh.parts[kept]
    return Mesh(at_vertices[0], numbers, unit(at_vertices[1]), at_corners(mesh.uvs), colors, parts)
