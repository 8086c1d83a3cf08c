"""Points in an order in which neighbors in the list are neighbors in space."""

import numpy as np

BLOCK = 32
"""Points of one block; blocks, and their halves and quarters, are compact."""


_TOGETHER = 128 * BLOCK  # split side by side from here on


def compact_order(points: np.ndarray) -> np.ndarray:
    """Find the order `[points]` of a k-d tree whose leaves hold `BLOCK` points, but the last, and
    are sorted down to quarters.

    **Arguments:** `points`: `[points, 3]`.
    """
    order, place = (
        np.arange(len(points)),
        np.array(points.T, np.float32, order="C"),
    )  # turned together: near in memory
    todo = [(0, len(points))]
    while todo:
        begin, end = todo.pop()
        step = _TOGETHER if end - begin > _TOGETHER else BLOCK
        if end - begin <= step or end - begin == _TOGETHER:
            continue
        middle = begin + -(-(end - begin) // (2 * step)) * step
        part = place[:, begin:end]
        turn = np.argpartition(part[np.argmax(np.ptp(part, axis=1))], middle - begin - 1)
        order[begin:end], place[:, begin:end] = order[begin:end][turn], part[:, turn]
        todo += [(begin, middle), (middle, end)]
    together, whole = (len(points) // size * size for size in (_TOGETHER, BLOCK))
    for begin in range(0, together, _TOGETHER):
        _halve(order[begin : begin + _TOGETHER], place[:, begin : begin + _TOGETHER], _TOGETHER)
    _halve(order[together:whole], place[:, together:whole], BLOCK)
    return order


def _halve(order: np.ndarray, place: np.ndarray, size: int) -> None:
    """Split parts of one size in halves, along their longest axes, down to quarters of a block. In
    place.
    """
    while size > BLOCK // 4:
        parts = place.reshape(3, -1, size)
        longest = np.argmax(np.ptp(parts, axis=2), axis=0)
        rows = np.arange(parts.shape[1])
        turn = (
            np.argpartition(parts[longest, rows], size // 2, axis=1) + rows[:, None] * size
        ).reshape(-1)
        order[:], place[:] = order[turn], place[:, turn]
        size //= 2
