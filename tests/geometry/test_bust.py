"""Laws of the procedural bust."""

import numpy as np
import pytest

from splatjax.geometry import bust, bust_mesh

numpy_alone = pytest.mark.once
"""The mesh is made and measured in NumPy, whatever JAX's precision."""


@pytest.fixture(scope="module")
def mesh():
    return bust_mesh()


@numpy_alone
def test_bust_is_closed_and_faces_outward(mesh):
    """Every edge belongs to two triangles, which run along it in opposite directions."""
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    key = edges[:, 0] * len(mesh.vertices) + edges[:, 1]
    reverse = edges[:, 1] * len(mesh.vertices) + edges[:, 0]
    assert len(np.unique(key)) == len(key)
    np.testing.assert_array_equal(np.sort(key), np.sort(reverse))
    assert mesh.volume() > 0
    assert (
        len(mesh.vertices) - len(key) // 2 + len(mesh.faces) == 2
    )  # Euler: one body without a hole


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
    assert mesh.uvs is not None
    assert mesh.uvs.min() >= 0
    assert mesh.uvs[..., 1].max() <= 1
    across = np.ptp(mesh.uvs[..., 0], axis=1) > 0.5  # those around the poles
    assert across.sum() <= 20
    (a, b, c) = np.moveaxis(mesh.uvs, 1, 0)
    ab, ac = b - a, c - a
    signed = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]) / 2
    np.testing.assert_allclose(signed.sum(), 1, rtol=0.02)


def test_splats_of_the_bust(dtype):
    splats = bust(5000)
    assert splats.count == 5000
    assert splats.centers.dtype == dtype
    np.testing.assert_allclose(float(splats.areas.sum()), 213_000, rtol=0.05)
    assert splats.albedo is not None
    assert float(splats.albedo.min()) > 0
    assert float(splats.albedo.max()) < 1


def test_bust_refuses_a_spacing_that_loses_the_ears():
    with pytest.raises(ValueError, match="spacing is 9"):
        bust_mesh(spacing=9.0)
