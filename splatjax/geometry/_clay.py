"""Modeling by signed distances, negative inside: primitives, smooth operations, and the zero level
of a distance as a closed triangle mesh.

Parts are tables for `model`: a list begins with a part, and the rows after it join another part to
it, carve it away or keep what both have in common, each over a softness.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Float, Int

from ._mesh import Mesh, unit

Point = tuple[np.ndarray, np.ndarray, np.ndarray]
Size = float | int
# A distance; or a primitive, the number of its view and its sizes; or a list of a part and rows of
# an operation, its softness and another part.
Part = np.ndarray | tuple[Any, ...] | list[Any]


def model(part: Part, views: Sequence[Point]) -> np.ndarray:
    """Evaluate the distance to a part at points, given in several coordinates (views)."""
    if isinstance(part, np.ndarray):
        return part
    if isinstance(part, tuple):
        primitive, view, *sizes = part
        return primitive(views[view], *sizes)
    body = model(part[0], views)
    for operation, softness, other in part[1:]:
        body = operation(body, model(other, views), softness)
    return body


def ellipsoid(p: Point, center, radii) -> np.ndarray:
    """Compute the distance to an ellipsoid, to first order (exact on it):
    `k (k - 1) / |grad k^2 / 2|`, `k = |p / r|`.
    """
    scaled = [(x - c) / r for x, c, r in zip(p, center, radii, strict=True)]
    k = np.sqrt(sum(s * s for s in scaled))
    slope = np.sqrt(sum((s / r) ** 2 for s, r in zip(scaled, radii, strict=True)))
    return np.where(slope > 1e-6, k * (k - 1) / np.maximum(slope, 1e-6), -min(radii))


def limb(p: Point, start, end, start_radius: Size, end_radius: Size) -> np.ndarray:
    """Compute the distance to a capsule whose radius changes linearly from `start` to `end` (to
    first order).
    """
    axis = [e - s for s, e in zip(start, end, strict=True)]
    length = sum(a * a for a in axis)
    share = sum((x - s) * a for x, s, a in zip(p, start, axis, strict=True)) / length
    share = np.clip(share, 0.0, 1.0)
    squared = sum((x - s - share * a) ** 2 for x, s, a in zip(p, start, axis, strict=True))
    return np.sqrt(squared) - (start_radius + (end_radius - start_radius) * share)


def above(p: Point, height: Size) -> np.ndarray:
    """Compute the distance to everything above a height."""
    return -(p[1] - height)


def join(a: np.ndarray, b: np.ndarray, softness: Size) -> np.ndarray:
    """Unite two bodies; where both are within `softness`, a fillet fills the corner (quadratic
    smooth minimum).
    """
    blend = np.maximum(softness - np.abs(a - b), 0.0)
    return np.minimum(a, b) - blend * blend * (0.25 / softness)


def carve(a: np.ndarray, b: np.ndarray, softness: Size) -> np.ndarray:
    """Subtract the second body from the first; the edge is rounded over `softness`."""
    return -join(-a, b, softness)


def keep(a: np.ndarray, b: np.ndarray, softness: Size) -> np.ndarray:
    """Intersect two bodies; the edge is rounded over `softness`."""
    return -join(-a, -b, softness)


def bump(x: np.ndarray, center: Size | np.ndarray, width: Size | np.ndarray) -> np.ndarray:
    """Compute `exp(-(x - center)^2 / width^2)`, to add or remove material."""
    return np.exp(-(((x - center) / width) ** 2))


Distance = Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
_CHUNK = 1 << 14
_STEP = 0.2  # mm
_TETRAHEDRON = _STEP * np.asarray([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
_CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(-1, 3)
_EDGES = [
    (a, a | bit) for bit in (4, 2, 1) for a in range(8) if not a & bit
]  # corners are numbered 4 x + 2 y + z
_SIDES = [
    (0, 1, 3, 2),
    (4, 5, 7, 6),
    (0, 1, 5, 4),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 3, 7, 5),
]  # around each


def _sheets() -> Int[np.ndarray, "256 12"]:
    """Number, for each set of corners inside, the sheets of the surface that cross the edges of a
    cell; -1 for none.

    Sheets are separated so that no two of them share a vertex: on a side whose inner corners lie
    across from each other, the surface goes around each of them.
    """
    table = np.full((256, 12), -1, np.int64)
    for corners in range(256):
        inside = [corners >> corner & 1 for corner in range(8)]
        crossed = np.asarray([inside[a] != inside[b] for a, b in _EDGES])
        joined = np.eye(12)
        for side in _SIDES:
            turns = zip(side, (*side[1:], side[0]), strict=True)
            around = [_EDGES.index((min(pair), max(pair))) for pair in turns]
            pairs = [[edge for edge in around if crossed[edge]]]
            if len(pairs[0]) == 4:
                pairs = [[around[k - 1], around[k]] for k in range(4) if inside[side[k]]]
            for pair in pairs:
                joined[np.ix_(pair, pair)] = 1
        sheets = scipy.sparse.csgraph.connected_components(joined, directed=False)[1]
        table[corners, crossed] = np.unique(sheets[crossed], return_inverse=True)[1]
    return table


def in_chunks(distance: Distance, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Evaluate a distance in pieces that stay in cache, on as many threads as there are cores;
    single precision.
    """
    points = points.astype(np.float32)
    pieces = [points[start : start + _CHUNK] for start in range(0, len(points), _CHUNK)]
    with ThreadPoolExecutor() as pool:
        return np.concatenate([np.zeros(0, np.float32), *pool.map(distance, pieces)])


