"""Points where the surface is that a mesh's normals ask for, instead of on its flat triangles."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ._mesh import Mesh
from ._scatter import SurfacePoints

_SHARPEST = np.radians(40)
"""Between the normal of a vertex and that of a triangle: beyond it, an edge is meant."""
_MIDDLES = 0.5 * np.asarray([[1.0, 1, 0], [0, 1, 1], [1, 0, 1]])
_QUARTERS = np.asarray([[0, 3, 5], [1, 4, 3], [2, 5, 4], [3, 4, 5]])
"""Of a triangle with the middles of its edges after its corners."""


def rounded_positions(mesh: Mesh, points: SurfacePoints) -> Float[np.ndarray, "n 3"]:
    r"""Give points of a mesh, mm, moved from its triangles to a surface that bends as its normals
    do.

    Flat triangles under smooth normals shade themselves where the normals still face the light,
    triangle by triangle: a ragged edge between light and shadow. The surface through the vertices
    that has the normals there lies, to second order,

        x + 1/2 sum_i u_i ((v_i - x) . n_i) n_i

    from a point `x` of a triangle, with corners `v_i`, normals `n_i` and barycentric coordinates
    `u_i`. That is a sum over edges, so that neighbors meet. Edges stay straight at vertices whose
    normal is more than 40 degrees off that of one of their triangles: a box stays a box.

    **Source:** Boubekeur and Alexa 2008, "Phong tessellation", with the weight (they prefer 3/4)
    that keeps spheres round.
    """
    return points.positions(mesh) + _bulges(mesh, points.faces, points.barycentrics)


def rounded_area(mesh: Mesh) -> float:
    """Give the area of that surface, mm^2, by halving edges once and extrapolating."""
    every = np.arange(len(mesh.faces))
    middles = [
        rounded_positions(mesh, SurfacePoints(every, np.broadcast_to(middle, (len(every), 3))))
        for middle in _MIDDLES
    ]
    corners = np.concatenate([mesh.corners(), np.stack(middles, axis=1)], axis=1)
    a, b, c = np.moveaxis(corners[:, _QUARTERS], 2, 0)
    halved = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum())
    return halved + (halved - mesh.area()) / 3


def _bulges(
    mesh: Mesh, faces: Int[np.ndarray, " n"], barycentrics: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    smooth, moved = _smooth(mesh), np.zeros((len(faces), 3))
    for one, other in ((0, 1), (1, 2), (2, 0)):
        v, w = mesh.faces[faces, one], mesh.faces[faces, other]
        edge = mesh.vertices[w] - mesh.vertices[v]
        away = [
            np.einsum("ni,ni->n", edge, mesh.normals[at])[:, None] * mesh.normals[at]
            for at in (v, w)
        ]
        share = np.where(
            smooth[v] & smooth[w], 0.5 * barycentrics[:, one] * barycentrics[:, other], 0.0
        )
        moved += share[:, None] * (away[1] - away[0])
    return moved


def _smooth(mesh: Mesh) -> Bool[np.ndarray, " vertices"]:
    """Say of each vertex whether its normal is near those of all its triangles; those without area
    have none.
    """
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    across = np.cross(b - a, c - a)
    size = np.linalg.norm(across, axis=1)
    cosines = (
        np.einsum("fi,fki->fk", across, mesh.normals[mesh.faces])
        / np.where(size > 0, size, 1.0)[:, None]
    )
    least = np.ones(len(mesh.vertices))
    np.minimum.at(least, mesh.faces, np.where(size[:, None] > 0, cosines, 1.0))
    return least > np.cos(_SHARPEST)
