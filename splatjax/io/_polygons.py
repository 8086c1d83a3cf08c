"""Polygons of mesh files: their triangles, and what makes one of them no fan."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from splatjax.geometry import distinct


def fan(corners: Sequence[Any]) -> list[tuple[Any, Any, Any]]:
    """Give the triangles between the first corner of a polygon and each side that does not touch
    it.
    """
    return [(corners[0], *side) for side in pairwise(corners[1:])]


def fans(
    counts: Int[np.ndarray, " polygons"], values: Int[np.ndarray, " corners"]
) -> Int[np.ndarray, "triangles 3"]:
    """Give the fans of polygons that stand one after the other.

    **Arguments:**

    - `counts`: corners of each, three at least.
    """
    polygon = np.repeat(np.arange(len(counts)), counts - 2)
    first = (np.cumsum(counts) - counts)[polygon]
    side = np.arange(len(polygon)) - (np.cumsum(counts - 2) - (counts - 2))[polygon]
    return values[np.stack([first, first + side + 1, first + side + 2], axis=1)]


def check_fans(
    path: Path, corners: Float[np.ndarray, "triangles 3 3"], counts: Int[np.ndarray, " polygons"]
) -> None:
    """Refuse polygons that their fans do not cover: those whose triangles do not all face one way.

    **Arguments:**

    - `corners`: of the triangles.
    - `counts`: of the triangles of each polygon, in the same order.
    """
    if len(corners) != counts.sum():
        raise ValueError(
            f"{path}: {counts.sum()} triangles were expected, and {len(corners)} were read; write "
            "the file again"
        )
    if not (counts > 1).any():
        return
    a, b, c = np.moveaxis(corners, 1, 0)
    normals = np.cross(b - a, c - a)
    polygon = np.repeat(np.arange(len(counts)), counts)
    whole = np.add.reduceat(normals, np.cumsum(counts) - counts)
    turned = (normals * whole[polygon]).sum(axis=1) < -1e-9 * (whole**2).sum(axis=1)[polygon]
    sizes = np.add.reduceat(np.linalg.norm(normals, axis=1), np.cumsum(counts) - counts)
    turned |= ((np.linalg.norm(whole, axis=1) <= 1e-9 * sizes) & (sizes > 0))[
        polygon
    ]  # it crosses itself
    if turned.any():
        first = int(polygon[turned.argmax()])
        raise ValueError(
            f"{path}: face {first}, of {counts[first] + 2} corners, is not convex; cut it into "
            "triangles"
        )


def merged(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Make one vertex of those at one place: give which ones stay, in the order in which they come,
    and faces that name them.
    """
    first, place = distinct(vertices)
    return first, place[faces]
