"""Footprints against rays cut with planes, the law of the screen filter, the weight of a fragment,
and the coverage that a sum of weights makes. Laws of Eq. 1 and of coverage.
"""

import bodies
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

import splatjax as sj
from splatjax.diffusion import unevenness
from splatjax.splatting import (
    DenseRasterizer,
    OrthographicView,
    PerspectiveView,
    SplattingSettings,
    TileRasterizer,
    _rasterizer,
    coverage,
    fragment_weight,
)

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
    footprints = view.footprints(body, SplattingSettings())
    y, x = np.indices((view.height, view.width)).reshape(2, 1, -1).repeat(body.count, axis=1) + 0.5
    seen, squared_radius, _ = fragments(footprints, view, x, y)
    weight = jnp.where(seen, fragment_weight(jnp.where(seen, squared_radius, 1.0)), 0.0)
    return jnp.sum(weight, axis=1), footprints.opacity


def at_depth(view, x, y, depth):
    given = (jnp.asarray(each, float) for each in (x, y, np.full_like(x, depth)))
    return np.moveaxis(np.asarray(view.unproject(*given), float), 0, -1)


@pytest.mark.parametrize("kind", VIEWS)
def test_fragments_are_where_rays_meet_discs(kind, dtype):
    view, rng = FINE_VIEWS[kind](), np.random.default_rng(3)
    normals = rng.normal(size=(60, 3)) + np.asarray([0, 0, 1.2])
    body = bodies.splats(rng.uniform(-9, 9, (60, 3)), normals, rng.uniform(0.5, 5.0, 60))
    footprints = eqx.filter_jit(view.footprints)(body, SplattingSettings(filter_radius=1e-4))
    left, right, top, bottom = (np.asarray(each, float)[:, None] for each in footprints.box)
    # Columns and rows in and around every box, `[splats, samples]`.
    u, v = 2.5 * np.indices((17, 17)).reshape(2, 1, -1) / 16 - 1.25
    x, y = (left + right + (right - left) * u) / 2, (top + bottom + (bottom - top) * v) / 2
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
    found = squared_radius[chosen], depth[chosen]
    np.testing.assert_allclose(found, [expected[chosen], forward[chosen]], **tolerance)


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
    expected = np.pi * (radii / view.pixel_size(jnp.asarray(40.0))) ** 2 * cosine * mean_weight
    weights, opacity = power(body, view)
    tilt = 0.03 if kind == "perspective" else 0.0  # what the center's depth and slant leave out
    found, chosen = weights * opacity, cosine > 0.3
    np.testing.assert_allclose(found[chosen], expected[chosen], rtol=POWER_ERROR + tilt)


def test_the_filter_is_the_narrowest_that_keeps_power_to_four_percent():
    """What a splat far below a pixel weighs depends on where between the pixels it lies, the more
    the narrower the filter.
    """
    view = bodies.orthographic(width=24, height=24)
    places = np.linspace(0, 1, 16, endpoint=False) / float(view.scale)
    axes = np.asarray(view.rotation, float)
    centers = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2) @ axes[:2]
    weights, _ = power(bodies.splats(centers, np.tile(-axes[2], (256, 1)), 1e-3), view)
    assert 0.5 * POWER_ERROR < np.ptp(weights) / np.mean(weights) < POWER_ERROR


POLYNOMIAL_ERROR = 2e-6  # 6e-7 of the fit, and rounding of seven float32 steps


def test_weight_is_the_gaussian_of_the_formula_tapered_at_the_rim(x64):
    q = jnp.linspace(0, 1, 401)
    weight, slope = jax.jit(jax.vmap(jax.value_and_grad(fragment_weight)))(q)
    expected = np.exp(-4 * q) - np.exp(-4.0) * (5 - 4 * q)
    np.testing.assert_allclose(weight, expected, atol=3e-7)
    rounding = 1e-15 if x64 else 1e-7
    np.testing.assert_array_less(np.abs([weight[-1], slope[-1]]), [rounding, 4 * rounding])
    assert np.all(np.diff(weight[:-4]) < 0)
    fast = jax.jit(_rasterizer.fast_fragment_weight)(q)
    np.testing.assert_allclose(fast, weight, atol=POLYNOMIAL_ERROR)
    assert np.all(fast >= 0)


