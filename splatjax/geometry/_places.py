"""Places of points: which are the same, and the Morton curve, along which neighbors in space are
near in memory.
"""

import numpy as np
from jaxtyping import Float, Int

_BITS = 21


def _spread(x: np.ndarray) -> np.ndarray:
    """Put two zero bits between the bits of 21-bit integers."""
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
    """Give the order of points along the Morton curve of their bounding cube, 2^21 cells a side;
    ties keep their order.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    points = points.astype(np.float64)
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max()) or 1.0
    cells = np.minimum((points - low) * (2**_BITS / extent), 2**_BITS - 1).astype(np.uint64)
    code = (
        _spread(cells[:, 0])
        | (_spread(cells[:, 1]) << np.uint64(1))
        | (_spread(cells[:, 2]) << np.uint64(2))
    )
    return np.argsort(code, kind="stable")


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
