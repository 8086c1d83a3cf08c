"""Estimation and orientation of the normals of raw points."""

from collections.abc import Sequence

import numpy as np
import scipy  # submodules load on first use, which takes a third of a second
from jaxtyping import Float, Int

from splatjax.scene import even_directions

from ._mesh import distinct, morton_order
from ._scatter import tangent_frames

_CHUNK = 1 << 16
# Reach of the weights in distances of the farthest neighbor, so that it has a weight.
_BEYOND = 1.05
_WINDOW = 8  # nearest points to which a plane is fitted
_FLAT = 1e-3  # relative to a window's squared size; planes with smaller deviations count as equal


def estimate_normals(
    points: Float[np.ndarray, "n 3"], *, neighbors: int = 12
) -> Float[np.ndarray, "n 3"]:
    r"""Estimate outward unit normals of points on a surface.

    A plane is fitted to the nearest points of each point (principal components, weighted by
    distance). The normal of a point is a weighted mean over its plane and the planes of its
    neighbors; the weight is large if a plane fits its own points and this point well. At an edge,
    the planes of one side dominate; near a second sheet, those of the point's own sheet. Noise is
    averaged over many planes. Normals of points that are visible from outside face the viewer, and
    hidden points follow their neighbors. A surface open to both sides faces away from its center at
    its farthest point.

    **Arguments:**

    - `points`: mm, at least 4 distinct. Points at the same place have the same normal.
    - `neighbors`: number of neighbors in the mean.

    **Source:** Hoppe et al. 1992, "Surface Reconstruction from Unorganized Points", sections 3.2
    and 3.3; weights of Pauly et al. 2003, "Shape Modeling with Point-Sampled Geometry"; planes of
    neighbors like the windows of Kuwahara et al. 1976.
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
        candidates, indices = planes[near[part]], near[part]
        beyond = np.einsum("nki,nki->nk", candidates, places[part, None] - middles[indices]) ** 2
        share = (
            1
            / ((off[indices] + beyond) / np.maximum(size[part, None], np.finfo(float).tiny) + _FLAT)
            ** 2
        )
        best = np.take_along_axis(candidates, share.argmax(axis=1)[:, None, None], axis=1)
        share *= np.where(np.einsum("nki,nji->nk", candidates, best) < 0, -1.0, 1.0)
        normals[part] = np.einsum("nk,nki->ni", share, candidates)
    normals *= np.where(np.einsum("ni,ni->n", normals, outward) < 0, -1.0, 1.0)[:, None]
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True))[np.argsort(along)][inverse]


def _planes(
    places: Float[np.ndarray, "n 3"],
    distances: Float[np.ndarray, "n k"],
    near: Int[np.ndarray, "n k"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Compute the center, the normal and the mean squared distance (mm^2) of the plane through the
    window of each point.
    """
    distances, near = distances[:, : _WINDOW + 1], near[:, : _WINDOW + 1]
    middles, normals, off = np.empty(places.shape), np.empty(places.shape), np.empty(len(places))
    for start in range(0, len(places), _CHUNK):
        part = slice(start, start + _CHUNK)
        around, reach = places[near[part]], distances[part, -1:]
        shares = (1 - (distances[part] / np.where(reach > 0, _BEYOND * reach, 1)) ** 2)[
            ..., None
        ] ** 2
        total = shares.sum(axis=1)
        middles[part] = (shares * around).sum(axis=1) / total
        around = around - middles[part, None]
        variances, axes = np.linalg.eigh((shares * around).swapaxes(1, 2) @ around)
        normals[part], off[part] = axes[..., 0], np.maximum(variances[:, 0], 0) / total[:, 0]
    return middles, normals, off


_VIEWS = 32
_SURE = 0.7  # fraction of the votes that decides a side
_DOUBT = 0.5  # votes added to the total, so that a side seen once is not yet certain
_SMOOTH = 0.99  # least agreement of neighbors in a patch
_LEAST_PATCH = 100
_BLOCK, _PROBES = 32, 256  # number of points summed as one; most points tested in a patch
_CLEAR = 0.05
_ROOT = 1e-9  # cost of the edge to a root; 0 would mean no edge

Signs = Float[np.ndarray, " n"]


