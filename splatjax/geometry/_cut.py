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
    faces = [np.flatnonzero(is_above.all(axis=1))]
    shares = [np.broadcast_to(np.eye(3), (len(faces[0]), 3, 3))]
    for number in (1, 2):  # corners above: the tip is kept, or the two triangles below it
        chosen = np.flatnonzero(is_above.sum(axis=1) == number)
        alone = (is_above[chosen] == (number == 1)).argmax(axis=1)
        turn = (alone[:, None] + np.arange(3)) % 3
        tip, *ends = y[chosen[:, None], turn].T
        # Shares of the corners below, so that neighbors cut the edge between them alike.
        pairs = [(tip, end) if number == 1 else (end, tip) for end in ends]
        s, t = ((above - height) / (above - below) for above, below in pairs)
        (a, b), (c, d), zero = ((1 - s, s), (1 - t, t), 0 * s)
        a, b, c, d = (a, b, c, d) if number == 1 else (b, a, d, c)
        first, second = [a, b, zero], [c, zero, d]
        one, other, last = np.eye(3)[:, :, None] + np.zeros(len(chosen))
        kept = [[one, first, second]]
        if number == 2:
            kept = [[first, other, last], [first, last, second]]
        for triangle in kept:
            share = np.moveaxis(np.asarray(triangle), -1, 0)
            faces.append(chosen)
            shares.append(np.take_along_axis(share, turn.argsort(axis=1)[:, None], axis=2))
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
