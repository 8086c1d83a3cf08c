"""Triangle meshes as host arrays in mm: edges, hard edges, and cuts by a plane."""

from typing import Any

import equinox as eqx
import numpy as np
import scipy  # submodules load on first use, which takes a third of a second
from jaxtyping import Bool, Float, Int


class Mesh(eqx.Module):
    r"""Triangles with normals and texture coordinates, as NumPy arrays in mm, right-handed.

    Texture coordinates belong to the corners of triangles, not to vertices, so that a mesh is
    closed across the seams of its texture.

    **Attributes:**

    - `vertices`: mm.
    - `faces`: vertices of each triangle, counterclockwise as seen from outside.
    - `normals`: outward unit vectors, one per vertex.
    - `uvs`: texture coordinates per face and corner, with u to the right and v *up*: (0, 0) is the
      lower left corner of a texture, and (0, 1) the upper left, where row 0 begins. May be `None`.
    - `colors`: colors of the vertices, linear, in [0, 1]. May be `None`.
    - `parts`: number of each face's part, if parts have textures of their own.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"]
    uvs: Float[np.ndarray, "faces 3 2"] | None = None
    colors: Float[np.ndarray, "vertices 3"] | None = None
    parts: Int[np.ndarray, " faces"] | None = None

    def corners(self) -> Float[np.ndarray, "faces 3 3"]:
        """Return the positions of the corners of each triangle, mm."""
        return self.vertices[self.faces]

    def face_areas(self) -> Float[np.ndarray, " faces"]:
        """Compute the area of each triangle, mm^2."""
        a, b, c = np.moveaxis(self.corners(), 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)

    def area(self) -> float:
        """Compute the area of the surface, mm^2."""
        return float(self.face_areas().sum())

    def select(self, keep) -> "Mesh":
        """Return the mesh of chosen faces (a mask or indices), with all vertices."""
        uvs, parts = (None if rows is None else rows[keep] for rows in (self.uvs, self.parts))
        return Mesh(self.vertices, self.faces[keep], self.normals, uvs, self.colors, parts)


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Compute unit vertex normals as area-weighted means of the normals of adjacent faces; +y for a
    vertex without faces.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    face_normals = np.cross(b - a, c - a)
    sums = [np.bincount(faces.ravel(), np.repeat(x, 3), len(vertices)) for x in face_normals.T]
    return unit(np.stack(sums, axis=-1))


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Normalize vectors; a vector of length zero becomes +y."""
    x, y, z = np.moveaxis(vectors, -1, 0)  # sums over an axis of three are slow
    length = np.sqrt(x * x + y * y + z * z)[..., None]
    up = np.asarray([0.0, 1.0, 0.0], vectors.dtype)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), up)


# Cosine between the normals of two triangles at a place below which their edge is hard.
_SOFT = np.cos(np.radians(10))


def shared_edges(places: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "n 2 2"]:
    """Pair the edges of triangles that join the same two places. At an edge of more than two
    triangles, each triangle is paired with the next.

    **Returns:** the corners of the two triangles at each end of an edge, as `3 * face + k`.
    """
    starts, ends = places[:, [1, 2, 0]].ravel(), places[:, [2, 0, 1]].ravel()
    key = np.minimum(starts, ends) * np.int64(places.max(initial=0) + 1) + np.maximum(starts, ends)
    order = np.argsort(key, kind="stable")
    paired = key[order][1:] == key[order][:-1]
    edges = np.stack([order[:-1][paired], order[1:][paired]], axis=1)
    first, second = (edges - edges % 3 + (edges % 3 + step) % 3 for step in (1, 2))
    turned = places.ravel()[first[:, 0]] != places.ravel()[first[:, 1]]
    first[turned, 1], second[turned, 1] = second[turned, 1], first[turned, 1]
    return np.stack([first, second], axis=1)


def hard_edges(
    mesh: Mesh, places: Int[np.ndarray, "faces 3"]
) -> tuple[Int[np.ndarray, "n 2 2"], Bool[np.ndarray, " n"]]:
    """Find shared edges, and mark the hard ones, where the normals of the two triangles differ."""
    corners = shared_edges(places)
    normals = mesh.normals[mesh.faces].reshape(-1, 3)[corners]
    cosines = np.einsum("nei,nei->ne", normals[:, :, 0], normals[:, :, 1])
    return corners, cosines.min(axis=1) < _SOFT


def faces_beyond(mesh: Mesh) -> Int[np.ndarray, "faces 3"]:
    """Find, for each corner of each triangle, the triangle across the opposite edge; -1 at a border
    or a hard edge.

    Vertices at the same place count as one, because files duplicate vertices along texture seams.
    """
    corners, are_hard = hard_edges(mesh, distinct(mesh.vertices)[1][mesh.faces])
    faces = corners[~are_hard, 0] // 3
    opposite = 3 - (corners[~are_hard] % 3).sum(axis=1)
    beyond = np.full(mesh.faces.shape, -1)
    beyond[faces, opposite] = faces[:, ::-1]
    return beyond


