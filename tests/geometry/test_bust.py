"""Laws of the procedural bust."""

import numpy as np
import pytest
import trimesh

from splatjax.geometry import bust, bust_mesh

numpy_alone = pytest.mark.once
"""The mesh is made and measured in NumPy, whatever JAX's precision."""


@pytest.fixture(scope="module")
def mesh():
    return bust_mesh()


@numpy_alone
def test_bust_is_closed_and_faces_outward(mesh):
    """Every edge belongs to two triangles, which run along it in opposite directions; and Euler's
    number of one body without a hole.
    """
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert body.is_watertight
    assert body.is_winding_consistent
    assert body.volume > 0
    assert body.euler_number == 2


@numpy_alone
def test_bust_is_life_size(mesh):
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    np.testing.assert_allclose((high - low)[0], 230, atol=25)
    np.testing.assert_allclose(
        low[0], -high[0], atol=0.3
    )  # the same on both sides, but for the grid
    assert 110 < high[1] < 120
    head = mesh.vertices[mesh.vertices[:, 1] > 30]
    np.testing.assert_allclose(np.ptp(head[:, 0]), 155, atol=8)
    np.testing.assert_allclose(np.ptp(head[:, 2]), 190, atol=12)


@numpy_alone
def test_normals_of_the_bust_agree_with_its_triangles(mesh):
    a, b, c = np.moveaxis(mesh.corners(), 1, 0)
    face_normals = np.cross(b - a, c - a)
    agreement = np.einsum("fi,fi->f", face_normals, mesh.normals[mesh.faces].mean(axis=1))
    areas = mesh.face_areas()
    assert areas[agreement < 0].sum() < 2e-3 * areas.sum()  # in the folds of lids and nostrils


@numpy_alone
def test_texture_coordinates_cover_the_unit_square_once(mesh):
    assert mesh.uvs.min() >= 0
    assert mesh.uvs[..., 1].max() <= 1
    across = np.ptp(mesh.uvs[..., 0], axis=1) > 0.5  # those around the poles
    assert across.sum() <= 20
    signed_areas = np.linalg.det(mesh.uvs[:, 1:] - mesh.uvs[:, :1]) / 2
    np.testing.assert_allclose(signed_areas.sum(), 1, rtol=0.02)


def test_splats_of_the_bust(dtype):
    splats = bust(5000)
    assert splats.count == 5000
    assert splats.centers.dtype == dtype
    np.testing.assert_allclose(float(splats.areas.sum()), 213_000, rtol=0.05)
    assert float(splats.albedo.min()) > 0
    assert float(splats.albedo.max()) < 1


def test_bust_refuses_a_spacing_that_loses_the_ears():
    with pytest.raises(ValueError, match="spacing is 9"):
        bust_mesh(spacing=9.0)


def test_a_scaled_body_has_its_shape_and_the_square_of_its_area():
    splats = bust(500)
    small = splats.scaled(0.25)
    np.testing.assert_allclose(small.centers, 0.25 * splats.centers, rtol=1e-6)
    np.testing.assert_array_equal(small.normals, splats.normals)
    np.testing.assert_array_equal(small.albedo, splats.albedo)
    np.testing.assert_allclose(small.radii, 0.25 * splats.radii, rtol=1e-5)
    np.testing.assert_allclose(small.areas, splats.areas / 16, rtol=1e-5)
