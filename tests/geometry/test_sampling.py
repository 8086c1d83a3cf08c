"""Laws of splats on a mesh: areas, coverage, evenness, order. Laws of the procedural bust."""

import dataclasses
import itertools

import numpy as np
import pytest
import trimesh
from bodies import assert_refused, unit
from scipy.spatial import cKDTree

from splatjax.geometry import (
    Mesh,
    Textures,
    bust,
    bust_mesh,
    cut_below,
    sample_mesh,
    split_creases,
    vertex_normals,
)
from splatjax.geometry._scatter import Rounding, SurfacePoints

COUNT = 3000
SINGLE = 2e-6  # relative: a sum of thousands of float32


def sphere(radius=50.0, subdivisions=3) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices = np.array(ball.vertices)
    return Mesh(vertices, np.array(ball.faces), vertices / radius)


def square(side=10.0) -> Mesh:
    vertices = np.asarray([[0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]], float)
    faces = np.asarray([[0, 1, 2], [0, 2, 3]])
    return Mesh(vertices, faces, np.tile([0.0, 0.0, 1.0], (4, 1)), vertices[faces][..., :2] / side)


FLAT = Mesh(np.zeros((3, 3)), np.asarray([[0, 1, 2]]), np.tile([0.0, 1.0, 0.0], (3, 1)))


@pytest.fixture(scope="module")
def splats():
    return sample_mesh(sphere(), COUNT)


@pytest.mark.parametrize("count", [1, 2, 5, COUNT])
def test_areas_add_up_to_the_surface(count, dtype):
    splats = sample_mesh(sphere(), count)
    assert splats.count == count
    assert splats.areas.dtype == dtype
    area = np.asarray(splats.areas, np.float64).sum()
    np.testing.assert_allclose(area, sphere().area(), rtol=SINGLE)
    assert float(splats.areas.min()) > 0


def test_areas_are_those_of_voronoi_cells():
    """On a sheet the cells are compared with exact counts of a fine grid of nearest neighbors."""
    sheet = sample_mesh(square(), 400)
    grid, centers = (np.indices((600, 600)).reshape(2, -1).T + 0.5) / 60, sheet.centers[:, :2]
    exact = np.bincount(cKDTree(centers).query(grid)[1], minlength=400) / 3600
    inner = (np.abs(centers - 5) < 4).all(axis=1)
    # 600^2 points are 900 a cell: 1 % noise
    np.testing.assert_allclose(sheet.areas[inner], exact[inner], rtol=0.06)


def test_splats_are_blue_noise_leave_no_hole_and_lie_in_memory_as_in_space(splats):
    """Nearest neighbors: 0.5 of the spacing on average when random, 1.07 in a hexagonal grid. Every
    point of the surface lies within 0.9 of the radius of some splat.
    """
    centers, spacing = np.asarray(splats.centers), np.sqrt(sphere().area() / COUNT)
    tree = cKDTree(centers)
    nearest = tree.query(centers, k=2)[0][:, 1] / spacing
    assert nearest.mean() > 0.83
    assert nearest.min() > 0.45
    assert nearest.std() < 0.12
    fine = sample_mesh(sphere(), 6 * COUNT, seed=1)
    distance, near = tree.query(np.asarray(fine.centers), k=4)
    assert (distance / np.asarray(splats.radii)[near]).min(axis=1).max() < 0.9
    step = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert np.median(step) < 3 * spacing
    np.testing.assert_array_equal(sample_mesh(sphere(), COUNT).centers, centers)
    assert not np.array_equal(sample_mesh(sphere(), COUNT, seed=1).centers, centers)


def test_density_is_even_over_large_and_small_triangles():
    """Half of the sphere subdivided twice more gets as many splats as the other half."""
    coarse, upper = sphere(subdivisions=2), cut_below(sphere(subdivisions=4), 0.0)
    lower = coarse.select(coarse.corners()[..., 1].mean(axis=1) < 0)
    pairs = zip(
        (upper.vertices, upper.faces, upper.normals),
        (lower.vertices, lower.faces + len(upper.vertices), lower.normals),
        strict=True,
    )
    both = Mesh(*map(np.concatenate, pairs))
    is_above = np.asarray(sample_mesh(both, COUNT).centers)[:, 1] > 0
    assert abs(is_above.mean() - upper.area() / both.area()) < 0.02


