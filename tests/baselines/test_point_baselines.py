"""What each point-based method is known for: flat points, aliasing, holes, curved normals; and that
none invents a color. The law of Figure 5 on the number of splats.
"""

import dataclasses

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj
from splatjax._combination import DeviceMesh
from splatjax.baselines import (
    BlendingRasterizer,
    DiscKernel,
    DiscOrPixelKernel,
    EwaKernel,
    LightAtPixels,
    NearestRasterizer,
    PhongSplats,
    ThinnedDiffuser,
    deferred_splatting,
    elliptical_points,
    layer_contrast,
    normal_slopes,
    phong_splatting,
    splats_that_suffice,
    thinning_error,
)

SETTINGS = sj.splatting.SplattingSettings(full_coverage=0.5)
RASTERIZERS = {
    "elliptical": NearestRasterizer(),
    "ewa": BlendingRasterizer(EwaKernel()),
    "phong": BlendingRasterizer(DiscKernel()),
    "deferred": BlendingRasterizer(DiscOrPixelKernel()),
}
BLENDING = ("ewa", "phong", "deferred")
SIZE = 48


def camera(eye, fov: float = 30.0, target=(0.0, 0.0, 0.0)) -> sj.Camera:
    return sj.Camera.look_at(eye, target, fov=fov, width=SIZE, height=SIZE)


def seen_by(name: str, splats: sj.Splats, *views: sj.splatting.PerspectiveView):
    """Return how any of the views draws the splats, moved by less than a plan can hold, with rows
    of attributes: pictures of the rows, of coverage and of depth.
    """
    plan = RASTERIZERS[name].make_plan([splats], views, SETTINGS)

    def draw(splats, rows, view):
        visible = sj.splatting.visible_surfaces(splats, rows, view, SETTINGS, plan, DeviceMesh())
        surface = sj.splatting.Surface.of(visible.sums, view, visible.needed)
        depth = jnp.where(surface.covered, surface.depth, 0.0)
        pictures = surface.attributes, visible.share, depth
        return tuple(visible.front_picture(each) for each in pictures)

    return jax.jit(draw)


def drawn(name: str, splats: sj.Splats, rows, *cameras: sj.Camera):
    views = [sj.splatting.PerspectiveView.of(each) for each in cameras]
    draw = seen_by(name, splats, *views)
    found = [draw(splats, rows, view)[:2] for view in views]
    attributes, coverage = (np.stack(pictures) for pictures in zip(*found, strict=True))
    return np.moveaxis(attributes, 3, 1), coverage


@pytest.mark.once
@pytest.mark.long
def test_squares_smaller_than_a_pixel_are_gray_and_still_with_a_filter_and_alias_without():
    """From cameras that shift by fractions of a pixel. The mean of the black and white squares is
    gray, 1/2: all contrast is an alias, and so is all power below half of Nyquist.
    """
    sheet = bodies.sheet(11.0, 0.125)
    checkers = jnp.sum(jnp.floor(sheet.centers[:, :2] / 0.25 + 0.25), axis=1)[None] % 2
    # 48 pixels of 0.42 mm: 1.7 squares, 3.3 splats along each
    shifts = [0.0, 0.2]
    cameras = [camera((s, 0.6 * s, 75.0), fov=15.2, target=(s, 0.6 * s, 0.0)) for s in shifts]
    pictures_by = {
        name: drawn(name, sheet, checkers, *cameras)[0][:, 0, 6:-6, 6:-6] for name in RASTERIZERS
    }

    def low(pictures):
        power = np.abs(np.fft.fft2(pictures[0] - pictures[0].mean()) / pictures[0].size) ** 2
        is_low = np.abs(np.fft.fftfreq(len(power))) < 0.25
        return power[np.ix_(is_low, is_low)].sum()

    contrast, flicker, aliases = (
        {name: measure(pictures) for name, pictures in pictures_by.items()}
        for measure in (np.std, lambda pictures: np.mean(np.std(pictures, axis=0)), low)
    )
    np.testing.assert_allclose(np.mean(pictures_by["ewa"]), 0.5, atol=0.02)
    assert contrast["elliptical"] > 0.45  # black and white, as if thrown by a coin: 1/2
    assert contrast["phong"] > 0.2
    assert contrast["ewa"] < contrast["deferred"] < 0.6 * contrast["phong"]
    assert contrast["ewa"] < 0.02
    assert flicker["ewa"] < min(0.01, flicker["elliptical"] / 20, flicker["phong"] / 5)
    assert aliases["ewa"] < min(1e-2 * aliases["elliptical"], 0.1 * aliases["phong"])


