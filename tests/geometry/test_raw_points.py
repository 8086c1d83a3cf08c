"""Normals, radii and areas of points that come without."""

import numpy as np
import pytest
from bodies import unit

from splatjax.geometry import bust_mesh, complete_splats, estimate_normals
from splatjax.geometry._scatter import scatter


def agreement(points, normals) -> np.ndarray:
    """Compute the cosines between the normals that are estimated and the right ones."""
    return np.sum(estimate_normals(points) * normals, axis=1)


def test_normals_point_outward_on_a_head():
    """Ears and nostrils included: at a spacing of 4 mm less than a hundredth lies on the wrong
    side. Areas of raw points are those of the surface.
    """
    mesh = bust_mesh()
    points = scatter(mesh, 12_000)
    centers = points.positions(mesh)
    splats = complete_splats(centers)
    np.testing.assert_allclose(float(splats.areas.sum()), mesh.area(), rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(splats.normals, axis=1), 1, atol=1e-6)
    cosines = agreement(centers, points.normals(mesh))
    assert (cosines > 0).mean() > 0.99
    assert np.median(cosines) > 0.99


def test_two_bodies_are_each_turned_outward():
    ball = unit(np.random.default_rng(0).normal(size=(800, 3)))
    both = np.concatenate([ball, ball + np.asarray([10.0, 0.0, 0.0])])
    assert (agreement(both, np.tile(ball, (2, 1))) > 0).all()


def plane(count=900, spacing=1.0, seed=0):
    side = round(count**0.5)
    grid = spacing * np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    grid = grid + np.random.default_rng(seed).uniform(-0.3, 0.3, grid.shape) * spacing
    return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)


def test_two_sheets_close_together_are_not_mixed():
    """A slab little thicker than its points are apart: each side has its own normals, and they face
    away from each other.
    """
    sheet = plane()
    points = np.concatenate([sheet, sheet + np.asarray([0.4, 0.3, 1.6])])
    inner = (np.abs(points[:, :2] - 14.5) < 11).all(axis=1)
    outward = np.where(points[:, 2:] > 0, 1.0, -1.0) * [0, 0, 1]
    assert (agreement(points, outward)[inner] > np.cos(np.radians(15))).all()


@pytest.mark.parametrize("angle", [35, 120])
def test_the_sides_of_an_edge_keep_their_own_normals(angle):
    """Half a spacing away from it a point is one side's."""
    x, y, _ = (plane(1600) - [19.5, 0, 0])[:, :, None].swapaxes(0, 1)
    fold = np.where(x < 0, np.radians(angle), 0.0)
    folded = np.concatenate([x * np.cos(fold), y, x * np.sin(fold)], axis=1)
    normals = np.concatenate([-np.sin(fold), 0 * x, np.cos(fold)], axis=1)
    away = np.abs(x[:, 0]) > 0.4
    cosines = np.abs(agreement(folded[away], normals[away]))
    assert (cosines > np.cos(np.radians(10))).mean() > 0.99


def test_noise_averages_out():
    """A tenth of a spacing up or down: the plane through each point's own neighbors alone is off by
    4 degrees.
    """
    sheet = plane(1600)
    sheet[:, 2] += 0.1 * np.random.default_rng(7).normal(size=1600)
    inner = (np.abs(sheet[:, :2] - 19.5) < 17).all(axis=1)
    off = np.degrees(np.arccos(np.minimum(np.abs(estimate_normals(sheet)[inner, 2]), 1)))
    assert np.sqrt(np.mean(off**2)) < 3


def test_an_open_surface_faces_one_way():
    """A dome, seen from both sides: away from its middle."""
    points = plane(1600)
    points[:, 2] = 40 - 0.02 * ((points[:, :2] - 19.5) ** 2).sum(axis=1)
    normals = estimate_normals(points)
    assert (normals[:, 2] > 0).all() or (normals[:, 2] < 0).all()


def test_what_lies_deep_within_follows_what_is_seen():
    """A cup with a rim: the bottom of its inside is seen through its mouth alone."""
    random = np.random.default_rng(0)
    # Wall, inside, bottom, bottom of the inside, rim: how many, radius, height, normal outward, up.
    parts = [
        (9_400, lambda u: (10 + 0 * u, 30 * u), (1, 0)),
        (5_100, lambda u: (6 + 0 * u, 3 + 27 * u), (-1, 0)),
        (1_600, lambda u: (10 * np.sqrt(u), 0 * u), (0, -1)),
        (600, lambda u: (6 * np.sqrt(u), 3 + 0 * u), (0, 1)),
        (1_000, lambda u: (np.sqrt(36 + 64 * u), 30 + 0 * u), (0, 1)),
    ]
    places = np.concatenate(
        [place(random.uniform(size=count)) for count, place, _ in parts], axis=1
    )
    normals = np.concatenate([np.tile([normal], (count, 1)) for count, _, normal in parts]).T
    turn = random.uniform(0, 2 * np.pi, normals.shape[1])
    points, normals = (
        np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=1)
        for across, up in (places, normals)
    )
    assert (agreement(points, normals) > 0).mean() > 0.99


def test_a_hollow_within_a_body_faces_its_middle():
    """A shell around a shell: nothing sees the inner one, and a body within a body there is
    none.
    """
    random = np.random.default_rng(1)
    ways = unit(random.normal(size=(8_000, 3)))
    outer = np.arange(8_000) < 6_000
    cosines = agreement(np.where(outer, 20.0, 11.0)[:, None] * ways, ways)
    np.testing.assert_array_equal(cosines > 0, outer)


def test_points_at_one_place_share_its_area_and_its_normal():
    """Ten scans of one sheet, each point in its place: more than there are neighbors to look at."""
    sheet = plane(400)
    once, often = complete_splats(sheet), complete_splats(np.concatenate([sheet] * 20))
    sizes = [(float(each.areas.sum()), float(each.radii.max())) for each in (often, once)]
    np.testing.assert_allclose(*sizes, rtol=1e-5)
    np.testing.assert_allclose(np.abs(np.asarray(often.normals)[:, 2]), 1, atol=1e-6)


def test_points_alone_are_told_and_stay_small():
    sheet = plane(900)
    dense = np.concatenate([sheet, 0.1 * plane(900, seed=1) + [40, 0, 0]])
    complete_splats(dense)  # where all are sparse none is alone
    with pytest.warns(UserWarning, match=r"2 of 902 points .* mm from"):
        splats = complete_splats(np.concatenate([sheet, [[15, 15, 20.0], [90, 0, 0]]]))
    assert splats.count == 902
    assert float(splats.radii.max()) < 3


def test_radii_follow_the_density():
    """Ten times as dense on one side: discs close the surface there and here, and none
    reaches far.
    """
    coarse, fine = plane(900), plane(9000, spacing=0.1)
    splats = complete_splats(np.concatenate([coarse, fine[:9000] - [9.7, 0, 0]]))
    left, radii = np.asarray(splats.centers)[:, 0] < -1, np.asarray(splats.radii)
    np.testing.assert_allclose(np.median(radii[~left]) / np.median(radii[left]), 10, rtol=0.1)
