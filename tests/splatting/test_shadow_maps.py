"""Shadow maps: a disc above a plane, a sphere that must not shadow itself, and the gradient of a soft edge."""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting import (
    Bounds,
    DenseRasterizer,
    ShadowSettings,
    SplattingSettings,
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
    """Every splat whose cosine to the light is above 0.2 is lit; the discs' own curvature is a quarter of the bias."""
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
            return jnp.dot(shares(distant_view(direction, bounds, SETTINGS), moved, tiles)[:floor], weights)

        gradient, step = np.asarray(total(start)[1]).reshape(-1), 1e-6
        steps = step * jnp.eye(6).reshape(6, 2, 3)
        differences = np.asarray([float(total(start + d)[0] - total(start - d)[0]) / (2 * step) for d in steps])
    scale = np.max(np.abs(differences))
    assert scale > 0.1
    np.testing.assert_allclose(gradient, differences, atol=1e-5 * scale)