def outward_signs(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    near: Int[np.ndarray, "n k"],
    reaches: Float[np.ndarray, " n"],
) -> Signs:
    r"""Compute the signs that orient normals outward.

    The points are viewed from all around. If a point and its neighbors are visible from one side
    only, that is the outer side. From these points, signs are propagated along a minimum spanning
    tree of the neighborhood graph. Neighbors at `p_i` and `p_j` agree to the extent that one normal
    is the mirror image of the other in the plane between the points, as on a circle, around an edge
    and across a thin sheet; the cost of an edge is `1.001 - |agreement|`. A part that is equally
    visible from both sides, or invisible, faces away from its center at its farthest point. Hidden
    parts inside a body are cavities (`_turn_cavities`).

    **Arguments:**

    - `normals`: unit vectors of either sign.
    - `near`: neighbors of each point at other places, without itself.
    - `reaches`: distance of the farthest of these neighbors, mm.

    **Source:** Hoppe et al. 1992, section 3.3; König and Gumhold 2009, "Consistent Propagation of
    Normal Orientations in Point Clouds", for agreement around edges.
    """
    votes, cast = _votes(points, normals, 0.6 * float(np.quantile(reaches, 0.99)))
    around, cast_around = votes.copy(), cast.copy()
    for neighbor in near.T:
        around += votes[neighbor] * np.sign(np.einsum("ni,ni->n", normals, normals[neighbor]))
        cast_around += cast[neighbor]
    sure = np.abs(around) > _SURE * (cast_around + _DOUBT * (1 + near.shape[1]))
    signs, patches = _carried(points, normals, near, sure, np.where(around < 0, -1.0, 1.0))
    if not sure.any() or not patches:
        return signs
    areas = np.pi / near.shape[1] * reaches**2
    _turn_cavities(points, (areas * signs)[:, None] * normals, patches, signs)
    sure[np.concatenate(patches)] = True  # points between patches keep their signs
    return _carried(points, normals, near, sure, signs)[0]


def _votes(points: np.ndarray, normals: np.ndarray, pixel: float) -> tuple[Signs, Signs]:
    """Count for each normal the views that it faces minus those that it faces away from, and the
    views in which its point is visible.

    A point is visible if nothing in its pixel and the adjacent pixels is more than a pixel in front
    of it. A view is weighted by its squared cosine.
    """
    directions = even_directions(_VIEWS)
    frames = np.stack([*tangent_frames(directions), directions], axis=1).astype(np.float32)
    low, high = points.min(axis=0), points.max(axis=0)
    pixel = max(pixel, float((high - low).max()) / 4096, 1e-30)
    single, facing = (points - 0.5 * (low + high)).astype(np.float32), normals.astype(np.float32)
    votes, cast = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for frame in frames:
        across, up, towards = frame @ single.T
        columns, rows = (
            np.floor((coordinates - coordinates.min()) / pixel).astype(np.int64)
            for coordinates in (across, up)
        )
        width = columns.max() + 1
        place = rows * width + columns
        nearest = np.full((rows.max() + 1, width), -np.inf, np.float32)
        np.maximum.at(nearest.reshape(-1), place, towards)
        nearest = scipy.ndimage.maximum_filter(nearest, 3, mode="nearest").reshape(-1)
        cosine = np.where(towards >= nearest[place] - pixel, facing @ frame[2], 0)
        votes += cosine * np.abs(cosine)
        cast += cosine * cosine
    return votes, cast


def _agreement(
    points: np.ndarray, normals: np.ndarray, starts: np.ndarray, ends: np.ndarray
) -> Signs:
    """Compute cosines between normals and the mirror images of other normals in the plane between
    the points.
    """
    between = points[ends] - points[starts]
    along = [np.einsum("ni,ni->n", normals[indices], between) for indices in (starts, ends)]
    squared = np.einsum("ni,ni->n", between, between)
    return np.einsum("ni,ni->n", normals[starts], normals[ends]) - 2 * along[0] * along[1] / squared


