"""Hard edges: which triangles meet in one, and normals that end there."""

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Bool, Int

from ._mesh import Mesh, unit
from ._places import distinct

_SOFT = np.cos(np.radians(10))
"""Normals of two triangles at one place that differ by more make their edge hard."""


def shared_edges(places: Int[np.ndarray, "faces 3"]) -> Int[np.ndarray, "n 2 2"]:
    """Pair the edges of triangles, given by the places of their corners, that join the same two
    places. Of an edge of more than two triangles each is paired with the next.

    **Returns:** for each end of an edge the corner of either triangle, as `3 * face + k`.
    """
    starts, ends = places[:, [1, 2, 0]].ravel(), places[:, [2, 0, 1]].ravel()
    key = np.minimum(starts, ends) * np.int64(places.max(initial=0) + 1) + np.maximum(starts, ends)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    edges = np.stack([order[:-1][same], order[1:][same]], axis=1)
    first, second = (edges - edges % 3 + (edges % 3 + step) % 3 for step in (1, 2))
    turned = places.ravel()[first[:, 0]] != places.ravel()[first[:, 1]]
    first[turned, 1], second[turned, 1] = second[turned, 1], first[turned, 1]
    return np.stack([first, second], axis=1)


def hard_edges(
    mesh: Mesh, places: Int[np.ndarray, "faces 3"]
) -> tuple[Int[np.ndarray, "n 2 2"], Bool[np.ndarray, " n"]]:
    """Find shared edges, and which are hard: those where the normals of two triangles differ."""
    corners = shared_edges(places)
    normals = mesh.normals[mesh.faces].reshape(-1, 3)[corners]
    cosines = np.einsum("nei,nei->ne", normals[:, :, 0], normals[:, :, 1])
    return corners, cosines.min(axis=1) < _SOFT


def faces_beyond(mesh: Mesh) -> Int[np.ndarray, "faces 3"]:
    """Find, per triangle and corner, the triangle beyond the edge opposite to the corner; -1 where
    the surface ends there, or the edge is hard.

    Texture coordinates cut meshes open along their seams, so vertices at one place count as one.
    """
    corners, are_hard = hard_edges(mesh, distinct(mesh.vertices)[1][mesh.faces])
    faces = corners[~are_hard, 0] // 3
    opposite = 3 - (corners[~are_hard] % 3).sum(axis=1)
    beyond = np.full(mesh.faces.shape, -1)
    beyond[faces, opposite] = faces[:, ::-1]
    return beyond


def split_creases(mesh: Mesh, degrees: float) -> Mesh:
    """Estimate normals that a mesh lacks, and replace those that are off, so that edges are hard
    where triangles differ by more than an angle.

    Around each vertex, triangles that are joined by soft edges share a normal, the mean of theirs
    by their angles there. A vertex keeps its normal where that lies within the given angle of all
    its triangles.

    **Arguments:**

    - `mesh`: normals of length zero are estimated.
    - `degrees`: the angle, from 0 to 180.

    **Returns:** the mesh without triangles that have no area, with as many vertices at a place as
    there are normals.

    **Source:** Thürmer and Wüthrich 1998, "Computing Vertex Normals from Polygonal Facets", for the
    mean by angles.
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
    corners = shared_edges(distinct(mesh.vertices)[1][mesh.faces])
    one, other = np.moveaxis(corners, 2, 0)
    soft = np.einsum("ni,ni->n", facing[one[:, 0] // 3], facing[other[:, 0] // 3]) >= cosine
    links = scipy.sparse.coo_array(
        (np.ones(2 * soft.sum()), (one[soft].ravel(), other[soft].ravel())),
        shape=(mesh.faces.size,) * 2,
    )
    groups = scipy.sparse.csgraph.connected_components(links, directed=False)[1]
    angles = np.arccos(np.clip(-np.einsum("fki,fki->fk", sides, np.roll(sides, 1, axis=1)), -1, 1))
    shares = (angles[..., None] * facing[:, None]).reshape(-1, 3)
    sums = [np.bincount(groups, share) for share in shares.T]
    estimated = unit(np.stack(sums, axis=1))
    # A new vertex for each pair of an old one and a group, or of an old one alone where it stays.
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
