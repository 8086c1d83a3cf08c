"""Clay: primitives and soft ways to join them, as signed distances, negative inside, of arrays of
one shape.

Parts are tables for `model`: a list begins with a part, and the rows after it join another part to
it, carve it away or keep what both have in common, each over a softness.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

Point = tuple[np.ndarray, np.ndarray, np.ndarray]
Size = float | int
# A distance; or a primitive, the number of its view and its sizes; or a list of a part and rows of
# an operation, its softness and another part.
Part = np.ndarray | tuple[Any, ...] | list[Any]


def model(part: Part, views: Sequence[Point]) -> np.ndarray:
    """Evaluate the distance to a part at points, given in several coordinates (views)."""
    if isinstance(part, np.ndarray):
        return part
    if isinstance(part, tuple):
        primitive, view, *sizes = part
        return primitive(views[view], *sizes)
    body = model(part[0], views)
    for operation, softness, other in part[1:]:
        body = operation(body, model(other, views), softness)
    return body


def ellipsoid(p: Point, center, radii) -> np.ndarray:
    """Compute the distance to an ellipsoid, to first order (exact on it):
    `k (k - 1) / |grad k^2 / 2|`, `k = |p / r|`.
    """
    scaled = [(x - c) / r for x, c, r in zip(p, center, radii, strict=True)]
    k = np.sqrt(sum(s * s for s in scaled))
    slope = np.sqrt(sum((s / r) ** 2 for s, r in zip(scaled, radii, strict=True)))
    return np.where(slope > 1e-6, k * (k - 1) / np.maximum(slope, 1e-6), -min(radii))


def limb(p: Point, start, end, start_radius: Size, end_radius: Size) -> np.ndarray:
    """Compute the distance to a capsule whose radius changes linearly from `start` to `end` (to
    first order).
    """
    axis = [e - s for s, e in zip(start, end, strict=True)]
    length = sum(a * a for a in axis)
    share = sum((x - s) * a for x, s, a in zip(p, start, axis, strict=True)) / length
    share = np.clip(share, 0.0, 1.0)
    squared = sum((x - s - share * a) ** 2 for x, s, a in zip(p, start, axis, strict=True))
    return np.sqrt(squared) - (start_radius + (end_radius - start_radius) * share)


def above(p: Point, height: Size) -> np.ndarray:
    """Compute the distance to everything above a height."""
    return -(p[1] - height)


def join(a: np.ndarray, b: np.ndarray, softness: Size) -> np.ndarray:
    """Unite two bodies; where both are within `softness`, a fillet fills the corner (quadratic
    smooth minimum).
    """
    blend = np.maximum(softness - np.abs(a - b), 0.0)
    return np.minimum(a, b) - blend * blend * (0.25 / softness)


def carve(a: np.ndarray, b: np.ndarray, softness: Size) -> np.ndarray:
    """Take the second body away from the first; the edge is rounded over `softness`."""
    return -join(-a, b, softness)


def keep(a: np.ndarray, b: np.ndarray, softness: Size) -> np.ndarray:
    """Keep what two bodies have in common; the edge is rounded over `softness`."""
    return -join(-a, -b, softness)


def bump(x: np.ndarray, center: Size | np.ndarray, width: Size | np.ndarray) -> np.ndarray:
    """Compute `exp(-(x - center)^2 / width^2)`: clay put on, or taken off."""
    return np.exp(-(((x - center) / width) ** 2))