def test_cut_keeps_what_is_above_the_plane():
    upper = cut_below(sphere(subdivisions=4), 20.0)
    assert upper.vertices[upper.faces, 1].min() >= 20 - 1e-9
    np.testing.assert_allclose(
        upper.area(), 2 * np.pi * 50 * 30, rtol=3e-3
    )  # Archimedes; the mesh has 5120 faces


def test_a_jagged_border_leaves_no_specks():
    """What lies across a notch of the border belongs to no mirror image: no cell is cut there."""
    x, y = np.meshgrid(np.linspace(0, 20, 81), np.linspace(0, 20, 20))
    y[0, 1::2] -= 0.5
    places = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    number = np.arange(len(places)).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, d), (a, d, c))])
    splats = sample_mesh(Mesh(places, faces, np.tile([0.0, 0.0, 1.0], (len(places), 1))), COUNT)
    spacing = (400 / COUNT) ** 0.5
    assert float(splats.areas.min()) > 0.35 * spacing**2
    radii = np.asarray(splats.radii)
    assert radii.min() > 0.9 * spacing
    assert radii.max() < 1.6 * np.median(radii)  # nor clumps


def test_textures_land_where_their_coordinates_say():
    """Row 0 of the picture is at the top, v = 1; bilinear lookup gives back a picture that is
    linear in x and y.
    """
    rows, columns = (np.indices((32, 32)) + 0.5) / 32
    picture = np.stack([columns, 1 - rows, np.full_like(rows, 0.25)], axis=-1)
    textures = Textures(albedo=picture, specular=columns, roughness=rows)
    splats = sample_mesh(square(), 500, textures=textures)
    xy = np.asarray(splats.centers)[:, :2] / 10
    inner = (np.abs(xy - 0.5) < 0.48).all(axis=1)
    found = np.column_stack([splats.albedo[:, :2], splats.specular, splats.roughness])
    expected = np.column_stack([xy, xy[:, 0], 1 - xy[:, 1]])
    np.testing.assert_allclose(found[inner], expected[inner], atol=1e-5)


@pytest.mark.parametrize("side", [1, -1])
def test_normal_map_tilts_along_u_and_v_mirrored_or_not(side):
    mesh = dataclasses.replace(square(), uvs=square().uvs * [side, 1])
    for tilt, expected in (([0.6, 0, 0.8], [0.6 * side, 0, 0.8]), ([0, 0.6, 0.8],) * 2):
        textures = Textures(normal=np.tile(tilt, (2, 2, 1)))
        normals = sample_mesh(mesh, 20, textures=textures).normals
        np.testing.assert_allclose(normals, np.tile(expected, (20, 1)), atol=1e-6)


@pytest.mark.parametrize(
    ("mesh", "count", "textures", "message"),
    [
        (sphere(), 0, Textures(), "count is 0"),
        (FLAT, 10, Textures(), "no area"),
        (sphere(), 10, Textures(albedo=np.ones((2, 2, 3))), "no texture coordinates"),
    ],
)
def test_what_cannot_be_sampled_is_refused(mesh, count, textures, message):
    assert_refused(lambda: sample_mesh(mesh, count, textures=textures), message)


def test_a_rounded_sphere_is_round_to_fourth_order():
    """In the length of its edges; what flat triangles are off by is of second."""
    off = []
    for mesh in (sphere(subdivisions=2), sphere(subdivisions=3)):
        shares = np.random.default_rng(0).dirichlet(np.ones(3), 20 * len(mesh.faces))
        points = SurfacePoints(np.repeat(np.arange(len(mesh.faces)), 20), shares)
        places = Rounding(mesh).positions(points), points.positions(mesh)
        off.append(np.max(np.abs(np.linalg.norm(places, axis=2) - 50), axis=1))
    (coarse, flat), (fine, _) = off
    assert coarse < 0.03 * flat
    assert fine < coarse / 14
    np.testing.assert_allclose(Rounding(sphere()).area(), 4 * np.pi * 50**2, rtol=1e-4)


def test_what_triangles_share_stays_or_moves_for_all_of_them():
    vertices = sphere().vertices * [1.0, 0.6, 1.4]
    mesh = Mesh(vertices, sphere().faces, vertex_normals(vertices, sphere().faces))
    every = np.arange(len(mesh.faces))
    found = {}
    for shares in itertools.permutations([0.3, 0.7, 0.0]):
        points = SurfacePoints(every, np.broadcast_to(shares, (len(every), 3)))
        for at, plain in zip(Rounding(mesh).positions(points), points.positions(mesh), strict=True):
            np.testing.assert_allclose(found.setdefault(tuple(plain.round(6)), at), at, atol=1e-9)
    assert len(found) == len(every) * 3  # two points on each edge, and two triangles
    corners = SurfacePoints(every, np.broadcast_to([1.0, 0, 0], (len(every), 3)))
    np.testing.assert_allclose(
        Rounding(mesh).positions(corners), corners.positions(mesh), atol=1e-12
    )


