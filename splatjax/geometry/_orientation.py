"""Which side of a surface is outside, where only points and their planes are known."""

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Float, Int

from ._hollows import turn_cavities

_VIEWS = 32
_SURE = 0.7  # share of the votes by which one side wins
_DOUBT = 0.5  # votes that nobody cast: a side seen once is not sure yet
_SMOOTH = 0.99  # agreement of neighbors in one patch
_LEAST_PATCH = 100
_ROOT = 1e-9  # cost of being one; a zero would be no edge

Signs = Float[np.ndarray, " n"]


def outward_signs(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    near: Int[np.ndarray, "n k"],
    reaches: Float[np.ndarray, " n"],
) -> Signs:
    r"""Give the signs that turn normals outward.

    The points are looked at from all around. Where a point and its neighbors are seen from one side
    alone, it is the outer one. From there signs are carried along a minimum spanning tree of the
    neighborhood graph. Neighbors at `p_i` and `p_j` agree as far as one normal is the mirror image
    of the other in the plane between the points, as on a circle, around an edge and across a thin
    sheet, and the cost of an edge is `1.001 - |agreement|`. A part that is seen from both sides
    alike, or not at all, is turned away from its middle at its farthest point. What hides within a
    body is a hollow (`turn_cavities`).

    **Arguments:**

    - `normals`: unit, of either sign.
    - `near`: neighbors of each point, without itself, each at another place.
    - `reaches`: mm, how far away the last of them is.

    **Source:** Hoppe et al. 1992, section 3.3; König and Gumhold 2009, "Consistent Propagation of
    Normal Orientations in Point Clouds", for agreement around edges.
    """
    votes, cast = _votes(points, normals, 0.6 * float(np.quantile(reaches, 0.99)))
    around, cast_around = votes.copy(), cast.copy()
    for each in near.T:
        around += votes[each] * np.sign(np.einsum("ni,ni->n", normals, normals[each]))
        cast_around += cast[each]
    sure = np.abs(around) > _SURE * (cast_around + _DOUBT * (1 + near.shape[1]))
    signs, patches = _carried(
        points, normals, near, np.flatnonzero(sure), np.where(around < 0, -1.0, 1.0)
    )
    if not sure.any() or not patches:
        return signs
    areas = np.pi / near.shape[1] * reaches**2
    turn_cavities(points, (areas * signs)[:, None] * normals, patches, signs)
    sure[np.concatenate(patches)] = True  # and what lies between them follows
    return _carried(points, normals, near, np.flatnonzero(sure), signs)[0]


def _votes(points: np.ndarray, normals: np.ndarray, pixel: float) -> tuple[Signs, Signs]:
    """Give for how many views each normal points to the viewer less those where it points away, and
    how many see it at all.

    A point is seen where nothing lies more than a pixel before it and the pixels around. A view
    counts by its squared cosine.
    """
    index = np.arange(_VIEWS) + 0.5  # on a spiral around the sphere
    height, angle = 1 - 2 * index / _VIEWS, index * np.pi * (3 - np.sqrt(5))
    low, high = points.min(axis=0), points.max(axis=0)
    pixel = max(pixel, float((high - low).max()) / 4096, 1e-30)
    single, facing = (points - 0.5 * (low + high)).astype(np.float32), normals.astype(np.float32)
    votes, cast = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for z, turn in zip(height, angle, strict=True):
        r = np.sqrt(1 - z * z)
        frame = [
            [-np.sin(turn), np.cos(turn), 0],
            [-z * np.cos(turn), -z * np.sin(turn), r],
            [r * np.cos(turn), r * np.sin(turn), z],
        ]
        across, up, towards = np.asarray(frame, np.float32) @ single.T
        columns, rows = (
            np.floor((each - each.min()) / pixel).astype(np.int64) for each in (across, up)
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
    points: np.ndarray, normals: np.ndarray, one: np.ndarray, other: np.ndarray
) -> Signs:
    """Give the cosine between normals and the mirror images of others in the plane between them."""
    between = points[other] - points[one]
    along = [np.einsum("ni,ni->n", normals[each], between) for each in (one, other)]
    squared = np.einsum("ni,ni->n", between, between)
    return np.einsum("ni,ni->n", normals[one], normals[other]) - 2 * along[0] * along[1] / squared


def _carried(
    points: np.ndarray, normals: np.ndarray, near: np.ndarray, sure: np.ndarray, signs: Signs
) -> tuple[Signs, list[np.ndarray]]:
    """Carry signs from points that are sure of theirs to all others; give also which of these hang
    together smoothly.
    """
    count, neighbors = near.shape
    waiting = np.setdiff1d(np.arange(count), sure, assume_unique=True)
    start, end = np.repeat(waiting, neighbors), near[waiting].ravel()
    key = np.unique(np.minimum(start, end) * np.int64(count) + np.maximum(start, end))
    low, high = key // count, key % count
    agreement = _agreement(points, normals, low, high)
    cost = 1.001 - np.minimum(np.abs(agreement), 1.0)
    graph = scipy.sparse.coo_array((cost, (low, high)), shape=(count + 1, count + 1))
    farthest, outward = _farthest(
        points, scipy.sparse.csgraph.connected_components(graph, directed=False)[1][:count], sure
    )
    signs[farthest] = np.where(np.einsum("ni,ni->n", normals[farthest], outward) < 0, -1.0, 1.0)
    roots = np.concatenate([sure, farthest])
    row, column = np.concatenate([low, roots]), np.concatenate([high, np.full(len(roots), count)])
    joined = scipy.sparse.coo_array(
        (np.concatenate([cost, np.full(len(roots), _ROOT)]), (row, column)), shape=graph.shape
    )
    ahead = scipy.sparse.csgraph.breadth_first_order(
        scipy.sparse.csgraph.minimum_spanning_tree(joined.tocsr()), count, directed=False
    )[1]
    ahead[count] = count
    inner = np.flatnonzero(ahead[:count] < count)
    signs[inner] = np.where(_agreement(points, normals, inner, ahead[inner]) < 0, -1.0, 1.0)
    signs = np.append(signs, 1.0)
    while not (
        ahead == count
    ).all():  # pointer doubling: as many rounds as the depth of the tree has bits
        signs *= signs[ahead]
        ahead = ahead[ahead]
    signs = signs[:count]
    free = np.ones(count, bool)
    free[sure] = False
    smooth = (agreement * signs[low] * signs[high] > _SMOOTH) & free[low] & free[high]
    parts = scipy.sparse.csgraph.connected_components(
        scipy.sparse.coo_array((cost[smooth], (low[smooth], high[smooth])), shape=(count, count)),
        directed=False,
    )[1]
    order = np.argsort(parts, kind="stable")
    patches = np.split(order, np.flatnonzero(np.diff(parts[order])) + 1)
    return signs, [patch for patch in patches if len(patch) >= _LEAST_PATCH]


def _farthest(
    points: np.ndarray, part: np.ndarray, sure: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Give, of each part without a sure point, the point farthest from its middle, and the way
    there.
    """
    parts = part.max() + 1
    sizes = np.maximum(np.bincount(part, minlength=parts), 1)
    middles = np.stack(
        [np.bincount(part, points[:, axis], parts) / sizes for axis in range(3)], axis=-1
    )
    outward = points - middles[part]
    by_distance = np.argsort(np.einsum("ni,ni->n", outward, outward), kind="stable")
    farthest = np.full(parts, -1)
    farthest[part[by_distance]] = by_distance  # the last one written is the farthest
    farthest[part[sure]] = -1
    farthest = farthest[farthest >= 0]
    return farthest, outward[farthest]
