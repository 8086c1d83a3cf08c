"""Points that stand where others do."""

import numpy as np
from jaxtyping import Float, Int


def distinct(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " n"]]:
    """Give the first point of each place, in the order of the points, and the place of every
    point.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    order = np.lexsort(points.T)
    new = np.append(True, (np.diff(points[order], axis=0) != 0).any(axis=1))
    first = np.minimum.reduceat(order, np.flatnonzero(new))
    kept = np.argsort(first)
    rank = np.empty_like(kept)
    rank[kept] = np.arange(len(kept))
    place = np.empty(len(points), np.int64)
    place[order] = rank[np.cumsum(new) - 1]
    return first[kept], place