def test_coverage_is_a_smooth_step():
    full, sums = 0.15, jnp.linspace(0.0, 0.4, 321)
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(lambda s: coverage(s, full))))(sums)
    assert values[0] == slopes[0] == 0
    assert np.all(values[sums >= full] == 1)
    assert np.all(slopes[sums > full] == 0)
    assert np.all(np.diff(values) >= 0)
    np.testing.assert_allclose(values[60], 0.5, rtol=1e-5)  # at half of `full`
    bend = 6 / full**2  # the slope has no jump: its change is bounded by its own derivative
    assert np.max(np.abs(np.diff(slopes))) < bend * (0.4 / 320) * 1.01


SETTINGS = SplattingSettings(full_coverage=0.3)
PLANE = 1e-5  # of the distance: float32's rounding, and what the quarter pixel in the slopes leaves


RASTERIZERS = {"plain": DenseRasterizer(), "tiles": TileRasterizer(lanes=8, slots=16)}


def drawn(view, body, rows=None, rasterizer="plain", settings=SETTINGS):
    plan = RASTERIZERS[rasterizer].make_plan([body], [view], settings)
    rows = jnp.zeros((0, body.count)) if rows is None else rows
    return jax.jit(lambda body, rows: bodies.drawn(body, rows, view, settings, plan))(body, rows)


def seen_through(surfaces) -> tuple[np.ndarray, np.ndarray]:
    front, behind = np.asarray(surfaces.front.coverage), np.asarray(surfaces.behind.coverage)
    return front, front + behind


@pytest.mark.parametrize("kind", VIEWS)
def test_a_constant_is_kept_and_a_plane_stays_a_plane(kind, dtype):
    """Large enough splats: a quarter of a pixel is added to the ellipse that a slope is
    divided by.
    """
    view = VIEWS[kind]()
    normal = bodies.unit([0.35, 0.3, 0.0] - np.asarray(view.rotation, float)[2])
    body = bodies.sheet(30.0, 2.0, normal)
    front = drawn(view, body, jnp.full((1, body.count), 0.3)).front
    assert float(jnp.min(front.coverage)) == 1
    rounding = 4 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(front.attributes, 0.3, rtol=rounding)
    y, x = jnp.asarray(np.indices(front.depth.shape) + 0.5, dtype)
    off_plane = np.tensordot(normal, np.asarray(view.unproject(x, y, front.depth), float), 1)
    assert np.abs(off_plane).max() < PLANE * DISTANCE


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
    front, both = seen_through(surfaces)
    tangent = np.hypot(*(np.indices(front.shape) - 31.5)) / float(view.focal_length)
    inside = tangent < 0.9 * radius / np.sqrt(DISTANCE**2 - radius**2)
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
    """Fragments of splats smaller than a pixel weigh less than the surface behind an edge."""
    width, height, pixel = 24, 4, 0.02
    fov = 2 * np.degrees(np.arctan(0.5 * height * pixel / DISTANCE))
    view = bodies.perspective(fov=fov, width=width, height=height)
    if kind == "orthographic":
        scale = jnp.asarray(1 / pixel)
        view = OrthographicView(jnp.zeros(3), view.rotation, scale, width, height)
    front, both = seen_through(drawn(view, limb(pixel, 0.3), None, rasterizer))
    assert np.any(front < 1), "the edge lies between pixels"
    assert np.min(both) > 1 - 1e-6


def by_default(body) -> SplattingSettings:
    """The settings of splats whose radius is 1.5 times the root of their area."""
    return SplattingSettings().measured(unevenness(body), jnp.asarray(1.5**2))


