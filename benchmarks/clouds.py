"""Clouds of any number of splats in a file, made a piece at a time: triangles are cut until each is
as large as a splat.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from splatjax.geometry import Mesh, Textures
from splatjax.geometry._mesh import morton_order
from splatjax.geometry._sample import albedo_at, lookup_at, perturbed_normals
from splatjax.geometry._scatter import SurfacePoints
from splatjax.io import atomic_path

COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "radius", "area", "red", "green", "blue")
_AT_ONCE = 500_000
_BEND = 0.75


def write_cloud(path: Path, mesh: Mesh, textures: Textures, count: int) -> None:
    """Write splats that cover a mesh, of one area and with its albedo, neighbors near each other,
    as `SplatFile` reads them.

    Triangles go along a Morton curve, and each gives as many splats as its area needs. The order
    within it is that of the cuts. Splats lie on the mesh bent along its normals: they are so small
    that they would show its flat triangles. Memory does not grow with their number.
    """
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment lengths in mm",
        f"element vertex {count}",
    ]
    header += [*(f"property float {name}" for name in COLUMNS), "end_header", ""]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode())
        for rows in _pieces(mesh, textures, count):
            file.write(rows.astype("<f4").tobytes())


def _pieces(mesh: Mesh, textures: Textures, count: int) -> Iterator[np.ndarray]:
    areas = mesh.face_areas()
    along = morton_order(mesh.corners().mean(axis=1))
    ends = np.rint(np.cumsum(areas[along]) * (count / areas.sum())).astype(np.int64)
    counts = np.diff(np.minimum(ends, count), prepend=0)
    scale = (
        areas.sum() / areas[along][counts > 0].sum()
    )  # triangles too small for a splat are left to the others
    for piece in np.split(np.arange(len(along)), np.flatnonzero(np.diff(ends // _AT_ONCE)) + 1):
        yield _rows(mesh, textures, along[piece], counts[piece], scale * areas[along[piece]])


def _rows(
    mesh: Mesh, textures: Textures, faces: np.ndarray, counts: np.ndarray, areas: np.ndarray
) -> np.ndarray:
    of, corners = cut(mesh.corners()[faces], counts)
    points = SurfacePoints(faces[of], corners[:, :, :3].mean(axis=1))
    flat, normals = points.positions(mesh), points.normals(mesh)
    tangent_space = lookup_at(mesh, points, textures.normal)
    if tangent_space is not None:
        normals = perturbed_normals(mesh, points, normals, tangent_space)
    area = (areas / np.maximum(counts, 1))[of]
    reach = np.linalg.norm(corners[:, :, 3:] - flat[:, None], axis=2).max(axis=1)
    albedo = albedo_at(textures, mesh, points)
    assert albedo is not None
    return np.column_stack(
        [
            bent(mesh, points, flat),
            normals,
            np.maximum(1.5 * np.sqrt(area), 1.2 * reach),
            area,
            albedo,
        ]
    )


def bent(mesh: Mesh, points: SurfacePoints, flat: np.ndarray) -> np.ndarray:
    """Move points `[points, 3]` toward the tangent planes of their triangles' corners: Boubekeur
    and Alexa 2008, section 3.
    """
    at = mesh.faces[points.faces]
    corners, normals = mesh.vertices[at], mesh.normals[at]
    above = np.einsum("pci,pci->pc", flat[:, None] - corners, normals)
    return flat - _BEND * np.einsum("pc,pc,pci->pi", points.barycentrics, above, normals)


def cut(corners: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangles into so many of one area each, always across the longest edge.

    **Arguments:** `corners`: `[triangles, 3, 3]`.

    **Returns:** of each piece the triangle, and its corners: their shares of the triangle's
    corners, then their places, `[pieces, 3, 6]`. What is cut stays together.
    """
    shares = np.broadcast_to(np.eye(3), corners.shape)
    of, found = np.arange(len(corners)), np.concatenate([shares, corners], axis=2)
    of, found, counts = of[counts > 0], found[counts > 0], counts[counts > 0]
    while (counts > 1).any():
        lengths = [
            np.sum((found[:, (i + 2) % 3, 3:] - found[:, (i + 1) % 3, 3:]) ** 2, axis=1)
            for i in range(3)
        ]
        turn = (np.argmax(lengths, axis=0)[:, None] + np.arange(3)) % 3
        found = np.take_along_axis(
            found, turn[:, :, None], axis=1
        )  # the longest edge lies opposite the first corner
        pieces = np.where(counts > 1, 2, 1)
        first = np.cumsum(pieces) - pieces
        of, found = np.repeat(of, pieces), np.repeat(found, pieces, axis=0)
        cuts = first[counts > 1]
        share = (counts // 2 / counts)[counts > 1][:, None]
        middle = found[cuts, 1] + share * (found[cuts, 2] - found[cuts, 1])
        found[cuts, 2], found[cuts + 1, 1] = middle, middle
        counts, before = np.repeat(counts, pieces), counts
        counts[cuts], counts[cuts + 1] = before[before > 1] // 2, -(-before[before > 1] // 2)
    return of, found
