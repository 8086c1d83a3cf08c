"""The zero level of a signed distance as a closed triangle mesh."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Int

from ._mesh import Mesh, unit

Distance = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
_CHUNK = 1 << 14
_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
_EDGES = [
    (a, b) for a in range(8) for b in range(8) if (_CORNERS[b] - _CORNERS[a]).sum() == 1 and (_CORNERS[b] >= _CORNERS[a]).all()
]


def in_chunks(distance: Distance, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Evaluate a distance in pieces that stay in cache, on as many threads as there are cores; single precision."""
    points = points.astype(np.float32)
    pieces = [points[start : start + _CHUNK] for start in range(0, len(points), _CHUNK)]
    with ThreadPoolExecutor() as pool:
        return np.concatenate([np.zeros(0, np.float32), *pool.map(distance, pieces)])


def surface_nets(distance: Distance, low, high, spacing: float, *, slack: float = 4.0) -> Mesh:
    r"""Mesh the zero level of a distance: one vertex per grid cell that it crosses, one quadrilateral per grid edge.

    Cells are sought from coarse to fine, so that only those near the surface are looked at; the vertices are then drawn onto
    the surface by Newton's method, and their normals are its gradient.

    **Arguments:**

    - `distance`: negative inside; off by at most `slack` and a factor 1.5 from the true distance.
    - `low`, `high`: corners of a box that holds the surface, mm.
    - `spacing`: of the finest grid, mm.

    **Returns:** a closed mesh without texture coordinates, its triangles counterclockwise seen from outside.

    **Source:** Gibson 1998, "Constrained Elastic Surface Nets".
    """
    low = np.asarray(low, np.float64)
    shape = np.ceil((np.asarray(high, np.float64) - low) / spacing).astype(np.int64)
    cells = _cells_near(distance, low, shape, spacing, slack)
    stride = np.asarray([(shape[1] + 32) * (shape[2] + 32), shape[2] + 32, 1])
    corners = cells[:, None] + _CORNERS
    keys, where = np.unique(corners @ stride, return_inverse=True)
    where = where.reshape(-1, 8)
    at = np.stack([keys // stride[0], keys % stride[0] // stride[1], keys % stride[1]], axis=-1)
    values = in_chunks(distance, low + spacing * at)
    values[values == 0] = 1e-6
    inside = values < 0
    crossed = inside[where].any(axis=1) & ~inside[where].all(axis=1)
    cells, where = cells[crossed], where[crossed]
    vertices = low + spacing * (cells + _crossings(values[where]))
    faces = _faces(cells, cells @ stride, stride, inside[where], vertices)
    normals = np.zeros_like(vertices)
    for _ in range(3):
        normals, level = _gradient(distance, vertices)
        vertices = vertices - np.clip(level, -0.3 * spacing, 0.3 * spacing)[:, None] * normals
    return Mesh(vertices, faces, unit(_gradient(distance, vertices)[0]))


def _cells_near(distance: Distance, low, shape, spacing: float, slack: float) -> Int[np.ndarray, "n 3"]:
    """Give the cells of the finest grid whose corners may lie on both sides."""
    factor = 8
    blocks = -(-shape // factor)
    cells: np.ndarray = np.argwhere(np.ones(blocks, bool))
    while True:
        size = factor * spacing
        level = in_chunks(distance, low + size * (cells + 0.5))
        cells = cells[np.abs(level) < 1.5 * 0.87 * size + slack * min(1.0, 0.25 * factor)]
        if factor == 1:
            return cells
        factor //= 2
        cells = (2 * cells[:, None] + _CORNERS).reshape(-1, 3)


def _crossings(values: Float[np.ndarray, "n 8"]) -> Float[np.ndarray, "n 3"]:
    """Give the mean of the points where the edges of each cell cross zero, in cells."""
    total, number = np.zeros((len(values), 3)), np.zeros(len(values))
    for a, b in _EDGES:
        crossing = (values[:, a] < 0) != (values[:, b] < 0)
        share = np.where(crossing, values[:, a] / np.where(crossing, values[:, a] - values[:, b], 1.0), 0.0)
        total += np.where(crossing[:, None], _CORNERS[a] + share[:, None] * (_CORNERS[b] - _CORNERS[a]), 0.0)
        number += crossing
    return total / number[:, None]


def _faces(cells, keys, stride, inside, vertices) -> Int[np.ndarray, "f 3"]:
    """Make two triangles of the four cells around each grid edge that the surface crosses, split along the shorter diagonal."""
    order = np.argsort(keys)
    ordered = keys[order]
    triangles = []
    for axis in range(3):
        second, third = np.eye(3, dtype=np.int64)[[(axis + 1) % 3, (axis + 2) % 3]]
        end = int(4 >> axis)  # the corner one step along the axis from corner 0
        start_inside, end_inside = inside[:, 0], inside[:, end]
        chosen = np.flatnonzero(start_inside != end_inside)
        around = [keys[chosen] - offset @ stride for offset in (0 * second, second, second + third, third)]
        found = [np.minimum(np.searchsorted(ordered, key), len(ordered) - 1) for key in around]
        if not all((ordered[place] == key).all() for place, key in zip(found, around, strict=True)):
            raise ValueError("the surface leaves the box, or its distance is too far from true; widen the box or the slack")
        quad = np.stack([order[place] for place in found], axis=-1)
        quad = np.where(start_inside[chosen, None], quad, quad[:, ::-1])
        a, b, c, d = (vertices[quad[:, corner]] for corner in range(4))
        first = ((a - c) ** 2).sum(axis=1) <= ((b - d) ** 2).sum(axis=1)
        split = np.where(first[:, None], quad[:, [0, 1, 2, 0, 2, 3]], quad[:, [0, 1, 3, 1, 2, 3]])
        triangles.append(split.reshape(-1, 3))
    return np.concatenate(triangles)


def _gradient(distance: Distance, points: Float[np.ndarray, "n 3"], step: float = 0.2):
    """Give the unit gradient and the distance over its length, by central differences over the corners of a tetrahedron."""
    corners = np.asarray([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * step
    levels = in_chunks(distance, (points[:, None] + corners).reshape(-1, 3)).reshape(-1, 4)
    slope = levels @ corners / (4 * step * step)
    length = np.maximum(np.linalg.norm(slope, axis=1), 1e-3)
    return slope / length[:, None], levels.mean(axis=1) / length