def _carried(
    points: np.ndarray, normals: np.ndarray, near: np.ndarray, sure: np.ndarray, signs: Signs
) -> tuple[Signs, list[np.ndarray]]:
    """Propagate signs from the points marked as sure to all others, and return the signs and the
    smoothly connected patches of the others.
    """
    count, neighbors = near.shape
    free = np.flatnonzero(~sure)
    start, end = np.repeat(free, neighbors), near[free].ravel()
    low, high = np.divmod(
        np.unique(np.minimum(start, end) * np.int64(count) + np.maximum(start, end)), count
    )
    agreement = _agreement(points, normals, low, high)
    cost = 1.001 - np.minimum(np.abs(agreement), 1.0)
    parts = _components(cost, low, high, count)
    # In each part without a sure point, the farthest point faces away from the center.
    sizes = np.bincount(parts)
    middles = np.stack([np.bincount(parts, axis) / sizes for axis in points.T], axis=-1)
    outward = points - middles[parts]
    by_distance = np.argsort(np.einsum("ni,ni->n", outward, outward), kind="stable")
    farthest = np.full(len(sizes), -1)
    farthest[parts[by_distance]] = by_distance  # the last one written is the farthest
    farthest[parts[sure]] = -1
    farthest = farthest[farthest >= 0]
    facing = np.einsum("ni,ni->n", normals[farthest], outward[farthest])
    signs[farthest] = np.where(facing < 0, -1.0, 1.0)
    # An extra node is the parent of all roots; every other point follows its parent in the tree.
    roots = np.concatenate([np.flatnonzero(sure), farthest])
    ends = np.concatenate([low, roots]), np.concatenate([high, np.full(len(roots), count)])
    costs = np.concatenate([cost, np.full(len(roots), _ROOT)])
    tree = scipy.sparse.csgraph.minimum_spanning_tree(
        scipy.sparse.coo_array((costs, ends), shape=(count + 1, count + 1)).tocsr()
    )
    ahead = scipy.sparse.csgraph.breadth_first_order(tree, count, directed=False)[1]
    ahead[count] = count
    inner = np.flatnonzero(ahead[:count] < count)
    signs[inner] = np.where(_agreement(points, normals, inner, ahead[inner]) < 0, -1.0, 1.0)
    signs = np.append(signs, 1.0)
    while not (ahead == count).all():  # pointer doubling: as many rounds as its depth has bits
        signs *= signs[ahead]
        ahead = ahead[ahead]
    smooth = (agreement * signs[low] * signs[high] > _SMOOTH) & ~(sure[low] | sure[high])
    parts = _components(cost[smooth], low[smooth], high[smooth], count)
    order = np.argsort(parts, kind="stable")
    patches = np.split(order, np.flatnonzero(np.diff(parts[order])) + 1)
    return signs[:count], [patch for patch in patches if len(patch) >= _LEAST_PATCH]


def _components(cost: np.ndarray, starts: np.ndarray, ends: np.ndarray, count: int) -> np.ndarray:
    graph = scipy.sparse.coo_array((cost, (starts, ends)), shape=(count, count))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def _turn_cavities(
    points: Float[np.ndarray, "n 3"],
    oriented: Float[np.ndarray, "n 3"],
    patches: Sequence[Int[np.ndarray, " _"]],
    signs: Float[np.ndarray, " n"],
) -> None:
    r"""Reverse, in place, patches that would form a body inside a body.

    The winding number of a surface is 0 outside, 1 inside, and 1/2 on the surface itself. A patch
    is reversed if this brings the total winding number on it closer to 1/2: on a shell inside a
    body it is 3/2 if the shell faces outward, and 1/2 if it faces its center. The largest patch
    comes first.

    **Arguments:**

    - `points`: mm, in an order that keeps nearby points together.
    - `oriented`: normals whose length is the area of the point, mm^2; changed for reversed
      patches.
    - `patches`: indices of the points of each patch.
    - `signs`: signs of the normals; changed for reversed patches.

    **Source:** Barill et al. 2018, "Fast Winding Numbers for Soups and Clouds", equation 4; Xu et
    al. 2023, "Globally Consistent Normal Orientation for Point Clouds by Regularizing the
    Winding-Number Field".
    """
    for patch in sorted(patches, key=len, reverse=True):
        probes = points[
            patch[np.linspace(0, len(patch) - 1, min(len(patch), _PROBES)).astype(np.int64)]
        ]
        of_all = np.median(_winding(probes, points, oriented))
        of_patch = np.median(_winding(probes, points[patch], oriented[patch]))
        if (of_all - of_patch - 0.5) * of_patch > _CLEAR:
            signs[patch] *= -1
            oriented[patch] *= -1


def _winding(
    probes: Float[np.ndarray, "probes 3"],
    points: Float[np.ndarray, "n 3"],
    oriented: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, " probes"]:
    """Compute winding numbers at probes on a surface, summing points in blocks. The terms of the
    block around a probe nearly cancel.
    """
    starts = np.arange(0, len(points), _BLOCK)
    sizes = np.diff(np.append(starts, len(points)))
    middles, normals = (
        np.add.reduceat(points, starts) / sizes[:, None],
        np.add.reduceat(oriented, starts),
    )
    angles = np.empty(len(probes))
    for i, probe in enumerate(probes):  # one by one, to save memory
        ray = middles - probe[None]
        cubed = np.einsum("bi,bi->b", ray, ray) ** 1.5
        angles[i] = (np.einsum("bi,bi->b", ray, normals) / np.where(cubed > 0, cubed, np.inf)).sum()
    return angles / (4 * np.pi)
