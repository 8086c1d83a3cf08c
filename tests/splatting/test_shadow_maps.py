"""Shadow maps: a disc above a plane, a sphere that must not shadow itself, and the gradient of a
soft edge.
"""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting import (
    SIDE,
    Bounds,
    DenseRasterizer,
    OrthographicView,
    ShadowSettings,
    SplattingSettings,
    Surface,
    Surfaces,
    TileRasterizer,
    cube_views,
    distant_view,
    in_cube_face,
    light_surfaces,
    lit_share,
    near_view,
)

SPLATTING = SplattingSettings()
SETTINGS = ShadowSettings(resolution=64)
HEIGHT, RADIUS, HALF = 12.0, 4.0, 14.0


def scene():
    """A floor that faces up, and a disc of small splats above it."""
    floor = bodies.sheet(HALF, 1.0)
    disc = bodies.sheet(RADIUS, 0.5, center=(0.0, 0.0, HEIGHT))
    within = np.hypot(*np.asarray(disc.centers)[:, :2].T) <= RADIUS
    disc = jax.tree.map(lambda leaf: leaf[within], disc)
    return bodies.joined(floor, disc), floor.count


def shares(view, body, rasterizer):
    return lit_share(body, view, light_surfaces(body, view, SPLATTING, rasterizer), SETTINGS)


def tiles_for(view, body):
    return TileRasterizer(lanes=8, slots=16).planned(body, [view], SPLATTING)


LIGHTS = {
    "distant": lambda bounds: distant_view(jnp.asarray([0.3, 0.1, -1.0]), bounds, SETTINGS),
    "near": lambda bounds: near_view(jnp.asarray([-18.0, -6.0, 60.0]), bounds, SETTINGS),
}


@pytest.mark.parametrize("kind", LIGHTS)
def test_the_sphere_around_all_discs_reaches_two_pixels_from_the_edge(kind):
    body, _ = scene()
    bounds = Bounds.of(body)
    centers, radii = np.asarray(body.centers, float), np.asarray(body.radii, float)
    np.testing.assert_allclose(
        bounds.center, 0.5 * (centers.min(axis=0) + centers.max(axis=0)), atol=1e-5
    )
    reach = np.linalg.norm(centers - np.asarray(bounds.center), axis=1)
    np.testing.assert_allclose(bounds.radius, reach.max() + radii.max(), rtol=1e-5)
    on_sphere = (
        np.asarray(bounds.center)[:, None] + float(bounds.radius) * bodies.directions(20_000).T
    )
    x, y, _ = LIGHTS[kind](bounds).project(jnp.asarray(on_sphere, float))
    for each in (x, y):
        np.testing.assert_allclose(
            [float(each.min()), float(each.max())], [2, SETTINGS.resolution - 2], atol=0.05
        )
    nothing = Bounds.of(jax.tree.map(lambda leaf: leaf[:0], body))
    np.testing.assert_array_equal(np.append(nothing.center, nothing.radius), [0, 0, 0, 1])
    np.testing.assert_allclose(
        Bounds.of(jax.tree.map(lambda leaf: leaf[:1], body)).radius, radii[0], rtol=1e-6
    )


def test_every_point_belongs_to_one_face_of_the_cube():
    eye, points = jnp.asarray([0.3, -0.2, 0.1]), jnp.asarray(bodies.directions(500).T, float)
    assert np.all(
        sum(np.asarray(in_cube_face(view, points)) for view in cube_views(eye, SETTINGS)) == 1
    )
    for view in cube_views(eye, SETTINGS):
        x, y, depth = (np.asarray(each) for each in view.project(points))
        off = np.maximum(np.abs(x - SETTINGS.resolution / 2), np.abs(y - SETTINGS.resolution / 2))
        inside, known = (
            (off < 30) & (depth > 2 * view.near),
            np.abs(off - 30) > 1e-3,
        )  # two pixels from the edge
        np.testing.assert_array_equal(
            np.asarray(in_cube_face(view, points))[known] == 1, inside[known]
        )