@pytest.mark.once
@pytest.mark.parametrize("name", RASTERIZERS)
def test_a_plane_has_its_color_lies_where_it_lies_and_hides_what_is_behind(name):
    """Its attributes are one color, and one of its own for each splat: elliptical points show these
    alone, blended ones show more.
    """
    near = bodies.sheet(9.0, 0.8, jitter=0.3)
    far = dataclasses.replace(near, centers=near.centers - jnp.asarray([[0.0, 0.0, 8.0]]))
    view = sj.splatting.PerspectiveView.of(camera((4.0, -9.0, 14.0), fov=20.0))
    own, color = np.random.default_rng(0).uniform(size=near.count), 0.7
    rows = np.stack([np.full(near.count, color), own])
    rows, body = np.concatenate([0 * rows, rows], axis=1), bodies.joined(far, near)
    attributes, coverage, depth = seen_by(name, body, view)(body, jnp.asarray(rows, float), view)
    assert np.all(coverage > 0)
    np.testing.assert_allclose(attributes[..., 0], color, rtol=1e-5)
    colors = np.ravel(attributes[..., 1])
    nearest = np.min(np.abs(colors[:, None] - own[None].astype(colors.dtype)), axis=1)
    share = np.mean(nearest < 1e-6)
    assert share == 1 if name == "elliptical" else share < 0.2
    assert colors.min() >= own.min() - 1e-6
    assert colors.max() <= own.max() + 1e-6
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    points = view.unproject(jnp.asarray(x, float), jnp.asarray(y, float), depth)
    np.testing.assert_allclose(points[2], 0.0, atol=2e-3)


