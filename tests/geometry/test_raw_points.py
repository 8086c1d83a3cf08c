"""Normals, radii and areas of points that come without."""

import numpy as np
import pytest

from splatjax.geometry import bust_mesh, complete_splats, estimate_normals
from splatjax.geometry._scatter import scatter


@pytest.fixture(scope="module")
def on_the_bust():
    mesh = bust_mesh(spacing=1.6)
    points = scatter(mesh, 12_000)
    return mesh, points.positions(mesh), points.normals(mesh)


def test_normals_point_outward_on_a_head(on_the_bust):
    """Ears and nostrils included: at a spacing of 4 mm less than a hundredth lies on the wrong side."""
    _, centers, normals = on_the_bust
    agreement = np.einsum("ni,ni->n", estimate_normals(centers), normals)
    assert (agreement > 0).mean() > 0.99
    assert np.median(agreement) > 0.99


def test_two_bodies_are_each_turned_outward():
    random = np.random.default_rng(0)
    ball = random.normal(size=(800, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    normals = estimate_normals(np.concatenate([ball, ball + np.asarray([10.0, 0.0, 0.0])]))
    assert (np.einsum("ni,ni->n", normals, np.concatenate([ball, ball])) > 0).all()


def test_areas_of_raw_points_are_those_of_the_surface(on_the_bust):
    mesh, centers, _ = on_the_bust
    splats = complete_splats(centers)
    np.testing.assert_allclose(float(splats.areas.sum()), mesh.area(), rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(np.asarray(splats.normals), axis=1), 1, atol=1e-6)


def test_given_fields_are_kept():
    ball = np.random.default_rng(0).normal(size=(50, 3))
    radii = np.linspace(1, 2, 50)
    splats = complete_splats(ball, radii=radii)
    np.testing.assert_allclose(np.sort(np.asarray(splats.radii)), radii, rtol=1e-6)
    near = np.linalg.norm(ball[:, None] - np.asarray(splats.centers)[None], axis=-1).argmin(axis=1)
    np.testing.assert_allclose(np.asarray(splats.radii)[near], radii, rtol=1e-6)


def test_too_few_points_are_refused():
    with pytest.raises(ValueError, match="3 points are too few"):
        complete_splats(np.eye(3))
