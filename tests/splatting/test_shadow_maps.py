"""Shadow maps: a disc above a plane, a sphere that must not shadow itself, and the gradient of a
soft edge.
"""

import dataclasses

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from splatjax._combination import DeviceMesh
from splatjax.scene import Splats
from splatjax.splatting import (
    TILE_SIDE,
    Bounds,
    OrthographicView,
    ShadowMap,
    ShadowSettings,
    SplattingSettings,
    TileRasterizer,
    compute_visibility,
    cube_views,
    distant_view,
    in_cube_face,
    make_shadow_map,
    merge_splats,
    near_view,
)

SPLATTING = SplattingSettings()
SETTINGS = ShadowSettings(resolution=64)
HEIGHT, RADIUS, HALF = 12.0, 4.0, 14.0
LIGHTS = {
    "distant": lambda bounds: distant_view(jnp.asarray([0.3, 0.1, -1.0]), bounds, SETTINGS),
    "near": lambda bounds: near_view(jnp.asarray([-18.0, -6.0, 60.0]), bounds, SETTINGS),
}


def scene():
    floor = bodies.sheet(HALF, 1.0)
    disc = bodies.sheet(RADIUS, 0.5, center=(0.0, 0.0, HEIGHT))
    within = np.hypot(*np.asarray(disc.centers)[:, :2].T) <= RADIUS
    disc = jax.tree.map(lambda leaf: leaf[within], disc)
    return bodies.joined(floor, disc), floor.count


def bounds_of(body) -> Bounds:
    return Bounds.of(body, DeviceMesh())


def plan_for(view, body, rasterizer=TileRasterizer(lanes=8, slots=16)):
    return rasterizer.make_plan([body], [view], SPLATTING)


@eqx.filter_jit
def visibility(body, view, plan, settings=SETTINGS):
    """Compute how much of the light each splat gets; NaN where the plan's capacity is exceeded."""
    shadow_map = make_shadow_map(body, view, SPLATTING, plan, DeviceMesh())
    return compute_visibility(body, shadow_map, settings)


def test_the_sphere_around_all_discs_reaches_two_pixels_from_the_edge():
    body, _ = scene()
    bounds, centers = bounds_of(body), np.asarray(body.centers, float)
    middle = 0.5 * (centers.min(axis=0) + centers.max(axis=0))
    np.testing.assert_allclose(bounds.center, middle, atol=1e-5)
    reach = np.linalg.norm(centers - middle, axis=1).max() + float(body.radii.max())
    np.testing.assert_allclose(bounds.radius, reach, rtol=1e-5)
    on_sphere = bounds.center[:, None] + bounds.radius * jnp.asarray(bodies.directions(20_000).T)
    for view in LIGHTS.values():
        x, y, _ = view(bounds).project(jnp.asarray(on_sphere, float))
        ends = [[float(each.min()), float(each.max())] for each in (x, y)]
        np.testing.assert_allclose(ends, [[2, SETTINGS.resolution - 2]] * 2, atol=0.05)
    nothing, one = (
        bounds_of(dataclasses.replace(body, radii=body.radii.at[n:].set(0.0))) for n in (0, 1)
    )
    np.testing.assert_array_equal([*nothing.center, nothing.radius], [0, 0, 0, 1])
    np.testing.assert_allclose(one.radius, body.radii[0], rtol=1e-6)


def test_every_point_belongs_to_one_face_of_the_cube():
    eye, points = jnp.asarray([0.3, -0.2, 0.1]), jnp.asarray(bodies.directions(500).T, float)
    views, half = cube_views(eye, SETTINGS), SETTINGS.resolution / 2
    belongs = np.asarray([in_cube_face(view, points) for view in views])
    assert np.all(belongs.sum(axis=0) == 1)
    for view, own in zip(views, belongs, strict=True):
        x, y, depth = (np.asarray(each) for each in view.project(points))
        # Its face ends two pixels from the map's edge.
        beyond = np.maximum(np.abs(x - half), np.abs(y - half)) - (half - 2)
        inside = (beyond < 0) & (depth > 2 * view.near)
        assert np.all((own == inside) | (np.abs(beyond) < 1e-3))
    between = eye[:, None] + jnp.asarray([[2.0, -3, 1], [2, 3, -1], [1, 3, 1]])
    shares = np.asarray([in_cube_face(view, between) for view in views])
    np.testing.assert_allclose(shares.sum(axis=0), 1, rtol=1e-6)
    np.testing.assert_allclose(np.max(shares, axis=0), [1 / 2, 1 / 3, 1 / 3], rtol=1e-6)


def smooth_step(t):
    t = np.clip(t, 0, 1)
    return 3 * t**2 - 2 * t**3