@pytest.mark.once
def test_an_affine_projection_leaves_holes_near_the_eye_and_an_exact_one_leaves_none():
    """Discs that touch in space part in the picture, where each is drawn as its center is seen."""
    floor = bodies.sheet(48.0, 8.0)
    sheet = dataclasses.replace(floor, radii=0.72 * jnp.sqrt(floor.areas))
    seen = camera((2.4, -30.0, 4.0), fov=75.0, target=(2.4, -18.0, 0.0))
    for name in BLENDING:
        covered = drawn(name, sheet, jnp.ones((1, sheet.count)), seen)[1][0]
        holes = np.mean(covered[SIZE // 2 :] == 0)
        assert holes > 0.1 if name == "ewa" else holes == 0, name


def lit_ball(settings: sj.RenderSettings, count: int):
    """Render a ball that lies off the origin: root mean square errors of its normals (degrees) and
    of its light.
    """
    middle = np.asarray([7.0, -4.0, 3.0])
    lamp = sj.DirectionalLight([0.4, -0.3, -1.0], [np.pi], cast_shadows=False)
    material = sj.Material(sj.SumOfGaussians([1e-6], [[1.0]]), eta=1.0, specular=0.0)
    body = PhongSplats.of(bodies.sphere(count, 10.0, middle, jitter=0.0))
    seen = camera(middle + np.asarray([0, 0, 60]), 18.0, middle)
    frame = sj.render(sj.Scene(body, (lamp,), material), seen, settings)
    true = bodies.unit(np.asarray(frame.position) - middle)
    inner = (np.asarray(frame.coverage) > 0.99) & (true[..., 2] > 0.4)
    cosine = np.sum(np.asarray(frame.normal) * true, axis=2)[inner]
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    shade = np.maximum(true @ bodies.unit(-lamp.direction), 0)
    off = (np.asarray(frame.beauty)[..., 0] - shade)[inner]
    return np.sqrt(np.mean(angle**2)), np.sqrt(np.mean(off**2))


@pytest.mark.once
@pytest.mark.long
def test_normals_that_vary_within_splats_are_closer_to_the_sphere_than_blended_and_flat_ones():
    methods = phong_splatting(), deferred_splatting(), elliptical_points()
    angles, shades = zip(*(lit_ball(settings, 150) for settings in methods), strict=True)
    assert angles[0] < 0.5 * angles[1] < 0.25 * angles[2]
    assert shades[0] < 0.5 * shades[1] < 0.5 * shades[2]


@pytest.mark.once
def test_slopes_of_a_sphere_are_its_curvature_and_those_of_a_plane_are_none():
    body = bodies.sphere(600, jitter=0.0)
    slopes, normals = np.asarray(normal_slopes(body), float), np.asarray(body.normals, float)
    expected = (np.eye(3)[None] - normals[:, :, None] * normals[:, None]) / 10.0
    off = np.abs(slopes - expected)  # of 0.1; largest where the spiral of splats begins and ends
    assert np.quantile(off, 0.99) < 0.005
    assert np.max(off) < 0.015
    assert np.max(np.abs(normal_slopes(bodies.sheet(3.0, 1.0)))) == 0


@pytest.mark.long
@pytest.mark.once
def test_a_baseline_renders_what_the_renderer_does_with_scattering_and_shadow():
    """Where splats are smaller than what bends it makes little matter whether irradiance is blended
    or found per pixel.
    """
    body = bodies.with_albedo(bodies.sphere(1500, jitter=0.0), np.tile([0.9, 0.6, 0.3], (1500, 1)))
    lamp = sj.DirectionalLight([0.4, -0.3, -1.0], [np.pi] * 3)
    scene = sj.Scene(body, (lamp,), sj.load_material("skin").white())
    seen = camera((0.0, 0.0, 60.0), fov=22.0)
    own = sj.render(scene, seen)
    inner = np.asarray(own.normal[..., 2]) > 0.3
    for settings in (sj.RenderSettings(lighting=LightAtPixels()), deferred_splatting()):
        off = (np.asarray(sj.render(scene, seen, settings).beauty) - np.asarray(own.beauty))[inner]
        assert np.sqrt(np.mean(off**2)) < 0.02, (
            settings.rasterizer
        )  # of radiance up to 1; most of it where the light grazes


@pytest.mark.parametrize("name", ["elliptical", "ewa", "deferred"])
def test_what_is_blended_has_derivatives(name, float64):
    """Of what the splats carry and of where they are, as far as no fragment comes or goes: against
    differences.
    """
    sheet = bodies.sheet(2.0, 0.7, jitter=0.2)
    view = sj.splatting.PerspectiveView.of(camera((1.0, 2.0, 12.0), fov=15.0))
    draw = seen_by(name, sheet, view)
    rows = jnp.asarray(np.random.default_rng(1).uniform(size=(1, sheet.count)))
    turn = jnp.asarray(np.random.default_rng(2).normal(size=(SIZE, SIZE)))

    def total(centers, rows):
        attributes, _, depth = draw(dataclasses.replace(sheet, centers=centers), rows, view)
        return jnp.sum(turn * attributes[..., 0]) + jnp.sum(turn * depth)

    # A longer step changes which splat some pixel shows.
    bodies.assert_gradient(total, (sheet.centers, rows), 1e-8, rtol=1e-3)


@pytest.mark.once
def test_a_radius_twice_as_large_allows_a_quarter_and_what_suffices_is_the_inverse():
    one, contrast, width = jnp.asarray(1.0), jnp.asarray(0.6), jnp.asarray(8.0)
    for error in jnp.asarray([0.006, 0.02, 0.05]):
        few, many = (splats_that_suffice(each, one, error, contrast) for each in (2 * width, width))
        np.testing.assert_allclose(many / few, 4, rtol=1e-5)
        law = thinning_error(width, one, many, contrast)
        np.testing.assert_allclose(law, error * np.sqrt(1 - many), rtol=1e-5)
    assert float(splats_that_suffice(width, one, jnp.asarray(1e-6), contrast)) == 1


@pytest.mark.once
def test_even_light_has_no_contrast_and_a_checkered_one_has_all():
    sheet = bodies.sheet(10.0, 1.0)
    checkers = jnp.sum(jnp.round(sheet.centers), axis=1, keepdims=True) % 2
    lights = jnp.ones_like(checkers), checkers
    even, checkered = (layer_contrast(sheet, light, jnp.asarray(9.0)) for light in lights)
    np.testing.assert_allclose(even, 0, atol=1e-3)
    np.testing.assert_allclose(checkered, 1, rtol=0.02)


@pytest.mark.once
def test_thinning_keeps_the_factors_of_all_splats():
    ball = bodies.sphere(300, 10.0)
    factors = 1 + 0.5 * jnp.sin(ball.centers[:, :1])[:, None]  # [splats, gaussians, channels]
    light = sj.DirectionalLight((0.3, 0, -1), 1.0)
    material = sj.Material(sj.SumOfGaussians([4.0, 9.0], [[0.4], [0.3]]))
    ball = dataclasses.replace(ball, weights=jnp.broadcast_to(factors, (ball.count, 2, 1)))
    scene = sj.Scene(ball, [light], material)
    exact, thinned = (
        sj.render(scene, camera((0, 0, 60)), sj.RenderSettings(diffuser=diffuser)).beauty
        for diffuser in (sj.diffusion.DenseDiffuser(), ThinnedDiffuser(1))
    )
    np.testing.assert_allclose(thinned, exact, atol=1e-5)
    assert np.max(exact) > 0.05
