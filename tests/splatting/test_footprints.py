"""Footprints against rays cut with planes, their boxes, and the law of the screen filter."""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting import SplattingSettings, fragment_weight

NO_FILTER = SplattingSettings(filter_radius=1e-4)
FINE = {
    "width": 40_000,
    "height": 32_000,
}  # the quarter pixel that keeps slopes finite is nothing here
AGREEMENT = {
    "float64": 2e-5,
    "float32": 2e-3,
}  # x64: that quarter pixel; float32: slanted discs cancel by tan^2
POWER_ERROR = 0.045  # of a filter of radius root 2 on the pixels' grid

VIEWS = {"perspective": bodies.perspective, "orthographic": bodies.orthographic}
FINE_VIEWS = {
    "perspective": lambda: bodies.perspective(**FINE),
    "orthographic": lambda: bodies.orthographic(scale=1200.0, **FINE),
}


def scattered(count=60, seed=3):
    """Splats in all places and attitudes, large ones too."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3)) + np.asarray([0, 0, 1.2])
    return bodies.splats(rng.uniform(-9, 9, (count, 3)), normals, rng.uniform(0.5, 5.0, count))


def offsets(footprints, reach=1.25, steps=17):
    """Pixels in and around every box, `[splats, samples]`."""
    grid = np.linspace(-reach, reach, steps)
    u, v = (each.reshape(1, -1) for each in np.meshgrid(grid, grid))
    left, right, top, bottom = (np.asarray(each)[:, None] for each in _box(footprints))
    return 0.5 * (left + right) + 0.5 * (right - left) * u, 0.5 * (top + bottom) + 0.5 * (
        bottom - top
    ) * v


def _box(footprints):
    return footprints.left, footprints.right, footprints.top, footprints.bottom


@eqx.filter_jit
def fragments(footprints, view, x, y):
    """Give which are inside the rim, rho^2 and depth at pixels `[splats, samples]`."""
    f = jax.tree.map(lambda leaf: leaf[:, None], footprints)
    dx, dy = x - f.x, y - f.y
    nearness = f.nearness + f.slope_x * dx + f.slope_y * dy
    quadric = f.a * dx * dx + f.b * dx * dy + f.c * dy * dy
    return (
        view.inside(nearness, quadric),
        view.squared_radius(nearness, quadric),
        view.depth(nearness),
    )


def rays(view, x, y):
    """Give where rays through pixels start, and where they go; float64."""
    rotation, position = np.asarray(view.rotation, float), np.asarray(view.position, float)
    x, y = np.asarray(x, float) - view.width / 2, np.asarray(y, float) - view.height / 2
    if hasattr(view, "focal_length"):
        f = float(view.focal_length)
        along = np.stack([x / f, y / f, np.ones_like(x)], -1) @ rotation
        return np.broadcast_to(position, along.shape), along
    start = position + np.stack([x, y, np.zeros_like(x)], -1) / float(view.scale) @ rotation
    return start, np.broadcast_to(rotation[2], start.shape)


@pytest.mark.parametrize("kind", VIEWS)
def test_fragments_are_where_rays_meet_discs(kind, dtype):
    view, body = FINE_VIEWS[kind](), scattered()
    footprints = jax.jit(lambda s: view.footprints(s, NO_FILTER))(body)
    x, y = offsets(footprints)
    _, squared_radius, depth = fragments(
        footprints, view, jnp.asarray(x, dtype), jnp.asarray(y, dtype)
    )
    start, along = rays(view, x, y)
    centers, normals = (np.asarray(each, float)[:, None] for each in (body.centers, body.normals))
    t = np.sum((centers - start) * normals, -1) / np.sum(along * normals, -1)
    hit = start + t[..., None] * along
    expected = np.sum((hit - centers) ** 2, -1) / np.asarray(body.radii, float)[:, None] ** 2
    facing = -np.sum(along * normals, -1) / np.linalg.norm(along, axis=-1)
    chosen = np.asarray(footprints.visible)[:, None] & (facing > 0.15) & (expected < 2) & (t > 1)
    assert np.mean(chosen) > 0.2
    tolerance = AGREEMENT[str(dtype)]
    np.testing.assert_allclose(
        np.asarray(squared_radius)[chosen], expected[chosen], rtol=tolerance, atol=tolerance
    )
    forward = (hit - np.asarray(view.position, float)) @ np.asarray(view.rotation, float)[2]
    np.testing.assert_allclose(
        np.asarray(depth)[chosen], forward[chosen], rtol=tolerance, atol=tolerance
    )


@pytest.mark.parametrize("kind", VIEWS)
def test_boxes_hold_the_rim_exactly(kind, dtype):
    view, body = FINE_VIEWS[kind](), scattered()
    footprints = jax.jit(lambda s: view.footprints(s, NO_FILTER))(body)
    normals = np.asarray(body.normals, float)
    a = np.cross(normals, [[0.3, 1.0, 0.2]])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, 1441)[None, :, None]
    rim = np.cos(angle) * a[:, None] + np.sin(angle) * np.cross(normals, a)[:, None]
    rim = (
        np.asarray(body.centers, float)[:, None]
        + np.asarray(body.radii, float)[:, None, None] * rim
    )
    column, row, _ = (
        np.asarray(each) for each in view.project(jnp.asarray(rim.transpose(2, 0, 1), dtype))
    )
    found = np.stack([np.asarray(each) for each in _box(footprints)])
    expected = np.stack([column.min(1), column.max(1), row.min(1), row.max(1)])
    visible = np.asarray(footprints.visible)
    assert visible.sum() > 30
    np.testing.assert_allclose(
        found[:, visible], expected[:, visible], atol=0.05
    )  # of radii of 500 pixels and more


@pytest.mark.parametrize("kind", VIEWS)
def test_nothing_inside_the_rim_lies_outside_the_box(kind, dtype):
    view = VIEWS[kind]()
    footprints = jax.jit(lambda s: view.footprints(s, SplattingSettings()))(scattered())
    x, y = offsets(footprints, reach=1.6, steps=41)
    inside, _, _ = fragments(footprints, view, jnp.asarray(x, dtype), jnp.asarray(y, dtype))
    inside = np.asarray(inside & footprints.visible[:, None])
    left, right, top, bottom = (np.asarray(each)[:, None] for each in _box(footprints))
    slack = 1e-4 * (right - left + bottom - top)
    in_box = (x > left - slack) & (x < right + slack) & (y > top - slack) & (y < bottom + slack)
    assert np.sum(inside) > 1000
    assert not np.any(inside & ~in_box)


@pytest.mark.parametrize("kind", VIEWS)
def test_power_of_small_splats_does_not_depend_on_where_they_lie(kind):
    """The weights of a splat add up to its projected area times the kernel's mean, be it larger or
    smaller than a pixel.
    """
    view = (
        bodies.perspective(width=24, height=24)
        if kind == "perspective"
        else bodies.orthographic(width=24, height=24)
    )
    rng = np.random.default_rng(5)
    count, across = 192, np.asarray(view.rotation, float)[:2]
    centers = rng.uniform(-0.7, 0.7, (count, 2)) @ across
    radii = np.exp(rng.uniform(np.log(1e-3), np.log(2.0), count))
    normals = rng.normal(size=(count, 3)) * 0.5 - np.asarray(view.rotation, float)[2]
    body = bodies.splats(centers, normals, radii)
    grid = jnp.arange(24, dtype=float) + 0.5
    x, y = (
        jnp.broadcast_to(each.reshape(1, -1), (count, 576)) for each in jnp.meshgrid(grid, grid)
    )

    @jax.jit
    def power(body):
        footprints = view.footprints(body, SplattingSettings())
        inside, squared_radius, _ = fragments(footprints, view, x, y)
        weight = jnp.where(inside, fragment_weight(jnp.where(inside, squared_radius, 1.0)), 0.0)
        return footprints.opacity * jnp.sum(weight, axis=1)

    _, along = rays(view, np.full((1,), 12.0), np.full((1,), 12.0))
    cosine = -np.asarray(body.normals, float) @ (along[0] / np.linalg.norm(along[0]))
    mean_weight = (1 - np.exp(-4)) / 4 - 3 * np.exp(-4)
    pixels = np.asarray(body.radii, float) * float(view.pixels_per_mm(jnp.asarray(40.0)))
    expected = np.pi * pixels**2 * cosine * mean_weight
    small = cosine > 0.3
    tilt = np.where(
        hasattr(view, "focal_length"), 0.03, 0.0
    )  # what the center's depth and slant leave out
    np.testing.assert_allclose(
        np.asarray(power(body))[small], expected[small], rtol=POWER_ERROR + tilt
    )


def test_splats_beside_the_eye_do_not_veil_the_picture(dtype):
    """A splat barely before the eye's plane, far to the side: nothing of it is seen, in float32
    neither.
    """
    view = bodies.perspective(eye=(0.0, 0.0, 0.0), target=(0.0, 0.0, -1.0), width=64, height=64)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    depth = np.exp(np.linspace(np.log(0.011), np.log(1.0), 24))
    centers = np.stack([50 * np.cos(angle), 50 * np.sin(angle), -depth], 1)
    body = bodies.splats(
        centers, np.random.default_rng(6).normal(size=(24, 3)) * 0.5 - centers / 50, 5.0
    )
    footprints = jax.jit(lambda s: view.footprints(s, SplattingSettings()))(body)
    x, y = (
        jnp.asarray(np.tile(each.reshape(1, -1), (24, 1)), dtype)
        for each in np.mgrid[0.5:64:4, 0.5:64:4]
    )
    inside, _, _ = fragments(footprints, view, x, y)
    assert not bool(jnp.any(inside & footprints.visible[:, None]))


def test_the_filter_is_the_narrowest_that_keeps_power_to_four_percent():
    """What a splat far below a pixel weighs depends on where between the pixels it lies, the more
    the narrower the filter.
    """
    view = bodies.orthographic(width=24, height=24)
    places = np.linspace(0, 1, 16, endpoint=False) / float(view.pixels_per_mm(jnp.asarray(40.0)))
    across, toward = np.asarray(view.rotation, float)[:2], np.asarray(view.rotation, float)[2]
    centers = np.stack([each.ravel() for each in np.meshgrid(places, places)], axis=1) @ across
    body = bodies.splats(centers, np.tile(-toward, (256, 1)), np.full(256, 1e-3))
    x, y = (
        jnp.asarray(np.tile(each.reshape(1, -1), (256, 1)), float)
        for each in np.mgrid[0.5:24, 0.5:24]
    )
    footprints = jax.jit(lambda s: view.footprints(s, SplattingSettings()))(body)
    inside, squared_radius, _ = jax.jit(lambda f: fragments(f, view, x, y))(footprints)
    weights = np.sum(
        np.where(inside, fragment_weight(jnp.where(inside, squared_radius, 1.0)), 0.0), axis=1
    )
    assert 0.5 * POWER_ERROR < np.ptp(weights) / np.mean(weights) < POWER_ERROR
