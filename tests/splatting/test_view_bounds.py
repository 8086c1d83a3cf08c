"""Which splats a view may see, and boxes around spheres: exact where they are planes, never too
few.
"""

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.splatting._views import MARGIN

VIEWS = {
    "perspective": bodies.perspective(
        eye=(3.0, -2.0, 30.0), target=(1.0, 1.0, 0.0), width=48, height=30
    ),
    "orthographic": bodies.orthographic(scale=1.7, width=48, height=30),
}
COUNT = 400


def beside_the_picture(view, off):
    """Spheres that miss what the picture and its margin show by `off` of their radius, each beside
    one of the four edges.
    """
    rng = np.random.default_rng(8)
    radii, edge, depth = (
        rng.uniform(0.05, 3.0, COUNT),
        rng.integers(0, 4, COUNT),
        rng.uniform(5, 25, COUNT),
    )
    along = rng.uniform(0.1, 0.9, COUNT)
    low, high = np.full(COUNT, -MARGIN), np.where(edge < 2, view.width, view.height) + MARGIN
    column = np.where(edge < 2, np.where(edge == 0, low, high), along * view.width)
    row = np.where(edge < 2, along * view.height, np.where(edge == 2, low, high))
    touched = np.asarray(
        view.unproject(*(jnp.asarray(each, float) for each in (column, row, depth))), float
    )
    side = np.where(edge % 2 == 0, -1.0, 1.0)
    if hasattr(view, "focal_length"):  # a plane through the eye
        half = 0.5 * np.where(edge < 2, view.width, view.height) + MARGIN
        slant = np.stack([side * float(view.focal_length), -half]) / np.hypot(
            float(view.focal_length), half
        )
    else:
        slant = np.stack([side, np.zeros(COUNT)])
    axes = np.asarray(view.rotation, float)
    outward = (
        slant[0] * np.where(edge < 2, axes[0][:, None], axes[1][:, None])
        + slant[1] * axes[2][:, None]
    )
    centers = (touched + (1 + off) * radii * outward).T
    toward = (
        np.asarray(view.position, float) - centers
        if hasattr(view, "focal_length")
        else np.tile(-axes[2], (COUNT, 1))
    )
    return centers, toward, radii


@pytest.mark.parametrize("kind", VIEWS)
def test_spheres_that_touch_the_picture_may_be_seen_where_they_face_the_eye(kind):
    view = VIEWS[kind]
    seen = jax.jit(lambda body: view.may_see(body))
    for off in (-2.5, -1.0, -0.02, 0.02, 1.0):
        centers, toward, radii = beside_the_picture(view, off)
        np.testing.assert_array_equal(
            seen(bodies.splats(centers, toward, radii)), np.full(COUNT, off < 0), err_msg=str(off)
        )
        assert not np.any(seen(bodies.splats(centers, -toward, radii)))
    if kind == "perspective":  # nothing at the eye's own plane or behind it
        behind = (
            np.asarray(view.position)
            - np.linspace(-0.5 * view.near, 5, 7)[:, None] * np.asarray(view.rotation)[2]
        )
        assert not np.any(
            view.may_see(bodies.splats(behind, np.tile(np.asarray(view.rotation)[2], (7, 1)), 1.0))
        )


@pytest.mark.parametrize("kind", VIEWS)
def test_boxes_hold_their_spheres_and_little_more(kind):
    view, rng = VIEWS[kind], np.random.default_rng(9)
    column, row, depth = (
        rng.uniform(-20, 60, COUNT),
        rng.uniform(-20, 50, COUNT),
        rng.uniform(8, 40, COUNT),
    )
    centers = view.unproject(*(jnp.asarray(each, float) for each in (column, row, depth)))
    radii = rng.uniform(0.05, 2.0, COUNT)
    on_sphere = (
        np.asarray(centers, float)[:, :, None]
        + radii[None, :, None] * bodies.directions(500).T[:, None]
    )
    x, y, _ = (np.asarray(each) for each in view.project(jnp.asarray(on_sphere, float)))
    left, right, top, bottom, found = (
        np.asarray(each) for each in view.sphere_box(centers, jnp.asarray(radii, float))
    )
    np.testing.assert_allclose(found, depth, rtol=1e-4)
    sides = (left, right, x, column - view.width / 2), (top, bottom, y, row - view.height / 2)
    for low, high, place, off in sides:
        assert np.all((low <= place.min(axis=1) + 1e-3) & (high >= place.max(axis=1) - 1e-3))
        more = 1.03  # the directions leave some of the rim out
        if (
            kind == "perspective"
        ):  # as large as at the sphere's nearest depth, and as its foremost point moves sideways
            more = more * depth / (depth - radii) * (1 + np.abs(off) / float(view.focal_length))
        assert np.all(high - low <= more * np.ptp(place, axis=1) + 1e-3)


def test_a_sphere_around_the_eye_is_everywhere_and_one_behind_it_nowhere():
    view = VIEWS["perspective"]
    forward, eye = np.asarray(view.rotation)[2], np.asarray(view.position)
    centers = jnp.asarray(
        eye[:, None] + forward[:, None] * np.asarray([0.5, -0.5, -2.0])[None], float
    )
    left, right, top, bottom, _ = view.sphere_box(centers, jnp.asarray([1.0, 1.0, 1.0]))
    assert np.all(np.isinf([left[:2], right[:2], top[:2], bottom[:2]]))
    assert left[2] > right[2]  # inside out: it touches no tile
