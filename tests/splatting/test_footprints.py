"""Footprints against rays cut with planes, and the law of the screen filter."""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting import SplattingSettings, fragment_weight

NO_FILTER = SplattingSettings(filter_radius=1e-4)
# In pixels so fine, the quarter pixel that keeps slopes finite is nothing.
FINE = {"width": 40_000, "height": 32_000}
# float64: that quarter pixel; float32: slanted discs cancel by the squared tangent.
AGREEMENT = {"float64": 2e-5, "float32": 2e-3}
DISTANCE = 40.0  # mm
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


def footprints_of(view, body, settings=SplattingSettings()):
    footprints = jax.jit(lambda body: view.footprints(body, settings))(body)
    box = footprints.left, footprints.right, footprints.top, footprints.bottom
    return footprints, np.stack([np.asarray(each, float) for each in box])


def around(box, reach, steps):
    """Columns and rows in and around every box, `[splats, samples]`."""
    grid = np.linspace(-reach, reach, steps)
    u, v = (each.reshape(1, -1) for each in np.meshgrid(grid, grid))
    left, right, top, bottom = box[:, :, None]
    return (left + right + (right - left) * u) / 2, (top + bottom + (bottom - top) * v) / 2


@eqx.filter_jit
def fragments(footprints, view, x, y):
    """Return which are seen, rho^2 and depth at pixels `[splats, samples]`."""
    f = jax.tree.map(lambda leaf: leaf[:, None], footprints)
    dx, dy = jnp.asarray(x, f.x.dtype) - f.x, jnp.asarray(y, f.x.dtype) - f.y
    nearness = f.nearness + f.slope_x * dx + f.slope_y * dy
    quadric = f.a * dx * dx + f.b * dx * dy + f.c * dy * dy
    seen = f.visible & view.inside(nearness, quadric)
    return seen, view.squared_radius(nearness, quadric), view.depth(nearness)


@eqx.filter_jit
def power(body, view):
    """Add up the weights of every splat over all pixels."""
    footprints = view.footprints(body, SplattingSettings())
    grid = (jnp.arange(size, dtype=body.radii.dtype) + 0.5 for size in (view.width, view.height))
    x, y = (
        jnp.broadcast_to(each.reshape(1, -1), (body.count, each.size))
        for each in jnp.meshgrid(*grid)
    )
    seen, squared_radius, _ = fragments(footprints, view, x, y)
    weight = jnp.where(seen, fragment_weight(jnp.where(seen, squared_radius, 1.0)), 0.0)
    return jnp.sum(weight, axis=1), footprints.opacity


def at_depth(view, x, y, depth):
    """Points of the rays through pixels: `[splats, samples, 3]`."""
    given = (jnp.asarray(each, float) for each in (x, y, np.full_like(x, depth)))
    return np.moveaxis(np.asarray(view.unproject(*given), float), 0, -1)


@pytest.mark.parametrize("kind", VIEWS)
def test_fragments_are_where_rays_meet_discs(kind, dtype):
    view, body = FINE_VIEWS[kind](), scattered()
    footprints, box = footprints_of(view, body, NO_FILTER)
    x, y = around(box, 1.25, 17)
    _, squared_radius, depth = (np.asarray(each) for each in fragments(footprints, view, x, y))
    start = at_depth(view, x, y, 0.0)
    along = (at_depth(view, x, y, DISTANCE) - start) / DISTANCE
    centers, normals = (np.asarray(each, float)[:, None] for each in (body.centers, body.normals))
    t = np.sum((centers - start) * normals, -1) / np.sum(along * normals, -1)
    hit = start + t[..., None] * along
    expected = np.sum((hit - centers) ** 2, -1) / np.asarray(body.radii, float)[:, None] ** 2
    facing = -np.sum(along * normals, -1) / np.linalg.norm(along, axis=-1)
    chosen = np.asarray(footprints.visible)[:, None] & (facing > 0.15) & (expected < 2) & (t > 1)
    assert np.mean(chosen) > 0.2
    forward = (hit - np.asarray(view.position, float)) @ np.asarray(view.rotation, float)[2]
    tolerance = {"rtol": AGREEMENT[str(dtype)], "atol": AGREEMENT[str(dtype)]}
    np.testing.assert_allclose(squared_radius[chosen], expected[chosen], **tolerance)
    np.testing.assert_allclose(depth[chosen], forward[chosen], **tolerance)


@pytest.mark.parametrize("kind", VIEWS)
def test_power_of_small_splats_does_not_depend_on_where_they_lie(kind):
    """The weights of a splat add up to its projected area times the kernel's mean, be it larger or
    smaller than a pixel.
    """
    view = VIEWS[kind](width=24, height=24)
    rng, count, axes = np.random.default_rng(5), 192, np.asarray(view.rotation, float)
    centers = rng.uniform(-0.7, 0.7, (count, 2)) @ axes[:2]
    radii = np.exp(rng.uniform(np.log(1e-3), np.log(2.0), count))
    body = bodies.splats(centers, rng.normal(size=(count, 3)) * 0.5 - axes[2], radii)
    cosine = -np.asarray(body.normals, float) @ axes[2]
    mean_weight = (1 - np.exp(-4)) / 4 - 3 * np.exp(-4)
    is_perspective = kind == "perspective"
    scale = float(view.focal_length) / 40 if is_perspective else float(view.scale)
    expected = np.pi * (radii * scale) ** 2 * cosine * mean_weight
    weights, opacity = (np.asarray(each) for each in power(body, view))
    chosen = cosine > 0.3
    tilt = 0.03 if is_perspective else 0.0  # what the center's depth and slant leave out
    found = (weights * opacity)[chosen]
    np.testing.assert_allclose(found, expected[chosen], rtol=POWER_ERROR + tilt)


def test_the_filter_is_the_narrowest_that_keeps_power_to_four_percent():
    """What a splat far below a pixel weighs depends on where between the pixels it lies, the more
    the narrower the filter.
    """
    view = bodies.orthographic(width=24, height=24)
    places = np.linspace(0, 1, 16, endpoint=False) / float(view.scale)
    axes = np.asarray(view.rotation, float)
    centers = np.stack([each.ravel() for each in np.meshgrid(places, places)], axis=1) @ axes[:2]
    body = bodies.splats(centers, np.tile(-axes[2], (256, 1)), np.full(256, 1e-3))
    weights = np.asarray(power(body, view)[0])
    assert 0.5 * POWER_ERROR < np.ptp(weights) / np.mean(weights) < POWER_ERROR
