"""Splats that come a part at a time make the picture of all at once. A picture for any weights:
what `render` makes of them, and its derivative.
"""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import (
    PLAIN,
    TILED,
    apart,
    assert_refused,
    camera_over,
    joined,
    sheet,
    sphere,
    with_albedo,
)

import splatjax as sj
from splatjax.diffusion._clusters import LayerSources
from splatjax.render._statistics import measure_stream

ROUNDING = 3e-5  # of the largest number of its kind: sums of a thousand terms, in another order
LAYERS = 2.5e-2  # 99% of the pixels; at points here and at splats there, with clusters of each part
RIMS = 0.1  # where a pixel blends two surfaces, 0.07 measured
FIELDS = (
    "coverage",
    "depth",
    "position",
    "normal",
    "albedo",
    "shadow",
    "irradiance",
    "specular",
    "unresolved_fraction",
)
STRATA = (
    sj.EnvironmentLight(np.random.default_rng(4).uniform(0.1, 2.0, (6, 12, 3)), count=3),
    sj.scene.SphereLight([-60, 10, 20], 4.0, 10.0, count=2),
)
LIGHTS = (
    sj.DirectionalLight([0.4, -0.5, -1.0], [1, 1, 1]),
    sj.PointLight([-60, 10, 20], [2000, 2000, 2000], cast_shadows=False),
)
MATERIAL = sj.Material(
    sj.SumOfGaussians([0.1, 9.0, 60.0], [[0.2, 0.1, 0.1], [0.3, 0.3, 0.2], [0.3, 0.2, 0.1]])
)
CAMERA = sj.Camera.look_at([20, 6, 78], [0, 0, 0], fov=34.0, width=44, height=40)


@pytest.fixture(scope="module")
def splats():
    """A ball, a smaller one before it that casts its shadow on it, and one so far behind it that
    nothing is seen of it.
    """
    cloud = joined(
        sphere(1400, 20.0, jitter=0.0),
        sphere(300, 6.0, (-8.0, 6.0, 30.0), jitter=0.0),
        sphere(500, 6.0, (-25.0, -7.0, -97.0), jitter=0.0),
    )
    colored = with_albedo(cloud, 0.6 + 0.3 * jnp.sin(cloud.centers / 5))
    factors = 0.7 + 0.3 * jnp.cos(cloud.centers / 7)[:, None] * jnp.asarray([[[1.0], [0], [-1]]])
    return dataclasses.replace(colored, weights=factors)


def streamed_in_parts(splats, size):
    def parts():
        for begin in range(0, splats.count, size):
            yield jax.tree.map(lambda leaf: leaf[begin : begin + size], splats)  # noqa: B023

    return parts


def test_parts_make_the_picture_of_all_at_once(splats, monkeypatch):
    whole = sj.render(sj.Scene(splats, LIGHTS, MATERIAL), CAMERA, TILED)
    build, built, done = LayerSources.build, [], []
    counts = [300, 600, 900, 1200, 1500, 1800, 2100, 2200]
    monkeypatch.setattr(
        LayerSources, "build", lambda *given: built.append(len(given[0])) or build(*given)
    )
    streamed = sj.render_streamed(
        streamed_in_parts(splats, 300),
        LIGHTS,
        MATERIAL,
        CAMERA,
        TILED,
        lambda what, count: done.append((what, count)),
    )
    assert streamed.overflow == 0
    assert [count for what, count in done if what == "diffusion"] == counts
    assert [count for what, count in done if what == "looking"][:16] == 2 * counts
    assert len(built) < len(counts)  # nothing is in reach of the last ball, which is not seen
    found = apart(*({name: getattr(frame, name) for name in FIELDS} for frame in (whole, streamed)))
    assert max(found.values()) < ROUNDING, found
    errors = layer_errors(streamed, whole)
    assert np.all(np.quantile(errors, 0.99, axis=(1, 2)) < LAYERS)
    assert np.max(errors) < RIMS


@pytest.mark.long
def test_strata_of_lights_are_streamed_too(splats):
    whole = sj.render(sj.Scene(splats, STRATA, MATERIAL), CAMERA, TILED)
    streamed = sj.render_streamed(streamed_in_parts(splats, 900), STRATA, MATERIAL, CAMERA, TILED)
    found = apart(*({name: getattr(frame, name) for name in FIELDS} for frame in (whole, streamed)))
    assert max(found.values()) < ROUNDING, found


def layer_errors(streamed, whole):
    """Per layer the errors of all pixels that the splats cover, of its largest value."""
    errors = np.abs(streamed.layers - whole.layers)[:, np.asarray(whole.coverage) > 0]
    return errors / np.max(whole.layers, axis=(1, 2, 3))[:, None, None]


@pytest.mark.parametrize(("size", "begins_bare"), [(70, False), (300, True), (2200, False)])
def test_sizes_are_those_of_all_splats_that_have_an_area(splats, size, begins_bare):
    """By them a layer is resolved or not, here and in `render` alike."""
    index = np.arange(splats.count)
    bare = index < 300 if begins_bare else index % 10 == 0
    areas = np.random.default_rng(3).permutation(np.geomspace(0.1, 10.0, splats.count))
    given = jnp.asarray(np.where(bare, 0.0, areas), float)
    cloud = eqx.tree_at(lambda each: each.areas, splats, given)
    *_, spacing, fine, unevenness, _ = measure_stream(streamed_in_parts(cloud, size))
    assert fine == pytest.approx(np.quantile(areas[~bare], sj.diffusion.FINE_QUANTILE), rel=1e-5)
    assert spacing == pytest.approx(np.mean(areas[~bare]) ** 0.5, rel=1e-5)
    assert 0 < unevenness < 1


