"""Normals of raw points."""

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Float, Int

from ._orientation import outward_signs
from ._places import distinct, morton_order

_CHUNK = 1 << 16
_BEYOND = 1.05  # of the distance of the farthest neighbor, so that it counts a little
_WINDOW = 8  # nearest points that make a plane
_FLAT = 1e-3  # of a window's squared size: planes that are off by less are as good as each other


def estimate_normals(
    points: Float[np.ndarray, "n 3"], *, neighbors: int = 12
) -> Float[np.ndarray, "n 3"]:
    r"""Estimate unit normals of points on a surface, all on its outer side.

    Around each point there is a plane in which the nearest ones vary least (principal components,
    of which near ones count more). A point's normal is the mean of those of its own plane and its
    neighbors', each by how little it is off its own points and this one: at an edge the planes of
    one side remain, at a second sheet close by those of the point's own, and where there is noise
    many count. What can be seen from outside faces whoever sees it; what is hidden follows its
    neighbors, and a surface open to both sides faces away from its middle at the farthest point.

    **Arguments:**

    - `points`: mm, at least 4 at different places. Those at one place have one normal.
    - `neighbors`: whose planes count.

    **Source:** Hoppe et al. 1992, "Surface Reconstruction from Unorganized Points", sections 3.2
    and 3.3; weights of Pauly et al. 2003, "Shape Modeling with Point-Sampled Geometry"; planes of
    neighbors after the windows of Kuwahara et al. 1976.
    """
    first, inverse = distinct(points)
    along = morton_order(points[first].astype(np.float32))
    places = points[first[along]]
    neighbors = min(neighbors, len(places) - 1)
    distances, near = scipy.spatial.KDTree(places).query(places, k=neighbors + 1, workers=-1)
    middles, planes, off = _planes(places, distances, near)
    outward = planes * outward_signs(places, planes, near[:, 1:], distances[:, -1])[:, None]
    size = distances[:, min(_WINDOW, neighbors)] ** 2
    normals = np.empty(places.shape)
    for start in range(0, len(places), _CHUNK):
        part = slice(start, start + _CHUNK)
        ways, those = planes[near[part]], near[part]
        beyond = np.einsum("nki,nki->nk", ways, places[part, None] - middles[those]) ** 2
        share = (
            1
            / ((off[those] + beyond) / np.maximum(size[part, None], np.finfo(float).tiny) + _FLAT)
            ** 2
        )
        best = np.take_along_axis(ways, share.argmax(axis=1)[:, None, None], axis=1)
        share *= np.where(np.einsum("nki,nji->nk", ways, best) < 0, -1.0, 1.0)
        normals[part] = np.einsum("nk,nki->ni", share, ways)
    normals *= np.where(np.einsum("ni,ni->n", normals, outward) < 0, -1.0, 1.0)[:, None]
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True))[np.argsort(along)][inverse]


def _planes(
    places: Float[np.ndarray, "n 3"],
    distances: Float[np.ndarray, "n k"],
    near: Int[np.ndarray, "n k"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Compute the middle, the normal and the mean squared distance (mm^2) of the plane through each
    point's window.
    """
    distances, near = distances[:, : _WINDOW + 1], near[:, : _WINDOW + 1]
    middles, normals, off = np.empty(places.shape), np.empty(places.shape), np.empty(len(places))
    for start in range(0, len(places), _CHUNK):
        part = slice(start, start + _CHUNK)
        around, reach = places[near[part]], distances[part, -1:]
        shares = (1 - (distances[part] / np.where(reach > 0, _BEYOND * reach, 1)) ** 2)[
            ..., None
        ] ** 2
        whole = shares.sum(axis=1)
        middles[part] = (shares * around).sum(axis=1) / whole
        around = around - middles[part, None]
        variances, ways = np.linalg.eigh((shares * around).swapaxes(1, 2) @ around)
        normals[part], off[part] = ways[..., 0], np.maximum(variances[:, 0], 0) / whole[:, 0]
    return middles, normals, off
