"""How parts of a scene move: rotations, lights, and surfaces along their normals. Maps of
parameters: where they start, what they refuse, and what their error bars mean; their pictures are
linear in the weights, without a renderer.
"""

import dataclasses
from collections import namedtuple
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from bodies import (
    assert_close,
    assert_refused,
    joined,
    lights_from_two_sides,
    sheet,
    sphere,
    view,
    with_albedo,
)
from scipy.spatial.transform import Rotation

import splatjax as sj
from splatjax.inverse import _fit_scene
from splatjax.inverse._observation import PicturedScene
from splatjax.scene import rotation_by

COUNT, SIZE, NOISE = 12, 6, 1e-3
FALLS = np.asarray([[[0.5, 2.0], [1.0, 3.0]], [[1.0, 0.3], [2.0, 0.5]]])
GAUSSIANS = [0.5, 3.0], [[0.4, 0.3], [0.2, 0.3]]
START = {"dye": 0.2, "dirt": 0.1}
Frame = namedtuple("Frame", ["beauty", "coverage", "overflow"])
OPTIMIZER = optax.chain(optax.lbfgs(1.0, memory_size=24, linesearch=None), optax.clip(3.0))


def dyed(dye, dirt) -> sj.SumOfGaussians:
    variances, weights = GAUSSIANS
    return sj.SumOfGaussians(variances, weights * np.exp(-FALLS[0] * dye - FALLS[1] * dirt))


@cache
def table() -> sj.fitting.WeightTable:
    nodes = {"dye": [0.1, 0.2, 0.4, 0.8], "dirt": [0.0, 0.1, 0.2, 0.3]}
    return sj.fitting.weight_table(dyed, nodes, sj.SumOfGaussians(*GAUSSIANS))


def make_part(**more) -> sj.inverse.ParameterMap:
    return sj.inverse.ParameterMap(table(), **({"start": START, "smoothness": 4.0} | more))


def material() -> sj.Material:
    return sj.Material(sj.SumOfGaussians(*GAUSSIANS), specular=0)


def linear(weights) -> jax.Array:
    """Sums over splats of the reflectance: each pixel its own."""
    shares = np.random.default_rng(3).uniform(0, 1, (SIZE, SIZE, COUNT)) ** 4
    reflectance = jnp.sum(weights * jnp.asarray(GAUSSIANS[1])[None], axis=1)
    return jnp.tensordot(jnp.asarray(shares), reflectance, 1)


@pytest.fixture
def linear_pictures(monkeypatch):
    def render(scene, camera, settings, plan):
        return Frame(linear(scene.splats.weights), jnp.ones((SIZE, SIZE)), jnp.zeros(()))

    monkeypatch.setattr(_fit_scene, "render", render)


def camera() -> sj.Camera:
    return view(size=SIZE)


def observation(weights) -> sj.inverse.Observation:
    picture = np.asarray(linear(weights))
    picture = picture + NOISE * np.random.default_rng(5).normal(size=picture.shape)
    return sj.inverse.Observation(
        picture, camera(), lights_from_two_sides()[:1], deviation=np.full(picture.shape, NOISE)
    )