def surface_nets(distance: Distance, low, high, spacing: float, *, slack: float = 4.0) -> Mesh:
    r"""Mesh the zero level of a distance: one vertex per grid cell and sheet of it
    that crosses the cell, one quadrilateral per grid edge.

    Cells are searched from coarse to fine, so that only those near the surface are evaluated.
    Newton's method then moves the vertices onto the surface, and their normals are its gradient.

    **Arguments:**

    - `distance`: negative inside; off by at most `slack` and a factor 1.5 from the true distance.
    - `low`, `high`: corners of a box that contains the surface, mm.
    - `spacing`: of the finest grid, mm.

    **Returns:** a closed mesh without texture coordinates, its triangles counterclockwise seen from
    outside.

    **Source:** Gibson 1998, "Constrained Elastic Surface Nets".
    """
    low = np.asarray(low, np.float64)
    shape = np.ceil((np.asarray(high, np.float64) - low) / spacing).astype(np.int64)
    cells = _cells_near(distance, low, shape, spacing, slack)
    stride = np.asarray([(shape[1] + 32) * (shape[2] + 32), shape[2] + 32, 1])
    keys, where = np.unique((cells[:, None] + _CORNERS) @ stride, return_inverse=True)
    where = where.reshape(-1, 8)
    at = np.stack([keys // stride[0], keys % stride[0] // stride[1], keys % stride[1]], axis=-1)
    values = in_chunks(distance, low + spacing * at)
    values[values == 0] = 1e-6
    inside = (values < 0)[where]
    crossed = inside.any(axis=1) & ~inside.all(axis=1)
    cells, where, inside = cells[crossed], where[crossed], inside[crossed]
    sheets = _sheets()[inside @ (1 << np.arange(8))]
    first = np.cumsum(sheets.max(axis=1) + 1) - (sheets.max(axis=1) + 1)
    owner, within = _crossings(values[where], sheets)
    vertices = low + spacing * (cells[owner] + within)
    faces = _faces(cells, cells @ stride, stride, inside, first[:, None] + sheets, vertices)
    normals = np.zeros_like(vertices)
    for _ in range(2):
        # The gradient by central differences over the corners of a tetrahedron.
        levels = in_chunks(distance, (vertices[:, None] + _TETRAHEDRON).reshape(-1, 3))
        levels = levels.reshape(-1, 4)
        slope = levels @ _TETRAHEDRON / (4 * _STEP * _STEP)
        length = np.maximum(np.linalg.norm(slope, axis=1), 1e-3)
        normals, level = slope / length[:, None], levels.mean(axis=1) / length
        vertices = vertices - np.clip(level, -0.3 * spacing, 0.3 * spacing)[:, None] * normals
    return Mesh(vertices, faces, unit(normals))  # those of the second step, which is tiny


def _cells_near(
    distance: Distance, low, shape, spacing: float, slack: float
) -> Int[np.ndarray, "n 3"]:
    """Find the cells of the finest grid whose corners may lie on both sides."""
    factor = 8
    cells: np.ndarray = np.argwhere(np.ones(-(-shape // factor), bool))
    while True:
        size = factor * spacing
        level = in_chunks(distance, low + size * (cells + 0.5))
        cells = cells[np.abs(level) < 1.5 * 0.87 * size + slack * min(1.0, 0.25 * factor)]
        if factor == 1:
            return cells
        factor //= 2
        cells = (2 * cells[:, None] + _CORNERS).reshape(-1, 3)


def _crossings(values: Float[np.ndarray, "n 8"], sheets: Int[np.ndarray, "n 12"]):
    """Return the cell of each vertex, and the mean of the points where its sheet crosses the edges
    of that cell, in cells.
    """
    a, b = np.asarray(_EDGES).T
    crossing = sheets >= 0
    share = np.where(
        crossing, values[:, a] / np.where(crossing, values[:, a] - values[:, b], 1.0), 0.0
    )
    points = _CORNERS[a] + share[..., None] * (_CORNERS[b] - _CORNERS[a])
    owners, sheet = np.nonzero(np.arange(4) <= sheets.max(axis=1, keepdims=True))
    mine = (sheets[owners] == sheet[:, None]).astype(np.float64)
    return owners, np.einsum("ve,vei->vi", mine, points[owners]) / mine.sum(axis=1, keepdims=True)


def _faces(cells, keys, stride, inside, vertex, vertices) -> Int[np.ndarray, "f 3"]:
    """Make two triangles of the four cells around each grid edge that the surface crosses, split
    along the shorter diagonal.
    """
    order, triangles = np.argsort(keys), []
    for axis in range(3):
        bit, second, third = (4 >> (axis + step) % 3 for step in range(3))
        chosen = np.flatnonzero(inside[:, 0] != inside[:, bit])
        around = []
        for corner in (0, second, second | third, third):  # of the cell, where the edge begins
            place = np.searchsorted(keys[order], keys[chosen] - _CORNERS[corner] @ stride)
            around.append(vertex[order[place], _EDGES.index((corner, corner | bit))])
        quad = np.stack(around, axis=-1)
        quad = np.where(inside[chosen, :1], quad, quad[:, ::-1])
        a, b, c, d = (vertices[quad[:, corner]] for corner in range(4))
        is_first = ((a - c) ** 2).sum(axis=1) <= ((b - d) ** 2).sum(axis=1)
        halves = quad[:, [0, 1, 2, 0, 2, 3]], quad[:, [0, 1, 3, 1, 2, 3]]
        triangles.append(np.where(is_first[:, None], *halves).reshape(-1, 3))
    return np.concatenate(triangles)