def split_creases(mesh: Mesh, degrees: float) -> Mesh:
    """Estimate missing normals of a mesh and replace inconsistent ones, so that edges between
    triangles that differ by more than an angle are hard.

    Around each vertex, triangles that soft edges connect share a normal, the mean of their normals
    weighted by their angles at the vertex. A vertex keeps its normal if it is within the given
    angle of the normals of all its triangles.

    **Arguments:**

    - `mesh`: normals of length zero are estimated.
    - `degrees`: the angle, from 0 to 180.

    **Returns:** the mesh without triangles of zero area, with one vertex per place and normal.

    **Source:** Thürmer and Wüthrich 1998, "Computing Vertex Normals from Polygonal Facets" (weights
    by angle).
    """
    cosine = np.cos(np.radians(degrees))
    mesh = mesh.select(mesh.face_areas() > 0)
    sides = unit(np.roll(mesh.corners(), -1, axis=1) - mesh.corners())
    facing = unit(np.cross(sides[:, 0], sides[:, 1]))
    replaced = (mesh.normals == 0).all(axis=1)
    off = np.einsum("fi,fki->fk", facing, mesh.normals[mesh.faces]) < cosine
    replaced[mesh.faces[off]] = True
    if not replaced[mesh.faces].any():
        return mesh
    left, right = np.moveaxis(shared_edges(distinct(mesh.vertices)[1][mesh.faces]), 2, 0)
    soft = np.einsum("ni,ni->n", facing[left[:, 0] // 3], facing[right[:, 0] // 3]) >= cosine
    links = scipy.sparse.coo_array(
        (np.ones(2 * soft.sum()), (left[soft].ravel(), right[soft].ravel())),
        shape=(mesh.faces.size,) * 2,
    )
    groups = scipy.sparse.csgraph.connected_components(links, directed=False)[1]
    angles = np.arccos(np.clip(-np.einsum("fki,fki->fk", sides, np.roll(sides, 1, axis=1)), -1, 1))
    shares = (angles[..., None] * facing[:, None]).reshape(-1, 3)
    estimated = unit(np.stack([np.bincount(groups, share) for share in shares.T], axis=1))
    # Make a new vertex for each pair of an old vertex and a group, and for each unchanged vertex.
    vertex = mesh.faces.ravel()
    group = np.where(replaced[vertex], groups, -1)
    key = vertex * np.int64(len(estimated) + 1) + group
    _, first, faces = np.unique(key, return_index=True, return_inverse=True)
    kept, group = vertex[first], group[first]
    return Mesh(
        mesh.vertices[kept],
        faces.reshape(-1, 3),
        np.where(group[:, None] < 0, mesh.normals[kept], estimated[group]),
        mesh.uvs,
        None if mesh.colors is None else mesh.colors[kept],
        mesh.parts,
    )


def cut_below(mesh: Mesh, height: float) -> Mesh:
    """Cut a mesh at `y = height` (mm), and return the part above, with an open border. Its
    triangles do not share vertices.
    """
    y = mesh.corners()[..., 1] - height
    is_above = y >= 0
    count = is_above.sum(axis=1)
    whole, split = np.flatnonzero(count == 3), np.flatnonzero((count == 1) | (count == 2))
    # The tip is the corner that is alone on its side of the plane.
    tip_above = count[split] == 1
    is_tip = is_above[split] == tip_above[:, None]
    turn = (is_tip.argmax(axis=1)[:, None] + np.arange(3)) % 3
    tip, left, right = np.moveaxis(np.eye(3)[turn], 1, 0)
    # The formula is symmetric in the ends of an edge, so neighbors cut it at the same point.
    off_tip, *off_ends = np.abs(np.take_along_axis(y[split], turn, axis=1)).T[..., None]
    first, second = (
        (off_end * tip + off_tip * end) / (off_end + off_tip)
        for end, off_end in zip((left, right), off_ends, strict=True)
    )
    # The remaining part of a split triangle: its tip, or the two triangles on the other side.
    pieces = [
        (tip_above, (tip, first, second)),
        (~tip_above, (first, left, right)),
        (~tip_above, (first, right, second)),
    ]
    cut = mesh.select(np.concatenate([whole, *(split[stays] for stays, _ in pieces)]))
    shares = [np.stack(corners, axis=1)[stays] for stays, corners in pieces]
    share = np.concatenate([np.broadcast_to(np.eye(3), (len(whole), 3, 3)), *shares])

    def at_corners(values: Any) -> Any:
        return None if values is None else np.einsum("fkc,fci->fki", share, values)

    vertices, normals = (
        at_corners(rows[cut.faces]).reshape(-1, 3) for rows in (mesh.vertices, mesh.normals)
    )
    colors = None if mesh.colors is None else at_corners(mesh.colors[cut.faces]).reshape(-1, 3)
    numbers = np.arange(cut.faces.size).reshape(-1, 3)
    return Mesh(vertices, numbers, unit(normals), at_corners(cut.uvs), colors, cut.parts)


_BITS = 21


def _spread(x: np.ndarray) -> np.ndarray:
    """Insert two zero bits between the bits of 21-bit integers."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x = (x | (x << np.uint64(shift))) & np.uint64(mask)
    return x


def morton_order(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Compute the order of points along the Morton curve of their bounding cube, with 2^21 cells a
    side. Ties keep their order.
    """
    points = points.astype(np.float64)
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    size = (high - low).max() or 1.0
    cells = np.minimum((points - low) * (2**_BITS / size), 2**_BITS - 1).astype(np.uint64)
    code = sum(_spread(axis) << np.uint64(bit) for bit, axis in enumerate(cells.T))
    return np.argsort(code, kind="stable")


def distinct(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " n"]]:
    """Return the index of the first point at each place, in order, and the number of each point's
    place.
    """
    _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[place.ravel()]