@pytest.mark.once
@pytest.mark.usefixtures("double")
class TestParameterMap:
    def test_it_starts_where_it_is_given(self):
        part, ball = make_part(), sphere(COUNT)
        tables = part.prepared(ball)
        x = part.coordinates(PicturedScene(ball, camera(), ()))
        for name, values in part.maps(x, tables).items():
            np.testing.assert_allclose(values, START[name], rtol=1e-12)
        moved = part.moved(PicturedScene(ball, camera(), ()), x, tables).splats.weights
        expected = jnp.broadcast_to(part.table.factors(START), moved.shape)
        np.testing.assert_allclose(moved, expected, rtol=1e-12)
        far = part.maps(jnp.full_like(x, 1e3), tables).values()
        for values, (low, high) in zip(far, part.table.limits, strict=True):
            assert np.all((values >= low) & (values <= high))

    def test_a_coordinate_changes_the_color_by_a_step(self):
        """Without blur and prior, in all directions alike, where parameters resemble each other."""
        part, ball = make_part(smoothness=1e-3, deviation=1e3, step=1e-4), sphere(COUNT)
        tables = part.prepared(ball)

        def colors(x):
            begin = part.table.reflectance(part.table.fractions(START))
            maps = part.maps(x, tables)
            return part.table.reflectance(part.table.fractions(maps)) / jnp.mean(begin)

        slopes = np.asarray(jax.jacobian(colors)(jnp.zeros((COUNT, 2))))[0, :, 0]
        np.testing.assert_allclose(slopes.T @ slopes, 1e-8 * np.eye(2), atol=1e-11)

    @pytest.mark.parametrize(
        ("more", "message"),
        [
            ({"start": {"dye": 0.9, "dirt": 0.1}}, "dye must be between 0.1 and 0.8.*0.9"),
            ({"start": {"dye": 0.2}}, "given for dye; give dye, dirt"),
            ({"smoothness": 0.0}, "ParameterMap.smoothness must be positive"),
        ],
    )
    def test_a_start_outside_of_the_table_is_refused(self, more, message):
        assert_refused(lambda: make_part(**more), message)

    def test_another_material_is_refused(self):
        other = sj.Material(sj.SumOfGaussians(GAUSSIANS[0], np.ones((2, 2))))
        part, seen = make_part(), observation(np.ones((COUNT, 2, 2)))
        assert_refused(
            lambda: sj.inverse.fit_scene([seen], sphere(COUNT), other, [part], OPTIMIZER, steps=1),
            r"material\.gaussians\.weights must be that of ParameterMap\.table\.base",
        )


@pytest.mark.once
@pytest.mark.usefixtures("double", "linear_pictures")
class TestFits:
    def fit(self, part):
        return partial(
            sj.inverse.fit_scene,
            splats=sphere(COUNT),
            material=material(),
            parts=[part],
            optimizer=OPTIMIZER,
        )

    def observed(self, part):
        rng = np.random.default_rng(7)
        true = {"dye": rng.uniform(0.15, 0.5, COUNT), "dirt": rng.uniform(0.05, 0.25, COUNT)}
        return [observation(part.table.factors(true))]

    def test_a_fit_continues_bit_for_bit(self):
        part = make_part()
        fit, seen = self.fit(part), self.observed(part)
        whole = fit(seen, steps=7)
        parted = fit(seen, steps=4, start=fit(seen, steps=3))
        assert_close(
            eqx.filter(parted, eqx.is_array_like), eqx.filter(whole, eqx.is_array_like), rtol=0
        )
        assert (parted.best, parted.plans) == (whole.best, whole.plans)
        # The best step of the first part remains the best one if nothing better follows.
        better = eqx.tree_at(lambda f: f.losses, whole, np.asarray(whole.losses) - 1e9)
        again = fit(seen, steps=1, start=better)
        assert again.best == whole.best
        assert_close(again.pictures, whole.pictures, rtol=0)
        assert_refused(
            lambda: fit(seen * 2, steps=1, start=whole), f"start is a fit of {len(seen)} "
        )

    def test_error_bars_are_those_of_the_dense_jacobian(self):
        """Of pictures that are nearly linear within the bars."""
        part, ball = make_part(), sphere(COUNT)
        fit, seen = self.fit(part), self.observed(part)
        fitted, tables = fit(seen, steps=60), part.prepared(ball)
        draws = sj.inverse.randomized_fits(partial(fit, steps=25), seen, fitted, 20)

        def stacked(maps):
            return jnp.stack([maps[name] for name in START])

        def residuals(x):
            moved = part.moved(PicturedScene(ball, camera(), ()), x, tables).splats
            of_pictures = linear(moved.weights) / NOISE
            of_prior = part.prior_residuals(x, tables)
            return jnp.concatenate([of_pictures.ravel(), of_prior.ravel()])

        x = fitted.coordinates[0]
        rows, change = (
            np.asarray(jax.jacobian(function)(x)).reshape(-1, x.size)
            for function in (residuals, lambda x: stacked(part.maps(x, tables)))
        )
        exact = np.sqrt(np.diag(change @ np.linalg.inv(rows.T @ rows) @ change.T))
        bars = np.std([stacked(draw.maps) for draw in draws], axis=0, ddof=1).ravel()
        ratio = bars / exact
        assert abs(np.sqrt(np.mean(ratio**2)) - 1) < 0.15  # 20 draws of 24 bars: 0.04
        assert abs(np.corrcoef(np.log(bars), np.log(exact))[0, 1]) > 0.9


