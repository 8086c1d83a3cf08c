"""Points where the surface is that a mesh's normals ask for, instead of on its flat triangles."""

import numpy as np
from jaxtyping import Float

from ._creases import hard_edges
from ._mesh import Mesh
from ._places import distinct
from ._scatter import SurfacePoints

_MIDDLES = 0.5 * np.asarray([[1.0, 1, 0], [0, 1, 1], [1, 0, 1]])
_QUARTERS = np.asarray([[0, 3, 5], [1, 4, 3], [2, 5, 4], [3, 4, 5]])
"""Of a triangle with the middles of its edges after its corners."""


class Rounding:
    r"""The surface that bends as the normals of a mesh do, instead of its flat triangles.

    Flat triangles under smooth normals shade themselves where the normals still face the light,
    triangle by triangle: a ragged edge between light and shadow. The surface through the vertices
    that has the normals there lies, to second order,

        x + 1/2 sum_i u_i ((v_i - x) . n_i) n_i

    from a point `x` of a triangle, with corners `v_i`, normals `n_i` and barycentric coordinates
    `u_i`. That is a sum over edges, so that neighbors meet. Edges stay straight at the vertices of
    hard edges: a box stays a box.

    **Source:** Boubekeur and Alexa 2008, "Phong tessellation", with the weight (they prefer 3/4)
    that keeps spheres round.
    """

    def __init__(self, mesh: Mesh):
        place = distinct(mesh.vertices)[1]
        corners, are_hard = hard_edges(mesh, place[mesh.faces])
        is_smooth = np.ones(len(mesh.vertices), bool)
        is_smooth[place[mesh.faces].ravel()[corners[are_hard]]] = False
        self._mesh, self._is_smooth = mesh, is_smooth[place]

    def positions(self, points: SurfacePoints) -> Float[np.ndarray, "n 3"]:
        """Return points of the mesh moved from its triangles to the surface, mm."""
        mesh, faces, moved = self._mesh, points.faces, points.positions(self._mesh)
        for one, other in ((0, 1), (1, 2), (2, 0)):
            v, w = mesh.faces[faces, one], mesh.faces[faces, other]
            edge = mesh.vertices[w] - mesh.vertices[v]
            away = [
                np.einsum("ni,ni->n", edge, mesh.normals[at])[:, None] * mesh.normals[at]
                for at in (v, w)
            ]
            share = 0.5 * points.barycentrics[:, one] * points.barycentrics[:, other]
            share = np.where(self._is_smooth[v] & self._is_smooth[w], share, 0.0)
            moved += share[:, None] * (away[1] - away[0])
        return moved

    def area(self) -> float:
        """Measure the area of the surface, mm^2, by halving edges once and extrapolating."""
        every = np.arange(len(self._mesh.faces))
        middles = [
            self.positions(SurfacePoints(every, np.broadcast_to(middle, (len(every), 3))))
            for middle in _MIDDLES
        ]
        corners = np.concatenate([self._mesh.corners(), np.stack(middles, axis=1)], axis=1)
        a, b, c = np.moveaxis(corners[:, _QUARTERS], 2, 0)
        halved = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum())
        return halved + (halved - self._mesh.area()) / 3