def test_creases_split_normals_where_triangles_differ():
    """A wedge of two squares: one normal for each side beyond the angle, else their mean; normals
    that are given stay where they are near their triangles.
    """
    fold = np.radians(50)
    places = np.asarray([[0, 0, 0], [0, 1, 0], [1, 0, 0], [-np.cos(fold), 0, -np.sin(fold)]])
    faces = np.asarray([[0, 2, 1], [0, 1, 3]])
    sides = np.asarray([[0, 0, 1.0], [-np.sin(fold), 0, np.cos(fold)]])
    mesh = Mesh(places, faces, np.zeros((4, 3)))
    hard, soft = (split_creases(mesh, angle) for angle in (49.0, 51.0))
    np.testing.assert_allclose(
        hard.normals[hard.faces], np.repeat(sides[:, None], 3, axis=1), atol=1e-12
    )
    assert (len(hard.vertices), len(soft.vertices)) == (6, 4)
    middle = sides.sum(axis=0) / np.linalg.norm(sides.sum(axis=0))
    np.testing.assert_allclose(soft.normals[soft.faces[0, 0]], middle, atol=1e-12)
    given = Mesh(places, faces, np.tile(middle, (4, 1)), colors=np.eye(4)[:, :3])
    np.testing.assert_array_equal(split_creases(given, 26.0).normals, given.normals)
    split = split_creases(given, 24.0)
    np.testing.assert_allclose(split.normals[split.faces], hard.normals[hard.faces], atol=1e-12)
    np.testing.assert_array_equal(split.colors[split.faces], given.colors[faces])


def test_rounded_splats_cover_the_rounded_surface():
    splats = sample_mesh(sphere(subdivisions=2), COUNT, rounded=True)
    np.testing.assert_allclose(np.linalg.norm(splats.centers, axis=1), 50, rtol=5e-4)
    cosines = np.sum(unit(splats.centers) * np.asarray(splats.normals), axis=1)
    assert np.min(cosines) > np.cos(np.radians(0.5))
    np.testing.assert_allclose(float(splats.areas.sum()), 4 * np.pi * 50**2, rtol=1e-3)


def test_the_bust_is_closed_faces_outward_and_is_life_size():
    """Every edge belongs to two triangles, which run along it in opposite directions; Euler's
    number is that of one body without a hole; and texture coordinates cover the unit square once.
    """
    mesh = bust_mesh()
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    assert body.is_volume  # closed, with consistent winding, outward
    assert body.euler_number == 2
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    np.testing.assert_allclose((high - low)[0], 230, atol=25)
    np.testing.assert_allclose(low[0], -high[0], atol=0.3)  # alike on both sides, but for the grid
    assert 110 < high[1] < 120
    head = mesh.vertices[mesh.vertices[:, 1] > 30]
    np.testing.assert_allclose(np.ptp(head[:, 0]), 155, atol=8)
    np.testing.assert_allclose(np.ptp(head[:, 2]), 190, atol=12)
    normals, areas = mesh.normals[mesh.faces].mean(axis=1), mesh.face_areas()
    inward = np.sum(body.triangles_cross * normals, axis=1) < 0
    assert areas[inward].sum() < 2e-3 * areas.sum()  # in the folds of lids and nostrils
    assert mesh.uvs.min() >= 0
    assert mesh.uvs[..., 1].max() <= 1
    across = np.ptp(mesh.uvs[..., 0], axis=1) > 0.5  # those around the poles
    assert across.sum() <= 20
    signed_areas = np.linalg.det(mesh.uvs[:, 1:] - mesh.uvs[:, :1]) / 2
    np.testing.assert_allclose(signed_areas.sum(), 1, rtol=0.02)


def test_splats_of_the_bust(dtype):
    splats = bust(5000)
    assert (splats.count, splats.centers.dtype) == (5000, dtype)
    np.testing.assert_allclose(float(splats.areas.sum()), 213_000, rtol=0.05)
    assert 0 < float(splats.albedo.min()) < float(splats.albedo.max()) < 1