FLAT = sheet(5.0, 0.5, jitter=0.2)
CAMERA = sj.Camera.look_at([3, 0, 9], [1, 1, 0], width=4, height=4)


def moved_by(part, splats: sj.Splats, x) -> sj.Splats:
    return part.moved(PicturedScene(splats, CAMERA, ()), x, part.prepared(splats)).splats


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.05, 0.0999, 0.1001, 1.0, 3.0])
def test_a_rotation_is_that_of_its_vector(length, x64):
    vector = length * np.asarray([2.0, -1.0, 2.0]) / 3
    found = jax.jit(rotation_by)(jnp.asarray(vector))
    np.testing.assert_allclose(
        found, Rotation.from_rotvec(vector).as_matrix(), atol=1e-14 if x64 else 1e-6
    )


def test_a_rotation_has_a_derivative_where_there_is_none():
    slope = np.asarray(jax.jit(jax.jacobian(rotation_by))(jnp.zeros(3)))
    for axis in np.eye(3):
        np.testing.assert_allclose(slope @ axis, np.cross(axis, np.eye(3)).T, atol=1e-7)


@pytest.mark.once
def test_a_part_with_nothing_to_change_is_refused():
    sky, parts = sj.EnvironmentLight(np.ones((4, 8, 1))), [sj.inverse.LightPlaces()]
    seen = [sj.inverse.Observation(np.ones((4, 4, 2)), CAMERA, sky)]
    fit = partial(sj.inverse.fit_scene, seen, sphere(20), material(), parts, OPTIMIZER, steps=1)
    assert_refused(fit, "parts: .*LightPlaces")


@pytest.mark.once
def test_lights_move_each_in_its_own_way():
    beam = sj.GaussianBeam([1, 2, 3], [0, 0, -2], power=[4, 5], variance=1)
    ball = sj.scene.SphereLight([1, 2, 3], [4, 5], 1)
    lights = sj.PointLight([1, 2, 3], intensity=[4, 5]), beam, ball
    pictured = PicturedScene(sphere(20), CAMERA, lights)
    places = sj.inverse.LightPlaces(turn=0.1, shift=2.0)
    x = jax.tree.map(jnp.ones_like, places.coordinates(pictured))
    lamp, beam, ball = places.moved(pictured, x, None).lights
    np.testing.assert_allclose([lamp.position, beam.origin, ball.center], [[3, 4, 5]] * 3)
    turned = Rotation.from_rotvec([0.1, 0.1, 0.1]).apply([0, 0, -2])
    np.testing.assert_allclose(beam.direction, turned, rtol=1e-5)
    x = (jnp.asarray([0.0, 1.0]), jnp.asarray([2.0, 0.0]), jnp.zeros(2))
    lamp, beam, _ = sj.inverse.LightStrengths(step=0.5).moved(pictured, x, None).lights
    expected = [[4, 5 * np.exp(0.5)], [4 * np.exp(1), 5]]
    np.testing.assert_allclose([lamp.intensity, beam.power], expected, rtol=1e-6)


