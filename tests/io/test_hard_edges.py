"""Bodies with hard edges, in every format: normals end at the edges, and splats do too."""

import functools

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from writers import SUFFIXES, export

from splatjax.io import sample_mesh

COUNT = 800
FACET = 4.0
"""Degrees: round sides are of 48 facets, whose normals are this much off in the middle."""


def plate():
    """A plate with a hole, and a rib beside it."""
    rib = trimesh.creation.box((3, 30, 8))
    rib.apply_translation((25, 0, 2))
    return trimesh.util.concatenate([trimesh.creation.annulus(6, 14, 4, sections=48), rib])


BODIES = {
    "box": trimesh.creation.box((20, 24, 16)),
    "cylinder": trimesh.creation.cylinder(10, 24, sections=48),
    "plate": plate(),
}


@functools.cache
def points_of(body):
    points, faces = trimesh.sample.sample_surface(BODIES[body], 40_000, seed=0)
    return KDTree(points), BODIES[body].face_normals[faces]


def angles_to_body(splats, body):
    """Return how far normals of splats are off those of the triangles there, in degrees, and the
    distances of splats from the body.
    """
    tree, normals = points_of(body)
    distance, near = tree.query(np.asarray(splats.centers), k=8)
    cosines = np.einsum("nki,ni->nk", normals[near], np.asarray(splats.normals))
    return np.degrees(np.arccos(np.clip(cosines, -1, 1).max(axis=1))), distance[:, 0]


@pytest.mark.parametrize("rounded", [True, False])
@pytest.mark.parametrize("kind", [*SUFFIXES, "smooth ply", "smooth obj", "smooth glb"])
@pytest.mark.parametrize("body", BODIES)
def test_normals_end_at_hard_edges(tmp_path, body, kind, rounded):
    """Files without normals, and files whose normals are the mean of all faces around a vertex."""
    mesh = BODIES[body].copy()
    if kind.startswith("smooth"):
        mesh.vertex_normals = np.array(mesh.vertex_normals)
        path = export(mesh, tmp_path, kind.split()[1])
    else:
        options = {"ply": {"vertex_normal": False}, "obj": {"include_normals": False}}
        options |= {"glb": {"include_normals": False}, "gltf": {"include_normals": False}}
        path = export(mesh, tmp_path, kind, **options.get(kind.split(".")[-1], {}))
    splats = sample_mesh(path, COUNT, mm_per_unit=1.0, rounded=rounded)
    angles, distances = angles_to_body(splats, body)
    assert angles.max() < (0.1 if body == "box" else FACET)
    assert distances.max() < 0.5
    np.testing.assert_allclose(float(splats.areas.sum()), mesh.area, rtol=2e-3)


def test_splats_reach_little_beyond_hard_edges(tmp_path):
    """Seen up to 0.8 of their radius, at most 0.7 spacings; at corners too."""
    path = export(BODIES["box"], tmp_path, "off")
    splats = sample_mesh(path, COUNT, mm_per_unit=1.0)
    centers, normals = np.asarray(splats.centers), np.asarray(splats.normals)
    spacing = (BODIES["box"].area / COUNT) ** 0.5
    beyond = np.abs(centers) + 0.8 * np.asarray(splats.radii)[:, None] - [10, 12, 8]
    assert beyond[np.abs(normals) < 0.5].max() < 0.7 * spacing
