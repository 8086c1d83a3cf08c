"""Laws of Eq. 1 and of coverage."""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from splatjax.splatting import DenseRasterizer, OrthographicView, SplattingSettings, TileRasterizer

SETTINGS = SplattingSettings()
VIEWS = {"perspective": bodies.perspective, "orthographic": bodies.orthographic}
PLANE = 1e-5  # of the distance: float32's rounding, and what the quarter pixel in the slopes leaves
DISTANCE = 40.0


RASTERIZERS = {"plain": DenseRasterizer(), "tiles": TileRasterizer(lanes=8, slots=16)}


def drawn(view, body, rows=None, rasterizer="plain"):
    """Draw rows of attributes, or none."""
    plan = RASTERIZERS[rasterizer].make_plan([body], [view], SETTINGS)
    rows = jnp.zeros((0, body.count)) if rows is None else rows
    return jax.jit(lambda body, rows: bodies.drawn(body, rows, view, SETTINGS, plan))(body, rows)


def seen_through(surfaces) -> tuple[np.ndarray, np.ndarray]:
    """Return the coverage of the front, and that of both surfaces together."""
    front, behind = np.asarray(surfaces.front.coverage), np.asarray(surfaces.behind.coverage)
    return front, front + (1 - front) * behind


@pytest.mark.parametrize("kind", VIEWS)
def test_a_constant_is_kept_and_a_plane_stays_a_plane(kind, dtype):
    """Large enough splats: a quarter of a pixel is added to the ellipse that a slope is
    divided by.
    """
    normal = np.asarray([0.4, 0.3, 1.0]) / np.linalg.norm([0.4, 0.3, 1.0])
    view = VIEWS[kind]()
    if kind == "orthographic":
        normal = -np.asarray(view.rotation, float)[2] + [0.3, 0.3, 0.0]
        normal /= np.linalg.norm(normal)
    body = bodies.sheet(30.0, 2.0, normal)
    surfaces = drawn(view, body, jnp.full((1, body.count), 0.3))
    assert float(jnp.min(surfaces.front.coverage)) == 1
    rounding = 4 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(np.asarray(surfaces.front.attributes), 0.3, rtol=rounding)
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    x, y = (jnp.asarray(each, dtype) for each in (x, y))
    points = np.asarray(view.unproject(x, y, surfaces.front.depth), float)
    off_plane = np.abs(np.tensordot(normal, points, 1))
    assert off_plane.max() < PLANE * DISTANCE


def seen_sphere(view, radius, share):
    """Say which pixels see a sphere around the origin within `share` of its silhouette's radius."""
    column, row = np.meshgrid(
        np.arange(view.width) + 0.5 - view.width / 2, np.arange(view.height) + 0.5 - view.height / 2
    )
    tangent = np.hypot(column, row) / float(view.focal_length)
    return tangent < share * radius / np.sqrt(DISTANCE**2 - radius**2)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_coverage_is_one_inside_a_closed_surface(seed):
    view, radius = bodies.perspective(width=48, height=48), 11.0
    surfaces = drawn(view, bodies.sphere(1500, radius, seed=seed))
    inside, outside = seen_sphere(view, radius, 0.93), ~seen_sphere(view, radius, 1.15)
    front = np.asarray(surfaces.front.coverage)
    assert inside.sum() > 600
    assert np.min(front[inside]) == 1
    assert np.max(front[outside]) == 0


