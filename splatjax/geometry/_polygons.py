"""Polygons cut into triangles."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

_MOST_CORNERS = 1000  # of a polygon that is not convex


def triangulate(
    points: Float[np.ndarray, "n 3"], polygons: Sequence[Sequence[int] | np.ndarray]
) -> Int[np.ndarray, "triangles 3"]:
    r"""Cut polygons into triangles that cover them and no more, in the order of the polygons.

    Convex ones become fans around their first corner; of others ears are cut off, in the plane of their mean normal.

    **Arguments:**

    - `points`: mm.
    - `polygons`: corners of each, three at least, counterclockwise seen from outside.

    **Raises:** `ValueError` for a polygon of more than a thousand corners that is not convex.

    **Source:** Meisters 1975, "Polygons Have Ears".
    """
    sizes = np.fromiter(map(len, polygons), np.int64, len(polygons))
    firsts = np.concatenate([[0], np.cumsum(sizes - 2)])
    triangles = np.empty((int(firsts[-1]), 3), np.int64)
    for size in np.unique(sizes):
        chosen = np.flatnonzero(sizes == size)
        corners = np.asarray([polygons[i] for i in chosen])
        fan = np.stack([np.zeros(size - 2, np.int64), np.arange(1, size - 1), np.arange(2, size)], axis=1)
        places = firsts[chosen][:, None] + np.arange(size - 2)
        triangles[places] = corners[:, fan]
        if size > 3:
            for i in np.flatnonzero(~_convex(points[corners])):
                triangles[places[i]] = corners[i][_ears(points[corners[i]])]
    return triangles


def _convex(loops: Float[np.ndarray, "m n 3"]) -> np.ndarray:
    """Tell which polygons turn the same way at every corner, once around."""
    normals = _area_vectors(loops)
    ahead = np.roll(loops, -1, axis=1) - loops
    turns = np.einsum("mni,mi->mn", np.cross(np.roll(ahead, 1, axis=1), ahead), normals)
    fans = np.cross(loops[:, 1:-1] - loops[:, :1], loops[:, 2:] - loops[:, :1])
    return (turns >= 0).all(axis=1) & (np.einsum("mni,mi->mn", fans, normals) >= 0).all(axis=1)


def _area_vectors(loops: Float[np.ndarray, "m n 3"]) -> Float[np.ndarray, "m 3"]:
    """Give the normals of polygons, of the length of twice their areas (Newell)."""
    from_middle = loops - loops.mean(axis=1, keepdims=True)
    return np.cross(from_middle, np.roll(from_middle, -1, axis=1)).sum(axis=1)


def _ears(loop: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "triangles 3"]:
    """Cut off one ear after the other: a corner that turns outward, in whose triangle no other corner lies."""
    if len(loop) > _MOST_CORNERS:
        raise ValueError(f"a face of {len(loop)} corners is not convex; cut it into triangles first")
    normal = _area_vectors(loop[None])[0]
    keep = np.argsort(np.abs(normal))[:2]
    keep = keep if normal[np.abs(normal).argmax()] * _handedness(keep) >= 0 else keep[::-1]
    flat = loop[:, keep]
    left = list(range(len(loop)))
    found = []
    while len(left) > 3:
        ring = flat[left]
        before, after = np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0)
        turns = _turn(before, ring, after)
        for at in np.argsort(turns <= 0, kind="stable"):
            if turns[at] <= 0:  # nothing but slivers is left, or the polygon crosses itself
                at = int(np.abs(turns).argmin())
                break
            others = np.delete(np.arange(len(left)), [(at - 1) % len(left), at, (at + 1) % len(left)])
            a, b, c = before[at][None], ring[at][None], after[at][None]
            inside = (_turn(a, b, ring[others]) >= 0) & (_turn(b, c, ring[others]) >= 0) & (_turn(c, a, ring[others]) >= 0)
            same = (ring[others] == a).all(axis=1) | (ring[others] == c).all(axis=1)
            if not (inside & ~same).any():
                break
        found.append([left[(at - 1) % len(left)], left[at], left[(at + 1) % len(left)]])
        del left[at]
    return np.asarray([*found, left])


def _handedness(axes: np.ndarray) -> int:
    return 1 if (axes[1] - axes[0]) % 3 == 1 else -1


def _turn(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - b[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - b[:, 0])