@pytest.mark.parametrize("are_all", [pytest.param(False, marks=pytest.mark.long, id="first"), True])
def test_the_first_part_or_all_may_have_no_area(splats, are_all):
    """The picture is that of all at once, up to the clusters of the parts."""
    cloud = eqx.tree_at(lambda cloud: cloud.areas, splats, jnp.zeros(splats.count))
    if not are_all:  # a part that is not seen, before the splats
        hidden = jax.tree.map(lambda leaf: leaf[:300], cloud)
        hidden = eqx.tree_at(lambda cloud: cloud.radii, hidden, jnp.zeros(300))
        cloud = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), hidden, splats)
    whole = sj.render(sj.Scene(cloud, LIGHTS, MATERIAL), CAMERA, TILED)
    streamed = sj.render_streamed(streamed_in_parts(cloud, 300), LIGHTS, MATERIAL, CAMERA, TILED)
    assert float(whole.unresolved_fraction[-1]) == are_all
    assert np.all(np.quantile(layer_errors(streamed, whole), 0.99, axis=(1, 2)) < LAYERS)


def test_what_cannot_be_streamed_is_refused(splats):
    small, large = (jax.tree.map(lambda leaf, size=size: leaf[:size], splats) for size in (10, 20))
    plain, default = sj.RenderSettings(diffuser=sj.diffusion.DenseDiffuser()), sj.RenderSettings()
    for passes, settings, message in (
        ([[small]], plain, "DenseDiffuser"),
        ([[]], default, "no splats"),
        ([[small, large]], default, "parts must have one size"),
        ([[small, small], [large, small]], default, "parts must return the same"),
        ([[small, small], [small]], default, "parts must return the same"),
        ([[small, small], [small, small, small]], default, "parts must return the same"),
    ):
        given = partial(next, iter(passes)), LIGHTS, MATERIAL, CAMERA, settings
        assert_refused(partial(sj.render_streamed, *given), message)


def ball_over_sheet(gaussians) -> sj.Scene:
    """Before a sheet, so that one surface shows behind the other; one layer is narrower than the
    splats.
    """
    both = joined(sphere(200, 6.0, jitter=0.0), sheet(12.0, 2.0, center=(0.0, 0.0, -8.0)))
    albedo = np.random.default_rng(1).uniform(0.3, 0.9, (both.count, 2))
    light = sj.DirectionalLight([-0.5, -0.3, -1.0], [2.0, 3.0], cast_shadows=False)
    return sj.Scene(with_albedo(both, albedo), (light,), sj.Material(gaussians))


def gaussians_of(weights) -> sj.SumOfGaussians:
    return sj.SumOfGaussians(jnp.asarray([0.01, 4.0, 60.0]), jnp.asarray(weights, float))


ONE = [[0.1, 0.2], [0.3, 0.2], [0.2, 0.1]]
OTHER = [[0.4, 0.0], [0.0, 0.5], [0.5, 0.3]]


@pytest.fixture(scope="module")
def planned():
    scene, camera = ball_over_sheet(gaussians_of(ONE)), camera_over(14.0, 24, slant=20.0)
    plan = sj.make_plan(scene, camera, PLAIN)
    return scene, camera, plan, sj.diffusion_basis(scene, camera, PLAIN, plan, derivative=True)


def test_it_is_the_picture_of_any_weights(planned):
    _, camera, plan, gathered = planned
    assert np.sum(np.asarray(gathered.in_front) == 0) > 0  # something shows behind
    for weights in (ONE, OTHER):
        frame = sj.render(ball_over_sheet(gaussians_of(weights)), camera, PLAIN, plan)
        found = gathered.beauty(gaussians_of(weights))
        np.testing.assert_allclose(found, frame.beauty, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(gathered.coverage, frame.coverage, rtol=1e-4, atol=1e-5)
    # The narrowest layer is resolved nowhere, the widest everywhere.
    _, resolved = gathered.light.weigh(gaussians_of(ONE), jnp.zeros(2))
    seen = np.asarray(gathered.pixel_radiance_per_exitance[0]) > 0
    narrow, middle, wide = np.asarray(resolved)[:, seen].mean(axis=1)
    assert narrow < 1e-3 < middle <= wide
    np.testing.assert_allclose(wide, 1, rtol=1e-3)


def test_its_derivative_is_that_of_the_picture(planned):
    start, camera, plan, gathered = planned
    jacobian = sj.picture_jacobian(start, camera, PLAIN, plan)
    gaussians, rng = start.material.gaussians, np.random.default_rng(4)
    way = jax.tree.map(lambda leaf: leaf * jnp.asarray(rng.normal(size=leaf.shape)), gaussians)
    beauty = jax.jit(lambda gaussians: gathered.beauty(gaussians))
    for other in (lambda g: g.variances, lambda g: g.weights):
        alone = eqx.tree_at(other, way, replace_fn=jnp.zeros_like)
        expected = jacobian.along(alone.variances, alone.weights)
        _, found = jax.jvp(beauty, (gaussians,), (alone,))
        assert float(jnp.max(jnp.abs(expected))) > 1e-2
        np.testing.assert_allclose(found, expected, atol=1e-4 * float(jnp.max(jnp.abs(expected))))
    picture, slope = jax.jvp(beauty, (gaussians,), (way,))
    np.testing.assert_allclose(picture, jacobian.frame.beauty, rtol=1e-4, atol=1e-5)
    back = jax.vjp(beauty, gaussians)[1](picture)[0]
    along = sum(jax.tree.leaves(jax.tree.map(jnp.vdot, back, way)))
    np.testing.assert_allclose(along, jnp.vdot(picture, slope), rtol=1e-3)
