"""Evenly spread points on a triangle mesh, on flat triangles or a curved surface, and their Voronoi
cells in the tangent planes.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import scipy  # submodules load on first use, which takes a third of a second
from jaxtyping import Float, Int

from splatjax._records import require

from ._mesh import Mesh, distinct, faces_beyond, hard_edges, morton_order, unit

_CHUNK = 1 << 11  # small enough to stay in cache
_OPEN_END = 0.75


def tangent_frames(
    normals: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Compute two unit vectors that form a right-handed frame with each normal.

    **Source:** Duff et al. 2017, "Building an Orthonormal Basis, Revisited".
    """
    x, y, z = normals.T
    sign = np.where(z < 0, -1.0, 1.0).astype(normals.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return (
        np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=-1),
        np.stack([b, sign + y * y * a, -y], axis=-1),
    )


def surface_cells(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    images: Float[np.ndarray, "n images 3"] | None = None,
    *,
    neighbors: int = 16,
    directions: int = 32,
    limit: float | None = None,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    r"""Measure the Voronoi cell of each point in its tangent plane.

    In the direction `u` the border of a cell is at `r(u) = min_j |d_j|^2 / (2 d_j . u)` over the
    neighbors at `d_j`. The area is `1/2` the integral of `r^2` over all directions; the centroid is
    `1/3` the integral of `r^3 u`, divided by the area. Neighbors that face away (the other side of
    a thin sheet) do not count. At the border of the surface, a cell ends at `limit`. Coincident
    points share a cell.

    **Arguments:**

    - `points`: mm; Morton order is fastest.
    - `normals`: unit vectors.
    - `images`: vectors from each point to its mirror images at the borders of the surface; zero for
      none.
    - `neighbors`: number of nearest points to consider.
    - `limit`: mm; `None` for 0.75 of the mean distance to the six nearest points.
    - `directions`: number of directions of the quadrature; with 32, areas are accurate to about 1%.

    **Returns:** for each cell, its area (mm^2), the distance to its farthest corner (mm), and the
    vector to its centroid (mm). On an evenly sampled closed surface, the areas sum to the area of
    the surface within about 1%.
    """
    count = len(points)
    if count == 1:
        return np.ones(1), np.ones(1), np.zeros((1, 3))
    single = normals.astype(np.float32)
    images = np.zeros((count, 0, 3), np.float32) if images is None else images
    neighbors = min(neighbors, count - 1)
    tree = scipy.spatial.KDTree(points, balanced_tree=False, compact_nodes=False)
    distances, near = tree.query(points, k=neighbors + 1, workers=-1)
    step = 2 * np.pi / directions
    angles = (np.arange(directions) + 0.5) * step
    fan = np.stack([np.cos(angles), np.sin(angles)]).astype(np.float32)

    def measure(start: int) -> tuple[np.ndarray, ...]:
        part = slice(start, min(start + _CHUNK, count))
        indices, facing, mirrored = near[part, 1:], single[part], images[part]
        gaps = np.linalg.norm(mirrored, axis=-1)
        offsets = np.concatenate([points[indices] - points[part, None], mirrored], axis=1)
        lengths = np.concatenate([distances[part, 1:], np.where(gaps > 0, gaps, np.inf)], axis=1)
        squared = np.square(lengths).astype(np.float32)
        coincident = squared == 0
        site_normals = [single[indices], np.broadcast_to(facing[:, None], mirrored.shape)]
        same_side = np.einsum("nki,ni->nk", np.concatenate(site_normals, 1), facing) > 0.1
        squared = np.where(same_side & ~coincident, squared, np.inf)
        axes = np.stack(tangent_frames(facing))
        across = np.einsum("nki,ani->nka", offsets.astype(np.float32), axes)
        # The inverse distance to the border of the cell; negative behind the point.
        inverse = (across @ fan) * (2 / squared)[..., None]
        nearest = distances[part, 1:7]
        around = nearest.sum(axis=1) / np.maximum((nearest > 0).sum(axis=1), 1)
        end = _OPEN_END * around if limit is None else np.full(len(facing), limit)
        border = 1 / np.maximum(inverse.max(axis=1), 1 / np.maximum(end, 1e-12)[:, None])
        area = 0.5 * step * np.einsum("nd,nd->n", border, border)
        moment = (step / 3) * (border**3 @ fan.T) / np.maximum(area, 1e-30)[:, None]
        to_centroid = np.einsum("na,ani->ni", moment, axes)
        return area / (1 + coincident.sum(axis=1)), border.max(axis=1), to_centroid

    with ThreadPoolExecutor() as pool:
        measured = zip(*pool.map(measure, range(0, count, _CHUNK)), strict=True)
        areas, reaches, to_centroids = map(np.concatenate, measured)
        return areas, reaches, to_centroids


_PLASTIC = 1.32471795724474602596  # of the R2 sequence
_EDGE_TOLERANCE = 1e-9
_WALK = 64
# Length of the pieces of a border, in spacings; number of pieces considered near a point.
_PIECE, _IMAGES = 0.25, 8


class SurfacePoints(NamedTuple):
    """Points on a mesh, given by faces and barycentric coordinates (non-negative, with sum 1)."""

    faces: Int[np.ndarray, " n"]
    barycentrics: Float[np.ndarray, "n 3"]

    def positions(self, mesh: Mesh) -> Float[np.ndarray, "n 3"]:
        """Compute the points, mm."""
        return np.einsum("nc,nci->ni", self.barycentrics, mesh.vertices[mesh.faces[self.faces]])

    def normals(self, mesh: Mesh) -> Float[np.ndarray, "n 3"]:
        """Compute unit normals by interpolating those of the vertices."""
        return unit(
            np.einsum("nc,nci->ni", self.barycentrics, mesh.normals[mesh.faces[self.faces]])
        )

    def take(self, order: Int[np.ndarray, " m"]) -> "SurfacePoints":
        """Return the points at given indices."""
        return SurfacePoints(self.faces[order], self.barycentrics[order])


def scatter(mesh: Mesh, count: int, *, seed: int = 0, relaxations: int = 4) -> SurfacePoints:
    r"""Spread points over a mesh with uniform density and blue noise.

    Points are distributed evenly along a Morton curve of the triangles, and by a low-discrepancy
    sequence inside each triangle. Then they are moved `relaxations` times along the surface to the
    centroids of their Voronoi cells (Lloyd).

    **Arguments:**

    - `mesh`: with positive area.
    - `count`: number of points, at least 1.
    - `seed`: seed of the random positions; the same seed gives the same points.

    **Returns:** the points, in Morton order.

    **Raises:** `ValueError` if `count` is below 1 or the mesh has no area.
    """
    require(
        isinstance(count, int | float | np.number) and count >= 1,
        f"count is {count!r}; at least one splat is needed",
    )
    areas = mesh.face_areas()
    require(
        areas.sum() > 0,
        "the mesh has no area; it needs at least one triangle that is not degenerate",
    )
    random = np.random.default_rng(seed)
    along = morton_order(mesh.corners().mean(axis=1))
    ends = np.cumsum(areas[along])
    places = (np.arange(count) + random.uniform()) * (ends[-1] / count)
    faces = along[np.minimum(np.searchsorted(ends, places, side="right"), len(ends) - 1)]
    u, v = ((random.uniform() + np.arange(1, count + 1) / _PLASTIC**k) % 1.0 for k in (1, 2))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    points = SurfacePoints(faces, np.stack([1 - u - v, u, v], axis=-1))
    points = points.take(morton_order(points.positions(mesh)))
    beyond, spacing = faces_beyond(mesh), float(np.sqrt(areas.sum() / count))
    for _ in range(relaxations):
        positions, normals = points.positions(mesh), points.normals(mesh)
        *_, to_centroids = surface_cells(
            positions,
            normals,
            mirror_images(mesh, beyond, positions, spacing),
            neighbors=10,
            directions=12,
            limit=spacing,
        )
        points = _settle(mesh, beyond, points.faces, positions + 1.3 * to_centroids)
    return points.take(
        morton_order(points.positions(mesh).astype(np.float32))
    )  # the order in single precision


def mirror_images(
    mesh: Mesh,
    beyond: Int[np.ndarray, "faces 3"],
    points: Float[np.ndarray, "n 3"],
    spacing: float,
) -> Float[np.ndarray, "n images 3"]:
    """Mirror each point at the borders of the mesh that are within about one spacing.

    **Returns:** the vector to each image, or zero if there is none.
    """
    faces, corners = np.nonzero(beyond < 0)
    if not len(faces):
        return np.zeros((len(points), 0, 3), np.float32)
    starts, ends = (mesh.vertices[mesh.faces[faces, (corners + step) % 3]] for step in (1, 2))
    squared = ((ends - starts) ** 2).sum(axis=1)
    pieces = np.maximum(np.ceil(np.sqrt(squared) / (_PIECE * spacing)).astype(np.int64), 1)
    edge = np.repeat(np.arange(len(faces)), pieces)
    index = np.arange(len(edge)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    marks = starts[edge] + ((index + 0.5) / pieces[edge])[:, None] * (ends - starts)[edge]
    distances, mark = scipy.spatial.KDTree(marks).query(
        points, k=_IMAGES, distance_upper_bound=1.5 * spacing, workers=-1
    )
    near = np.flatnonzero(np.isfinite(distances[:, 0]))
    edge = np.append(edge, 0)[mark[near]]
    start, along = starts[edge], (ends - starts)[edge]
    share = np.einsum("nki,nki->nk", points[near, None] - start, along) / squared[edge]
    offsets = start + np.clip(share, 0, 1)[..., None] * along - points[near, None]
    images = np.zeros((len(points), _IMAGES, 3), np.float32)
    images[near] = np.where(np.isfinite(distances[near])[..., None], 2 * offsets, 0.0)
    return images


def _barycentrics(mesh: Mesh, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Compute barycentric coordinates of points projected onto the planes of their faces."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[faces]], 1, 0)
    vectors = np.stack([b - a, c - a, points - a])
    (d00, d01, d20), (_, d11, d21), _ = np.einsum("ani,bni->abn", vectors, vectors)
    determinant = np.maximum(d00 * d11 - d01 * d01, 1e-30)
    v = (d11 * d20 - d01 * d21) / determinant
    w = (d00 * d21 - d01 * d20) / determinant
    return np.stack([1 - v - w, v, w], axis=-1)


def _settle(mesh: Mesh, beyond: np.ndarray, faces: np.ndarray, points: np.ndarray) -> SurfacePoints:
    """Move points that left their faces back onto the mesh, by walking across edges."""
    faces = faces.copy()
    barycentrics = _barycentrics(mesh, faces, points)
    outside = np.flatnonzero(barycentrics.min(axis=1) < -_EDGE_TOLERANCE)
    for _ in range(_WALK):
        if not len(outside):
            break
        across = beyond[faces[outside], barycentrics[outside].argmin(axis=1)]
        outside, across = outside[across >= 0], across[across >= 0]
        faces[outside] = across
        barycentrics[outside] = _barycentrics(mesh, across, points[outside])
        outside = outside[barycentrics[outside].min(axis=1) < -_EDGE_TOLERANCE]
    barycentrics = np.maximum(barycentrics, 0)
    return SurfacePoints(faces, barycentrics / barycentrics.sum(axis=1, keepdims=True))


_MIDDLES = 0.5 * np.asarray([[1.0, 1, 0], [0, 1, 1], [1, 0, 1]])
# The quarters of a triangle, by indices of its corners and then of the midpoints of its edges.
_QUARTERS = np.asarray([[0, 3, 5], [1, 4, 3], [2, 5, 4], [3, 4, 5]])


class Rounding:
    r"""A curved surface that follows the normals of a mesh.

    Flat triangles with smooth normals shadow themselves one by one where the normals still face the
    light, which makes the edge between light and shadow ragged. To second order, the surface
    through the vertices with these normals contains the point

        x + 1/2 sum_i u_i ((v_i - x) . n_i) n_i

    for a point `x` of a triangle with corners `v_i`, normals `n_i` and barycentric coordinates
    `u_i`. This equals a sum over edges, so neighboring triangles meet. Edges stay straight at the
    vertices of hard edges, so a box stays a box.

    **Source:** Boubekeur and Alexa 2008, "Phong tessellation", with the weight 1/2 instead of their
    3/4, which keeps spheres round.
    """

    def __init__(self, mesh: Mesh):
        place = distinct(mesh.vertices)[1]
        corners, are_hard = hard_edges(mesh, place[mesh.faces])
        is_smooth = np.ones(len(mesh.vertices), bool)
        is_smooth[place[mesh.faces].ravel()[corners[are_hard]]] = False
        self._mesh, self._is_smooth = mesh, is_smooth[place]

    def positions(self, points: SurfacePoints) -> Float[np.ndarray, "n 3"]:
        """Move points of the mesh from its triangles to the surface, mm."""
        mesh, faces, moved = self._mesh, points.faces, points.positions(self._mesh)
        for start, end in ((0, 1), (1, 2), (2, 0)):
            v, w = mesh.faces[faces, start], mesh.faces[faces, end]
            edge = mesh.vertices[w] - mesh.vertices[v]
            away = [
                np.einsum("ni,ni->n", edge, mesh.normals[at])[:, None] * mesh.normals[at]
                for at in (v, w)
            ]
            share = 0.5 * points.barycentrics[:, start] * points.barycentrics[:, end]
            share = np.where(self._is_smooth[v] & self._is_smooth[w], share, 0.0)
            moved += share[:, None] * (away[1] - away[0])
        return moved

    def area(self) -> float:
        """Measure the area of the surface, mm^2, by halving edges once and extrapolating."""
        faces = np.arange(len(self._mesh.faces))
        middles = [
            self.positions(SurfacePoints(faces, np.broadcast_to(middle, (len(faces), 3))))
            for middle in _MIDDLES
        ]
        corners = np.concatenate([self._mesh.corners(), np.stack(middles, axis=1)], axis=1)
        a, b, c = np.moveaxis(corners[:, _QUARTERS], 2, 0)
        halved = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum())
        return halved + (halved - self._mesh.area()) / 3
