"""Points in an order in which neighbors in the list are neighbors in space."""

import numpy as np

BLOCK = 64
"""Points of one block; blocks, and their halves, quarters and eighths, are compact."""


def compact_order(points: np.ndarray) -> np.ndarray:
    """Give the order `[points]` of a k-d tree whose leaves hold `BLOCK` points, but the last, and are sorted down to eighths.

    **Arguments:** `points`: `[points, 3]`.
    """
    count = len(points)
    order = np.arange(count)
    todo = [(0, count)]
    while todo:
        begin, end = todo.pop()
        if end - begin <= BLOCK:
            continue
        middle = begin + -(-(end - begin) // (2 * BLOCK)) * BLOCK
        part = order[begin:end]
        place = points[part]
        axis = np.argmax(np.ptp(place, axis=0))
        order[begin:end] = part[np.argpartition(place[:, axis], middle - begin - 1)]
        todo += [(begin, middle), (middle, end)]
    full = count // BLOCK * BLOCK
    blocks, size = order[:full], BLOCK
    while size > BLOCK // 8:
        blocks = blocks.reshape(-1, size)
        place = points[blocks]
        axis = np.argmax(np.ptp(place, axis=1), axis=1)
        along = np.take_along_axis(place, axis[:, None, None], axis=2)[:, :, 0]
        blocks = np.take_along_axis(blocks, np.argsort(along, axis=1), axis=1)
        size //= 2
    return np.concatenate([blocks.reshape(-1), order[full:]])
