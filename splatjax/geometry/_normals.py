"""Normals of raw points."""

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Float

from ._distinct import distinct
from ._morton import morton_order
from ._orientation import outward_signs

_CHUNK = 1 << 16
_BEYOND = 1.05  # of the distance of the farthest neighbour, so that it counts a little


def estimate_normals(points: Float[np.ndarray, "n 3"], *, neighbors: int = 12) -> Float[np.ndarray, "n 3"]:
    r"""Give unit normals of points on a surface, all on its outer side.

    The normal is the direction in which the nearest points vary least (principal components, of which near ones count more, so
    that neither an edge nor a second sheet close by turns it). What can be seen from outside faces whoever sees it; the rest
    follows its neighbours, and a surface open to both sides faces away from its middle at the farthest point.

    **Arguments:**

    - `points`: mm, at least 4 at different places. Those at one place have one normal.
    - `neighbors`: how many nearest points make a plane.

    **Source:** Hoppe et al. 1992, "Surface Reconstruction from Unorganized Points", sections 3.2 and 3.3; weights of
    Pauly et al. 2003, "Shape Modeling with Point-Sampled Geometry".
    """
    first, inverse = distinct(points)
    along = morton_order(points[first].astype(np.float32))
    places = points[first[along]]
    neighbors = min(neighbors, len(places) - 1)
    distances, near = scipy.spatial.KDTree(places).query(places, k=neighbors + 1, workers=-1)
    normals = np.empty(places.shape)
    for start in range(0, len(places), _CHUNK):
        part = slice(start, start + _CHUNK)
        around, reach = places[near[part]], distances[part, -1:]
        shares = (1 - (distances[part] / np.where(reach > 0, _BEYOND * reach, 1)) ** 2)[..., None] ** 2
        around = around - (shares * around).sum(axis=1, keepdims=True) / shares.sum(axis=1, keepdims=True)
        normals[part] = np.linalg.eigh((shares * around).swapaxes(1, 2) @ around)[1][..., 0]
    normals *= outward_signs(places, normals, near[:, 1:], distances[:, -1])[:, None]
    return normals[np.argsort(along)][inverse]
