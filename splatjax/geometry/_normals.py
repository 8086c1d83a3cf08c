"""Normals of raw points."""

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Float, Int

_CHUNK = 1 << 16


def estimate_normals(points: Float[np.ndarray, "n 3"], *, neighbors: int = 12) -> Float[np.ndarray, "n 3"]:
    r"""Give unit normals of points on a surface, all on its outer side.

    The normal is the direction in which the nearest points vary least (principal components). Signs are carried along a
    minimum spanning tree of the neighbourhood graph, whose edges cost `1 - |n_i . n_j|`, from the point farthest from the
    middle of its connected part, where the normal points away from it.

    **Arguments:**

    - `points`: mm, at least 4; fast when they come in Morton order.
    - `neighbors`: how many nearest points make a plane.

    **Source:** Hoppe et al. 1992, "Surface Reconstruction from Unorganized Points", sections 3.2 and 3.3.
    """
    neighbors = min(neighbors, len(points) - 1)
    near = scipy.spatial.KDTree(points).query(points, k=neighbors + 1, workers=-1)[1]
    normals = np.empty(points.shape)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        around = points[near[part]]
        around = around - around.mean(axis=1, keepdims=True)
        normals[part] = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][..., 0]
    return normals * _signs(points, normals, near[:, 1:])[:, None]


def _signs(points: np.ndarray, normals: np.ndarray, near: Int[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    """Give the signs that make neighbouring normals agree, and point outward at the farthest point of each part."""
    count, neighbors = near.shape
    start, end = np.repeat(np.arange(count), neighbors), near.ravel()
    agreement = np.abs(np.einsum("ni,ni->n", normals[start], normals[end]))
    cost = 1.001 - np.minimum(agreement, 1.0)  # a zero would be no edge
    low, high = np.minimum(start, end), np.maximum(start, end)
    key, first = np.unique(low * np.int64(count) + high, return_index=True)
    graph = scipy.sparse.coo_array((cost[first], (key // count, key % count)), shape=(count, count)).tocsr()
    tree = scipy.sparse.csgraph.minimum_spanning_tree(graph)
    parts, part = scipy.sparse.csgraph.connected_components(graph, directed=False)
    sizes = np.bincount(part, minlength=parts)
    middles = np.stack([np.bincount(part, points[:, axis], parts) / sizes for axis in range(3)], axis=-1)
    outward = points - middles[part]
    by_distance = np.argsort(np.einsum("ni,ni->n", outward, outward), kind="stable")
    roots = np.empty(parts, np.int64)
    roots[part[by_distance]] = by_distance  # the last one written is the farthest
    return _carried(tree, roots, normals, np.where(np.einsum("ni,ni->n", normals[roots], outward[roots]) < 0, -1.0, 1.0))


def _carried(tree, roots: np.ndarray, normals: np.ndarray, root_signs: np.ndarray) -> Float[np.ndarray, " n"]:
    """Carry the signs of the roots along the trees, all of which hang from one more node."""
    count = len(normals)
    tree = scipy.sparse.coo_array(tree)
    row, column = (np.append(index, more) for index, more in zip(tree.coords, (np.full(len(roots), count), roots), strict=True))
    joined = scipy.sparse.coo_array((np.ones(len(row)), (row, column)), shape=(count + 1, count + 1)).tocsr()
    ahead = scipy.sparse.csgraph.breadth_first_order(joined, count, directed=False)[1]
    ahead[count] = count
    signs = np.ones(count + 1)
    inner = ahead[:count] < count
    signs[:count][inner] = np.where(np.einsum("ni,ni->n", normals[inner], normals[ahead[:count][inner]]) < 0, -1.0, 1.0)
    signs[roots] = root_signs
    while not (ahead == count).all():  # pointer doubling: as many rounds as the depth of the tree has bits
        signs *= signs[ahead]
        ahead = ahead[ahead]
    return signs[:count]