def covered(view, body) -> np.ndarray:
    return np.asarray(seen_through(drawn(view, body, None, "tiles", by_default(body)))[1], float)


@pytest.mark.once
def test_an_outline_is_where_the_body_ends_and_is_antialiased():
    size, radius = 48, 10.0
    view = bodies.perspective(width=size, height=size)
    coverage = covered(view, bodies.sphere(20_000, radius, jitter=0.0))
    scale = DISTANCE / float(view.pixel_size(jnp.asarray(DISTANCE)))
    seen = scale * np.tan(np.arcsin(radius / DISTANCE))
    assert np.sqrt(np.sum(coverage) / np.pi) == pytest.approx(seen, abs=0.12)  # pixels
    assert np.sum((coverage > 0.05) & (coverage < 0.95)) > 0.6 * 2 * np.pi * seen
    y, x = np.mgrid[:size, :size] + 0.5 - size / 2
    assert np.min(coverage[np.hypot(x, y) < seen - 2]) > 0.999


@pytest.mark.once
def test_an_edge_before_another_surface_is_where_the_body_ends_and_is_antialiased():
    """A sphere before a wide sheet: its share of each pixel, against that of a disc."""
    size, radius = 48, 10.0
    view = bodies.perspective(width=size, height=size)
    ball = bodies.sphere(20_000, radius, jitter=0.0)
    body = bodies.joined(ball, bodies.sheet(40.0, 0.5, center=(0.0, 0.0, -20.0)))
    of_ball = jnp.asarray(np.arange(body.count) < ball.count, body.radii.dtype)[None]
    surfaces = drawn(view, body, of_ball, "tiles", by_default(ball))
    assert np.min(seen_through(surfaces)[1]) > 0.999
    both = surfaces.front, surfaces.behind
    share = sum(np.asarray(each.coverage * each.attributes[0], float) for each in both)
    scale = DISTANCE / float(view.pixel_size(jnp.asarray(DISTANCE)))
    seen = scale * np.tan(np.arcsin(radius / DISTANCE))
    fine = (np.arange(10 * size) + 0.5) / 10 - size / 2
    disc = np.hypot(*np.meshgrid(fine, fine)) < seen
    disc = disc.reshape(size, 10, size, 10).mean(axis=(1, 3))
    assert np.sqrt(share.sum() / np.pi) == pytest.approx(seen, abs=0.12)  # pixels
    on_edge = (disc > 0) & (disc < 1)
    assert np.sqrt(np.mean((share - disc)[on_edge] ** 2)) < 0.12
    np.testing.assert_allclose(share[~on_edge], disc[~on_edge], atol=0.2)


@pytest.mark.once
@pytest.mark.parametrize("jitter", [0.1, 0.35])
def test_a_surface_is_covered_however_evenly_its_splats_are_spread(jitter):
    view = bodies.perspective(width=96, height=96)
    body = bodies.sphere(20_000, 25.0, jitter=jitter)
    coverage = covered(view, body)
    assert np.all(coverage > 0)
    assert np.mean(coverage < 0.99) < 5e-4
    # Where nothing is seen through it, nothing is looked for behind it.
    settings, rasterizer = by_default(body), TileRasterizer(lanes=4, slots=4)
    plan = rasterizer.make_plan([body], [view], settings).fitted(body, [view], settings)
    assert plan.places.behind < plan.places.front / 4


@pytest.mark.once
def test_creases_are_covered():
    """Also where neither of two surfaces covers its pixel alone."""
    camera = sj.Camera.look_at((330, 20, 700), (0, -45, 0), fov=30, width=128, height=128)
    coverage = covered(PerspectiveView.of(camera), sj.bust(10_000))
    inside = binary_erosion(coverage > 0.5, iterations=3)
    assert inside.sum() > 4000
    assert np.all(coverage[inside] > 0.9)
