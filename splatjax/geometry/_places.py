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
    """Return the order of points along the Morton curve of their bounding cube, 2^21 cells a side;
    ties keep their order.
    """
    points = points.astype(np.float64)
    low, high = points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf)
    size = (high - low).max() or 1.0
    cells = np.minimum((points - low) * (2**_BITS / size), 2**_BITS - 1).astype(np.uint64)
    code = sum(_spread(axis) << np.uint64(bit) for bit, axis in enumerate(cells.T))
    return np.argsort(code, kind="stable")


def distinct(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " n"]]:
    """Return the first point of each place, in the order of the points, and the place of every
    point.
    """
    _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[place.ravel()]