@pytest.mark.once
def test_a_camera_turns_around_the_body():
    middle, part = jnp.asarray([0.5, -1.0, 0.3]), sj.inverse.CameraPoses(turn=0.2, shift=0.5)
    pictured = PicturedScene(sphere(20), CAMERA, ())
    turned, shifted = (
        part.moved(pictured, jnp.asarray(x), middle).camera
        for x in ([[1.0, -2.0, 0.5], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    )
    assert float(jnp.linalg.norm(turned.position - CAMERA.position)) > 1
    was, now = (camera.rotation @ (middle - camera.position) for camera in (CAMERA, turned))
    np.testing.assert_allclose(now, was, atol=1e-5)
    np.testing.assert_allclose(shifted.position - CAMERA.position, [0.5, 1, 1.5], atol=1e-6)
    np.testing.assert_allclose(shifted.rotation, CAMERA.rotation, atol=1e-6)


@pytest.mark.once
def test_an_albedo_stays_between_0_and_1():
    """A coordinate moves the logit by half."""
    albedo = np.linspace(0.0, 1.0, 40).reshape(20, 2)
    splats = with_albedo(sphere(20), albedo)
    part = sj.inverse.AlbedoMap(step=0.5)
    moved = {by: moved_by(part, splats, jnp.full((20, 2), by)).albedo for by in (-1e3, 0, 1, 1e3)}
    assert all(jnp.all((values >= 0) & (values <= 1)) for values in moved.values())
    for by, inner in ((0, slice(1, -1)), (1, slice(10, 11))):
        expected = 1 / (1 + (1 / albedo[inner] - 1) * np.exp(-0.5 * by))
        np.testing.assert_allclose(moved[by][inner], expected, rtol=1e-5 if by else 1e-4)


@pytest.mark.once
def test_normals_and_areas_follow_a_paraboloid():
    x, y, zero = np.asarray(FLAT.centers).T
    heights = 0.3 + 0.1 * x - 0.05 * y + 0.02 * x * x + 0.03 * x * y - 0.01 * y * y
    normals = np.stack([-0.1 - 0.04 * x - 0.03 * y, 0.05 - 0.03 * x + 0.02 * y, zero + 1], axis=1)
    stretch = np.linalg.norm(normals, axis=1)
    part = sj.inverse.NormalOffsets(step=1.0, smoothness=1e-3, deviation=1.0)  # next to no blur
    moved = moved_by(part, FLAT, jnp.asarray(heights, float))
    np.testing.assert_allclose(moved.centers[:, 2], heights, atol=1e-6)
    np.testing.assert_allclose(moved.normals, normals / stretch[:, None], atol=1e-4)
    np.testing.assert_allclose(moved.areas, FLAT.areas * stretch, rtol=1e-4)


@pytest.mark.once
def test_a_ball_that_grows_stays_a_ball():
    ball = sphere(400)
    part = sj.inverse.NormalOffsets(step=0.5, smoothness=2.0, deviation=1.0)
    moved = moved_by(part, ball, jnp.full(400, 2.0))
    np.testing.assert_allclose(jnp.linalg.norm(moved.centers, axis=1), 11.0, rtol=1e-5)
    np.testing.assert_allclose(jnp.sum(moved.normals * ball.normals, axis=1), 1.0, atol=1e-4)
    np.testing.assert_allclose(moved.areas, 1.21 * ball.areas, rtol=2e-2)
    np.testing.assert_allclose(moved.radii, 1.1 * ball.radii, rtol=1e-2)


def test_a_mean_over_too_many_neighbors_is_refused(monkeypatch):
    monkeypatch.setattr("splatjax._memory.free_bytes", lambda: 1e6)
    part = sj.inverse.NormalOffsets(step=0.5, smoothness=30.0, deviation=1.0)
    assert_refused(lambda: part.prepared(sphere(400)), "400 neighbors.*give a smaller smoothness")


@pytest.mark.once
def test_offsets_are_means_of_coordinates_over_the_same_side_of_a_sheet():
    """The prior: coordinates that make offsets of its deviation cost one each."""
    behind = dataclasses.replace(FLAT, centers=FLAT.centers - 0.2 * FLAT.normals)
    behind = dataclasses.replace(behind, normals=-FLAT.normals)
    both = joined(FLAT, behind)
    part = sj.inverse.NormalOffsets(step=0.1, smoothness=1.0, deviation=0.3)
    noise = jnp.asarray(np.random.default_rng(4).normal(size=both.count), float)
    x = noise.at[FLAT.count :].set(0.0)
    before, after, of_noise = (moved_by(part, both, each) for each in (0 * x, x, noise))
    offsets = np.abs(after.centers - before.centers)[:, 2]
    assert 0 < np.max(offsets) < 0.1 * np.max(np.abs(x))
    np.testing.assert_array_equal(offsets[FLAT.count :], 0)
    np.testing.assert_allclose(after.normals[FLAT.count :], behind.normals, atol=1e-6)
    expected = np.sum((of_noise.centers - before.centers) ** 2) / 0.3**2
    found = jnp.sum(part.prior_residuals(noise, part.prepared(both)) ** 2)
    np.testing.assert_allclose(found, expected, rtol=0.15)