def smooth_step(t):
    t = np.clip(t, 0, 1)
    return 3 * t**2 - 2 * t**3


def test_each_surface_holds_up_what_reaches_it():
    """Level splats behind two level surfaces, of which each covers a part: the closed form, and
    less of it beyond the edge.
    """
    size, front, behind, covers, covers_behind = 32, 3.0, 4.5, 0.6, 0.25
    settings = ShadowSettings(resolution=size, bias=0.4, softness=0.8)
    view = OrthographicView(
        jnp.zeros(3), jnp.diag(jnp.asarray([1.0, 1.0, 1.0])), jnp.asarray(2.0), size, size
    )
    tiles = (size // SIDE) ** 2, SIDE**2

    def surface(depth, coverage):
        none = jnp.zeros((tiles[0], 0, tiles[1]))
        return Surface(
            none, jnp.full(tiles, depth), jnp.full(tiles, coverage), jnp.full(tiles, coverage)
        )

    surfaces = Surfaces(surface(front, covers), surface(behind, covers_behind), jnp.zeros(()))
    column, depth = (
        each.reshape(-1)
        for each in np.meshgrid(np.linspace(-1.7, 34.2, 38), np.linspace(2.9, 6.1, 33))
    )
    row = np.linspace(-0.4, 31.9, column.size)[::-1]
    centers = np.stack([(column - size / 2) / 2, (row - size / 2) / 2, depth], axis=1)
    body = bodies.splats(centers, np.tile([0.0, 0.0, -1.0], (len(depth), 1)), 0.1)
    held = covers * smooth_step((depth - front - 0.4) / 0.8)
    held += (1 - covers) * covers_behind * smooth_step((depth - behind - 0.4) / 0.8)

    def share_inside(place):
        """Of a quadratic spline around a place, what lies on the map: the integral of a hat of one
        pixel.
        """
        middle = np.floor(place) + np.arange(-1, 2)[:, None]
        away = np.abs(middle + 0.5 - place)
        weights = np.where(away < 0.5, 0.75 - away**2, 0.5 * np.clip(1.5 - away, 0, None) ** 2)
        np.testing.assert_allclose(weights.sum(axis=0), 1)
        return (weights * ((middle >= 0) & (middle < size))).sum(axis=0)

    expected = 1 - held * share_inside(column) * share_inside(row)
    assert expected.min() < 0.4
    np.testing.assert_allclose(
        jax.jit(lit_share)(body, view, surfaces, settings), expected, atol=1e-5
    )


@pytest.mark.once
@pytest.mark.parametrize("kind", LIGHTS)
def test_umbra_is_dark_and_the_rest_is_lit(kind):
    body, floor = scene()
    view = LIGHTS[kind](Bounds.of(body))
    tiles = tiles_for(view, body)
    lit = np.asarray(jax.jit(lambda s: shares(view, s, tiles))(body))
    if kind == "distant":
        middle, radius = np.asarray([0.3, 0.1]) * HEIGHT, RADIUS
    else:
        eye = np.asarray(view.position, float)
        stretch = eye[2] / (eye[2] - HEIGHT)
        middle, radius = eye[:2] * (1 - stretch), RADIUS * stretch
    pixel = 2 * float(Bounds.of(body).radius) / 60
    away = np.hypot(*(np.asarray(body.centers, float)[:floor, :2] - middle).T)
    umbra, lit_floor = away < radius - 2.5 * pixel, away > radius + 0.75 + 3 * pixel
    assert umbra.sum() > 5
    assert lit_floor.sum() > 300
    assert np.max(lit[:floor][umbra]) < 1e-6
    assert np.min(lit[:floor][lit_floor]) > 1 - 1e-6
    assert np.min(lit[floor:]) > 1 - 1e-6, "the disc shadows itself"


@pytest.mark.parametrize("kind", ["distant", "near", "cube"])
def test_a_sphere_does_not_shadow_itself(kind):
    """Every splat whose cosine to the light is above 0.2 is lit; the discs' own curvature is a
    quarter of the bias.
    """
    body = bodies.sphere(1500, 10.0)
    bounds = Bounds.of(body)
    toward = jnp.asarray([0.6, 0.3, 0.742])
    if kind == "cube":  # a point amid splats that face it
        body = eqx.tree_at(lambda s: s.normals, body, -body.normals)
        toward = jnp.asarray([0.8, -0.6, 0.4])
        views = cube_views(toward, SETTINGS)
    elif kind == "near":
        toward = 80 * toward
        views = [near_view(toward, bounds, SETTINGS)]
    else:
        views = [distant_view(-toward, bounds, SETTINGS)]

    @jax.jit
    def lit_by(body, view):
        lit = shares(view, body, DenseRasterizer())
        return lit * in_cube_face(view, body.centers.T) if kind == "cube" else lit

    wi = np.asarray(toward, float) - (0 if kind == "distant" else np.asarray(body.centers, float))
    wi = np.broadcast_to(wi / np.linalg.norm(wi, axis=-1, keepdims=True), body.centers.shape)
    cosine = np.sum(wi * np.asarray(body.normals, float), axis=1)
    lit = sum(np.asarray(lit_by(body, view)) for view in views)
    assert np.min(lit[cosine > 0.2]) > 0.99
    if kind != "cube":
        assert np.max(lit[cosine < -0.3]) < 0.01


@pytest.mark.once
@pytest.mark.once
def test_light_that_grazes_a_smooth_body_leaves_no_terraces():
    """A splat's depth is followed along its plane where the map's pixels are as wide as the light
    is deep: to a cosine of 1/8.
    """
    body, toward = bodies.sphere(20_000, 40.0), np.asarray([0.6, 0.3, 0.742])
    settings = ShadowSettings(resolution=128)
    view = distant_view(-jnp.asarray(toward), Bounds.of(body), settings)
    rasterizer = TileRasterizer().planned(body, [view], SPLATTING)
    lit = np.asarray(
        lit_share(body, view, light_surfaces(body, view, SPLATTING, rasterizer), settings)
    )
    cosine = np.asarray(body.normals, float) @ toward
    assert np.mean(lit[(cosine > 0.13) & (cosine < 0.2)]) > 0.99  # 0.97 if it is followed to 1/4
    assert np.min(lit[cosine > 0.2]) > 0.999


def test_edge_has_the_gradient_of_central_differences():
    """In the direction of the light, and in where the occluder stands."""
    with jax.enable_x64(True):
        body, floor = scene()
        bounds = Bounds.of(body)
        weights = jnp.asarray(np.random.default_rng(3).normal(size=floor))
        start = jnp.asarray([[0.3, 0.1, -1.0], [0.05, -0.03, 0.2]])
        tiles = tiles_for(distant_view(start[0], bounds, SETTINGS), body)

        @jax.jit
        @jax.value_and_grad
        def total(parameters):
            direction, shift = parameters
            centers = jnp.concatenate([body.centers[:floor], body.centers[floor:] + shift[None]])
            moved = eqx.tree_at(lambda s: s.centers, body, centers)
            return jnp.dot(
                shares(distant_view(direction, bounds, SETTINGS), moved, tiles)[:floor], weights
            )

        gradient, step = np.asarray(total(start)[1]).reshape(-1), 1e-6
        steps = step * jnp.eye(6).reshape(6, 2, 3)
        differences = np.asarray(
            [float(total(start + d)[0] - total(start - d)[0]) / (2 * step) for d in steps]
        )
    scale = np.max(np.abs(differences))
    assert scale > 0.1
    np.testing.assert_allclose(gradient, differences, atol=1e-5 * scale)