@pytest.mark.once
@pytest.mark.parametrize("rasterizer", RASTERIZERS)
def test_inner_silhouettes_leave_no_gap(rasterizer):
    """Small spheres before a large one: where they end, the large one shows. The outlines of the
    first two coincide: neither rim may hide what lies behind both.
    """
    view, radius = bodies.perspective(width=64, height=64), 12.0
    near, far, small = 20.0, 15.0, 3.0
    along = np.asarray([0.02, -0.03, 1.0])
    twin = small * (DISTANCE - far) / (DISTANCE - near)
    places = [along * [DISTANCE - z, DISTANCE - z, z] for z in (near, far)]
    body = bodies.joined(
        bodies.sphere(1400, radius),
        bodies.sphere(400, small, places[0], seed=1),
        bodies.sphere(400, twin, places[1], seed=2),
        bodies.sphere(300, 2.0, (-5.0, 4.0, 17.0), seed=1),
    )
    is_small = (jnp.arange(body.count) >= 1400).astype(float)
    surfaces = drawn(view, body, is_small[None], rasterizer)
    (front, both), inside = seen_through(surfaces), seen_sphere(view, radius, 0.9)
    edge = inside & (front < 1)
    assert edge.sum() >= 16, "the silhouettes lie between pixels"
    assert np.min(both[inside]) > 1 - 1e-6
    assert np.all(np.asarray(surfaces.front.attributes[0])[edge] > 0.99)
    assert np.median(np.asarray(surfaces.behind.attributes[0])[edge]) < 0.01


def limb(pixel: float, radius: float):
    """Where a cylinder of 270 pixels in radius turns away before a sheet; splats with a radius in
    pixels.
    """
    spacing = radius * pixel / 1.5
    sideways = np.arange(-2.5 * pixel, 2.5 * pixel, spacing)

    def strip(along):
        return (each.ravel() for each in np.meshgrid(along, sideways))

    z, y = strip(np.arange(-50 * pixel, 110 * pixel, spacing))
    curved = np.stack([np.sqrt((270 * pixel) ** 2 - z * z), y, z], axis=1)
    x, y = strip(np.arange(250 * pixel, 290 * pixel, spacing))
    flat = np.stack([x, y, np.full_like(x, -160 * pixel)], axis=1)
    normals = np.concatenate(
        [curved * [1.0, 0.0, 1.0] / (270 * pixel), np.tile([0.0, 0.0, 1.0], (len(flat), 1))]
    )
    centers = np.concatenate([curved, flat]) - [268 * pixel, 0.0, 0.0]
    return bodies.splats(centers, normals, np.full(len(centers), radius * pixel))


@pytest.mark.once
@pytest.mark.parametrize("rasterizer", RASTERIZERS)
@pytest.mark.parametrize("kind", VIEWS)
def test_an_edge_hides_nothing_behind_it_however_small_the_splats(kind, rasterizer):
    """Fragments of splats smaller than a pixel weigh less than those that the surface behind an
    edge is told by.
    """
    width, height, pixel = 24, 4, 0.02
    if kind == "perspective":
        view = bodies.perspective(
            fov=2 * np.degrees(np.arctan(0.5 * height * pixel / DISTANCE)),
            width=width,
            height=height,
        )
    else:
        facing = jnp.diag(jnp.asarray([1.0, -1.0, -1.0]))
        view = OrthographicView(jnp.zeros(3), facing, jnp.asarray(1 / pixel), width, height)
    body = limb(pixel, 0.3)
    front, both = seen_through(drawn(view, body, None, rasterizer))
    assert np.any(front < 1), "the edge lies between pixels"
    assert np.min(both) > 1 - 1e-6


def test_coverage_of_a_silhouette_is_differentiable(float64):
    """Moving a disc before nothing changes its coverage by central differences."""
    view = bodies.perspective(width=24, height=24)
    body, ramp = bodies.sphere(200, 6.0), jnp.arange(24, dtype=float)

    @jax.jit
    def covered(shift):
        moved = eqx.tree_at(lambda s: s.centers, body, body.centers + shift[None])
        surfaces = drawn(view, moved)
        return jnp.sum(surfaces.front.coverage * (ramp[None] + 2 * ramp[:, None]))

    shift = jnp.asarray([0.1, -0.2, 0.3])
    check_grads(covered, (shift,), 1, ["rev"], atol=1e-5, rtol=1e-5, eps=1e-6)