def test_each_surface_blocks_what_reaches_it():
    """Level splats behind two level surfaces, of which each covers a part: the closed form, and
    less of it beyond the edge.
    """
    size, front, behind, covers, covers_behind = 32, 3.0, 4.5, 0.6, 0.25
    settings = ShadowSettings(resolution=size, bias=0.5, softness=1.0)
    reach = np.hypot(0.1, 2**0.5 * 0.5)  # a radius, and the diagonal of a pixel
    view = OrthographicView(jnp.zeros(3), jnp.eye(3), jnp.asarray(2.0), size, size)
    planes = jnp.asarray([front, covers, behind, covers_behind])[:, None, None]
    planes = jnp.broadcast_to(planes, (4, (size // TILE_SIDE) ** 2, TILE_SIDE**2))
    grid = np.meshgrid(np.linspace(-1.7, 34.2, 38), np.linspace(2.9, 6.1, 33))
    column, depth = np.reshape(grid, (2, -1))
    row = np.linspace(-0.4, 31.9, column.size)[::-1]
    centers = np.stack([(column - size / 2) / 2, (row - size / 2) / 2, depth], axis=1)
    body = bodies.splats(centers, np.tile([0.0, 0.0, -1.0], (len(depth), 1)), 0.1)
    blocked = covers * smooth_step((depth - front) / reach - 0.5)
    blocked += (1 - covers) * covers_behind * smooth_step((depth - behind) / reach - 0.5)

    def share_inside(place):
        """Of a quadratic spline around a place, what lies on the map: the integral of a hat of one
        pixel.
        """
        middle = np.floor(place) + np.arange(-1, 2)[:, None]
        away = np.abs(middle + 0.5 - place)
        weights = np.where(away < 0.5, 0.75 - away**2, 0.5 * np.clip(1.5 - away, 0, None) ** 2)
        return (weights * ((middle >= 0) & (middle < size))).sum(axis=0)

    expected = 1 - blocked * share_inside(column) * share_inside(row)
    assert expected.min() < 0.4
    shadow_map = ShadowMap(view, planes, jnp.zeros(()))
    found = eqx.filter_jit(compute_visibility)(body, shadow_map, settings)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.once
@pytest.mark.parametrize("kind", ["distant", "near"])
def test_umbra_is_dark_and_the_rest_is_lit(kind):
    body, floor = scene()
    view = LIGHTS[kind](bounds_of(body))
    visible = np.asarray(visibility(body, view, plan_for(view, body)))
    middle, radius = np.asarray([0.3, 0.1]) * HEIGHT, RADIUS
    if kind == "near":
        eye = np.asarray(view.position, float)
        stretch = eye[2] / (eye[2] - HEIGHT)
        middle, radius = eye[:2] * (1 - stretch), RADIUS * stretch
    pixel = 2 * float(bounds_of(body).radius) / 60
    away = np.hypot(*(np.asarray(body.centers, float)[:floor, :2] - middle).T)
    umbra, outside = away < radius - 2.5 * pixel, away > radius + 0.75 + 3 * pixel
    assert umbra.sum() > 5
    assert outside.sum() > 300
    assert np.max(visible[:floor][umbra]) < 1e-6
    assert np.min(visible[:floor][outside]) > 1 - 1e-6
    assert np.min(visible[floor:]) > 1 - 1e-6, "the disc shadows itself"


@pytest.mark.once
def test_the_shadow_of_an_open_edge_ends_within_half_a_spacing():
    spacing, height = 0.25, 5.0
    blocker = bodies.sheet(3.0, spacing, center=(-3.0 - spacing / 2, 0.0, height))  # to x = 0
    line = np.linspace(-2, 2, 161)
    floor = np.stack(np.meshgrid(line, np.arange(-2.0, 2.0, 0.2), 0.0), axis=-1).reshape(-1, 3)
    floor = bodies.splats(floor, np.tile([0.0, 0.0, 1.0], (len(floor), 1)), 1.5 * spacing)
    body, settings = bodies.joined(blocker, floor), ShadowSettings(resolution=256)
    view = distant_view(jnp.asarray([0.0, 0.0, -1.0]), bounds_of(body), settings)
    visible = visibility(body, view, plan_for(view, body), settings)[blocker.count :]
    edge = 2 - np.trapezoid(np.mean(np.reshape(visible, (-1, len(line))), axis=0), line)
    assert 0 < edge < 0.5 * spacing  # 0.6 if discs block light as they cover pixels


@pytest.mark.once
@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
def test_a_map_no_finer_than_its_splats_shows_the_whole_shadow(scale):
    body, floor = scene()
    body, blocked = body.scaled(scale), {}
    for settings in (ShadowSettings(), ShadowSettings(pixels_per_spacing=np.inf)):
        settings = settings.for_spacing(scale, bounds_of(body))
        view = distant_view(jnp.asarray([0.28, 0.05, -1.0]), bounds_of(body), settings)
        visible = visibility(body, view, plan_for(view, body), settings)[:floor]
        shadow = np.sum((1 - np.asarray(visible, float)) * np.asarray(body.areas[:floor], float))
        blocked[int(settings.side)] = shadow / scale**2
    assert list(blocked) == [192, 1024]
    # The disc's shadow extends by half a spacing of its splats.
    expected = np.pi * (RADIUS + 0.25) ** 2
    np.testing.assert_allclose(list(blocked.values()), expected, rtol=0.015)


@pytest.mark.once
@pytest.mark.parametrize("kind", [*LIGHTS, "cube"])
def test_a_sphere_does_not_shadow_itself(kind):
    """Every splat whose cosine to the light is above 0.02 is lit."""
    body, toward = bodies.sphere(1500, 10.0), jnp.asarray([0.6, 0.3, 0.742])
    if kind == "cube":  # a point amid splats that face it
        body, toward = (
            dataclasses.replace(body, normals=-body.normals),
            jnp.asarray([0.8, -0.6, 0.4]),
        )
        views = cube_views(toward, SETTINGS)
    elif kind == "near":
        toward = 80 * toward
        views = [near_view(toward, bounds_of(body), SETTINGS)]
    else:
        views = [distant_view(-toward, bounds_of(body), SETTINGS)]
    plan = TileRasterizer(lanes=8, slots=16).make_plan([body], views, SPLATTING)
    visible = sum(
        np.asarray(visibility(body, view, plan))
        * np.asarray(kind != "cube" or in_cube_face(view, body.centers.T))
        for view in views
    )
    wi = bodies.unit(np.asarray(toward) - (0 if kind == "distant" else np.asarray(body.centers)))
    cosine = np.sum(wi * np.asarray(body.normals, float), axis=1)
    assert np.min(visible[cosine > 0.02]) > 0.99  # with a bias along the light, only above 0.2
    assert kind == "cube" or np.max(visible[cosine < -0.3]) < 0.01


@pytest.mark.once
def test_light_that_grazes_a_smooth_body_leaves_no_terraces():
    """A splat's depth is followed along its plane where the map's pixels are as wide as the light
    is deep: to a cosine of 1/8.
    """
    body, toward = bodies.sphere(20_000, 40.0), np.asarray([0.6, 0.3, 0.742])
    settings = ShadowSettings(resolution=128)
    view = distant_view(-jnp.asarray(toward), bounds_of(body), settings)
    visible = np.asarray(visibility(body, view, plan_for(view, body, TileRasterizer()), settings))
    cosine = np.asarray(body.normals, float) @ toward
    grazed = (cosine > 0.13) & (cosine < 0.2)
    assert np.mean(visible[grazed]) > 0.99  # 0.97 if the plane is followed to 1/4
    assert np.min(visible[cosine > 0.2]) > 0.999


def test_edge_has_the_gradient_of_central_differences(float64):
    """In the direction of the light, and in where the occluder stands."""
    body, floor = scene()
    bounds, weights = bounds_of(body), np.random.default_rng(3).normal(size=floor)
    start = jnp.asarray([0.3, 0.1, -1.0]), jnp.asarray([0.05, -0.03, 0.2])
    plan = plan_for(distant_view(start[0], bounds, SETTINGS), body)

    @jax.jit
    def total(direction, shift):
        moved = dataclasses.replace(body, centers=body.centers.at[floor:].add(shift[None]))
        view = distant_view(direction, bounds, SETTINGS)
        return jnp.vdot(visibility(moved, view, plan)[:floor], weights)

    check_grads(total, start, 1, ["rev"], atol=1e-5, rtol=1e-5, eps=1e-6)


def test_merged_splats_have_the_area_of_each_side():
    """Two sides of a thin sheet, in one group or another: no disc lies between them."""
    upper = bodies.sheet(3.9, 0.5, center=(0.0, 0.0, 0.1))
    lower = bodies.sheet(3.9, 0.5, normal=(0.0, 0.0, -1.0), center=(0.0, 0.0, -0.1))
    order = np.random.default_rng(0).permutation(2 * upper.count)
    body = jax.tree.map(lambda leaf: leaf[order], bodies.joined(upper, lower))
    discs = merge_splats(body, 8)
    up = np.asarray(discs.normals)[:, 2]
    np.testing.assert_allclose(np.asarray(discs.centers)[:, 2], 0.1 * up, atol=1e-6)
    np.testing.assert_array_equal(np.abs(up), discs.radii > 0)
    for side, own in ((upper, up > 0), (lower, up < 0)):
        for total in (lambda s: s.areas, lambda s: s.radii**2):
            whole = np.sum(np.asarray(total(discs), float)[own])
            np.testing.assert_allclose(whole, np.sum(total(side)), rtol=1e-5)


def test_merged_splats_are_differentiable(float64):
    body = bodies.bumpy(32)
    exists = jnp.asarray(np.arange(32) // 8 != 1, float)  # a group without any

    def sums(centers, normals, radii, areas):
        discs = merge_splats(Splats(centers, normals, exists * radii, exists * areas), 8)
        return discs.centers, discs.normals, discs.radii, discs.areas

    check_grads(jax.jit(sums), (body.centers, body.normals, body.radii, body.areas), 1)
