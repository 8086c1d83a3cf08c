"""Normals, radii and areas of points that come without."""

import numpy as np
import pytest
from bodies import unit

from splatjax.geometry import bust_mesh, complete_splats, estimate_normals
from splatjax.geometry._scatter import scatter


@pytest.fixture(scope="module")
def on_the_bust():
    mesh = bust_mesh()
    points = scatter(mesh, 12_000)
    return mesh, points.positions(mesh), points.normals(mesh)


def test_normals_point_outward_on_a_head(on_the_bust):
    """Ears and nostrils included: at a spacing of 4 mm less than a hundredth lies on the wrong
    side.
    """
    _, centers, normals = on_the_bust
    agreement = np.einsum("ni,ni->n", estimate_normals(centers), normals)
    assert (agreement > 0).mean() > 0.99
    assert np.median(agreement) > 0.99


def test_two_bodies_are_each_turned_outward():
    random = np.random.default_rng(0)
    ball = unit(random.normal(size=(800, 3)))
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


def plane(count=900, spacing=1.0, seed=0):
    side = round(count**0.5)
    grid = spacing * np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    grid = grid + np.random.default_rng(seed).uniform(-0.3, 0.3, grid.shape) * spacing
    return np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)


@pytest.mark.parametrize("gap", [1.6])
def test_two_sheets_close_together_are_not_mixed(gap):
    """A slab little thicker than its points are apart: each side has its own normals, and they face
    away from each other.
    """
    sheet = plane()
    points = np.concatenate([sheet, sheet + np.asarray([0.4, 0.3, gap])])
    normals = estimate_normals(points)
    inner = (np.abs(points[:, :2] - 14.5) < 11).all(axis=1)
    np.testing.assert_allclose(np.abs(normals[inner, 2]), 1, atol=1 - np.cos(np.radians(15)))
    above = points[:, 2] > 0
    assert (np.sign(normals[inner & above, 2]) == 1).all()
    assert (np.sign(normals[inner & ~above, 2]) == -1).all()


@pytest.mark.parametrize("angle", [35, 120])
def test_the_sides_of_an_edge_keep_their_own_normals(angle):
    """Half a spacing away from it a point is one side's."""
    sheet = plane(1600)
    fold = np.radians(angle)
    right, left = (sheet[keep] - [19.5, 0, 0] for keep in (sheet[:, 0] > 19.9, sheet[:, 0] < 19.1))
    left = np.stack([left[:, 0] * np.cos(fold), left[:, 1], left[:, 0] * np.sin(fold)], axis=1)
    normals = estimate_normals(np.concatenate([right, left]))
    expected = np.concatenate(
        [
            np.tile([0, 0, 1.0], (len(right), 1)),
            np.tile([-np.sin(fold), 0, np.cos(fold)], (len(left), 1)),
        ]
    )
    agreement = np.abs(np.einsum("ni,ni->n", normals, expected))
    assert (agreement > np.cos(np.radians(10))).mean() > 0.99


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
    turn = random.uniform(0, 2 * np.pi, 20_000)
    around, flat = np.stack([np.cos(turn), np.sin(turn)], axis=1), np.zeros((20_000, 1))
    share = random.uniform(size=(20_000, 1))
    outward = np.concatenate([around, flat], axis=1)
    up = np.asarray([0.0, 0.0, 1.0])
    parts = [
        (9_400, lambda u: (10 * around, 30 * u), outward),
        (5_100, lambda u: (6 * around, 3 + 27 * u), -outward),
        (1_600, lambda u: (10 * np.sqrt(u) * around, 0 * u), -up),
        (600, lambda u: (6 * np.sqrt(u) * around, 3 + 0 * u), up),
        (1_000, lambda u: (np.sqrt(36 + 64 * u) * around, 30 + 0 * u), up),
    ]
    points = np.concatenate(
        [np.concatenate(place(share), axis=1)[:count] for count, place, _ in parts]
    )
    expected = np.concatenate(
        [np.broadcast_to(normal, (20_000, 3))[:count] for count, _, normal in parts]
    )
    agreement = np.einsum("ni,ni->n", estimate_normals(points), expected)
    assert (agreement > 0).mean() > 0.99


def test_a_hollow_within_a_body_faces_its_middle():
    """A shell around a shell: nothing sees the inner one, and a body within a body there is
    none.
    """
    random = np.random.default_rng(1)
    ways = unit(random.normal(size=(8_000, 3)))
    outer = np.arange(8_000) < 6_000
    agreement = np.einsum(
        "ni,ni->n", estimate_normals(np.where(outer, 20.0, 11.0)[:, None] * ways), ways
    )
    assert (agreement[outer] > 0).all()
    assert (agreement[~outer] < 0).all()


def test_points_at_one_place_share_its_area_and_its_normal():
    """Ten scans of one sheet, each point in its place: more than there are neighbors to look at."""
    sheet = plane(400)
    once, often = complete_splats(sheet), complete_splats(np.concatenate([sheet] * 20))
    np.testing.assert_allclose(float(often.areas.sum()), float(once.areas.sum()), rtol=1e-5)
    np.testing.assert_allclose(float(often.radii.max()), float(once.radii.max()), rtol=1e-5)
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
    points = np.concatenate([coarse, fine[:9000] - [9.7, 0, 0]])
    splats = complete_splats(points)
    left = np.asarray(splats.centers)[:, 0] < -1
    radii = np.asarray(splats.radii)
    np.testing.assert_allclose(np.median(radii[~left]) / np.median(radii[left]), 10, rtol=0.1)
