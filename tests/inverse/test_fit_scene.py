"""What was moved comes back: albedo, lights, cameras, shape. What no picture shows stays."""

import dataclasses
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from bodies import (
    PLAIN,
    assert_close,
    bumpy,
    joined,
    lights_from_two_sides as lights,
    sphere,
    view,
    with_albedo,
)

import splatjax as sj
from splatjax.inverse import _fit_scene
from splatjax.inverse._fit_scene import MovableScene
from splatjax.inverse._observation import Evidence, PicturedScene
from splatjax.scene import rotation_by

SIZE = 16
camera = partial(view, size=SIZE)
FALLS = np.asarray([[[0.5, 2.0], [1.0, 3.0]], [[1.0, 0.3], [2.0, 0.5]]])  # of dye and dirt


def material() -> sj.Material:
    gaussians = sj.SumOfGaussians([0.5, 3.0], [[0.5, 0.3], [0.5, 0.7]])
    return sj.Material(gaussians, eta=1.3, specular=0)


def dyed(dye, dirt) -> sj.SumOfGaussians:
    """The material, with less light where it is dyed."""
    gaussians, (first, second) = material().gaussians, FALLS
    fading = np.exp(-first * (dye - 0.5) - second * dirt)
    return sj.SumOfGaussians(gaussians.variances, gaussians.weights * fading)


def parameter_map() -> sj.inverse.ParameterMap:
    nodes = {"dye": [0.1, 0.3, 0.5, 0.9], "dirt": [-0.3, 0.0, 0.3]}
    with jax.enable_x64(True):
        table = sj.fitting.weight_table(dyed, nodes, material().gaussians)
        return sj.inverse.ParameterMap(table, {"dye": 0.5, "dirt": 0.0}, smoothness=0.5)


PARTS = (
    parameter_map(),
    sj.inverse.AlbedoMap(step=0.2),
    sj.inverse.NormalOffsets(step=0.02, smoothness=2.0, deviation=0.5),
    sj.inverse.LightStrengths(),
    sj.inverse.LightPlaces(),
    sj.inverse.CameraPoses(turn=4e-3),
)


@cache
def body() -> sj.Splats:
    """A bumpy ball with a map, and one on either side that no picture shows."""
    aside = [sphere(12, 4.0, center=(x, 0.0, 0.0)) for x in (-60.0, 60.0)]
    splats = joined(bumpy(100), *aside)
    albedo = np.random.default_rng(2).uniform(0.3, 0.9, (splats.count, 2))
    return dataclasses.replace(with_albedo(splats, albedo), weights=np.ones((splats.count, 2, 2)))


def evaluate(splats: sj.Splats, light: sj.DirectionalLight, picture=0.0, x=None):
    """Evaluate a picture by the program that all fits of this file run."""
    scene, pictured = (
        MovableScene.of(splats, material(), PARTS),
        PicturedScene(splats, camera(), (light,)),
    )
    picture = np.broadcast_to(picture, (SIZE, SIZE, 2))
    evidence = Evidence.of(sj.inverse.Observation(picture, camera(), light), jnp.zeros(()).dtype)
    plan = sj.make_plan(sj.Scene(splats, light, material()), camera(), PLAIN)
    x = scene.of_picture(scene.start([pictured]), 0) if x is None else x
    settings = PLAIN, sj.inverse.SquaredLoss(), sj.inverse.BlackBackground()
    return _fit_scene.evaluate(x, scene, pictured, evidence, plan, *settings)


def observations(shots=None, x=None, **more) -> list[sj.inverse.Observation]:
    """Pictures of the body, or of it at coordinates, under each light; declared as taken otherwise,
    if that is given.
    """
    pictures = [np.asarray(evaluate(body(), light, x=x).beauty) for light in lights()]
    shots = [(camera(), (light,)) for light in lights()] if shots is None else shots
    return [
        sj.inverse.Observation(picture, *shot, **more)
        for picture, shot in zip(pictures, shots, strict=True)
    ]


def chosen(kinds, coordinates):
    return tuple(
        own if isinstance(part, kinds) else jax.tree.map(jnp.zeros_like, own)
        for part, own in zip(PARTS, coordinates, strict=True)
    )


def fitted(
    *kinds: type, steps: int, seen=None, splats=None, optimizer=None, **more
) -> sj.inverse.FittedScene:
    """Fit some kinds of parts. Nothing else moves: all fits of this file run one compiled
    picture.
    """
    kept = optax.stateless(lambda updates, params: chosen(kinds, updates))
    adam = optax.adam(optax.cosine_decay_schedule(2.0, steps), b2=0.9)
    optimizer = optax.chain(kept, adam if optimizer is None else optimizer, kept)
    seen = observations() if seen is None else seen
    splats = body() if splats is None else splats
    return sj.inverse.fit_scene(
        seen,
        splats,
        material(),
        PARTS,
        optimizer,
        steps=steps,
        background=sj.inverse.BlackBackground(),
        settings=PLAIN,
        **more,
    )


def seen_well(splats: sj.Splats) -> np.ndarray:
    way = np.asarray(camera().position) - np.asarray(splats.centers)
    facing = np.sum(way * np.asarray(splats.normals), axis=1) / np.linalg.norm(way, axis=1)
    return (facing > 0.5) & (np.abs(np.asarray(splats.centers)[:, 0]) < 20)


def degrees(a, b) -> np.ndarray:
    cosine = np.sum(np.asarray(a) * np.asarray(b), axis=-1)
    return np.degrees(
        np.arccos(np.clip(cosine / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1), -1, 1))
    )


@pytest.mark.slow
@pytest.mark.once
@pytest.mark.usefixtures("double")
class TestFitScene:
    @pytest.mark.parametrize("kind", [type(part) for part in PARTS])
    def test_gradients_are_those_of_finite_differences(self, kind):
        step, rng = 1e-5, np.random.default_rng(5)
        gray, light = with_albedo(body(), np.full(body().albedo.shape, 0.5)), lights()[0]
        picture = observations()[0].picture
        zeros = evaluate(gray, light, picture).gradient
        begin, way = (
            jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), zeros)
            for _ in range(2)
        )
        way = chosen(kind, way)

        def evaluation(by: float):
            moved = jax.tree.map(lambda leaf, along: leaf + by * along, begin, way)
            return evaluate(gray, light, picture, moved)

        slopes = jax.tree.map(jnp.vdot, evaluation(0.0).gradient, way)
        expected = (evaluation(step).loss - evaluation(-step).loss) / (2 * step)
        assert abs(float(sum(jax.tree.leaves(slopes)) / expected) - 1) < 1e-5

    def test_what_is_right_stays_put_and_nothing_is_compiled_between_steps(self, compiled):
        counts = []
        found = fitted(
            *map(type, PARTS),
            steps=4,
            progress=lambda message, loss: counts.append(len(compiled)),
        )
        assert counts[0] < counts[2]  # the listener hears what the first step compiles
        assert counts[2] == counts[-1]
        assert found.losses[0] < 1e-20
        assert found.best == 0
        assert_close(found.splats, body(), atol=1e-12)

    def test_an_albedo_map_comes_back_and_splats_unseen_do_not_move(self):
        gray = with_albedo(body(), np.full(body().albedo.shape, 0.5))
        found = fitted(sj.inverse.AlbedoMap, steps=60, splats=gray)
        seen, unseen = seen_well(gray), np.abs(np.asarray(gray.centers)[:, 0]) > 20
        errors = np.abs(np.asarray(found.splats.albedo - body().albedo))
        assert np.median(errors[seen]) < 0.03
        np.testing.assert_allclose(found.splats.albedo[unseen], 0.5, atol=1e-12)

    def test_a_map_of_parameters_comes_back_and_splats_unseen_do_not_move(self):
        x, y, _ = np.asarray(body().centers).T
        true = {"dye": 0.4 + 0.2 * np.sin(x / 3), "dirt": 0.15 * np.cos(y / 3)}
        part, pictured = PARTS[0], PicturedScene(body(), camera(), (lights()[0],))
        zeros = MovableScene.of(body(), material(), PARTS).start([pictured])
        # Coordinates of the truth: a blur so narrow that it changes nothing.
        tables = part.prepared(body())
        fractions = np.asarray(part.table.fractions(true))
        logits = np.log(fractions / (1 - fractions)) - np.asarray(tables.start)
        own = np.linalg.solve(np.asarray(tables.steps), logits[..., None])[..., 0]
        seen = observations(x=(jnp.asarray(own), *zeros[1:3], *(one[0] for one in zeros[3:])))
        lbfgs = optax.chain(optax.lbfgs(1.0, memory_size=50, linesearch=None), optax.clip(3.0))
        near = fitted(sj.inverse.ParameterMap, steps=20, seen=seen)
        found = fitted(
            sj.inverse.ParameterMap,
            steps=80,
            seen=seen,
            optimizer=lbfgs,
            start=near.restarted(),
        )
        assert found.losses[found.best] < 0.1 * near.losses[near.best]
        visible, unseen = seen_well(body()), np.abs(x) > 20
        for name, begin in part.start.items():
            before, after = (
                np.median(np.abs(values - true[name])[visible])
                for values in (begin, np.asarray(found.maps[name]))
            )
            assert after < 0.5 * before, (name, after, before, found.losses[::10])
            np.testing.assert_allclose(found.maps[name][unseen], begin, atol=1e-12)

    def test_lights_come_back(self):
        off = [(0.7, [-1.0, -0.2, -0.5]), (1.3, [0.7, 0.0, -0.7])]
        begin = [
            (camera(), sj.DirectionalLight(way, light.irradiance * factor, cast_shadows=False))
            for light, (factor, way) in zip(lights(), off, strict=True)
        ]
        found = fitted(
            sj.inverse.LightStrengths, sj.inverse.LightPlaces, steps=60, seen=observations(begin)
        )
        for (ours,), true in zip(found.lights, lights(), strict=True):
            assert degrees(ours.direction, true.direction) < 2  # 14 at the start
            np.testing.assert_allclose(ours.irradiance, true.irradiance, rtol=3e-2)

    def test_a_camera_comes_back(self):
        right = camera()
        turned = rotation_by(jnp.asarray([0.03, -0.04, 0.02]))
        position = turned @ right.position + jnp.asarray([0.4, -0.3, 1.0])
        off = eqx.tree_at(
            lambda c: (c.position, c.rotation), right, (position, right.rotation @ turned.T)
        )
        found = fitted(
            sj.inverse.CameraPoses,
            steps=80,
            seen=observations([(off, (light,)) for light in lights()]),
        )
        for ours in found.cameras:
            assert np.linalg.norm(ours.position - right.position) < 0.2  # mm; 2.4 at the start
            assert np.max(degrees(ours.rotation, right.rotation)) < 0.3  # 3 at the start
            np.testing.assert_allclose(ours.rotation @ ours.rotation.T, np.eye(3), atol=1e-12)

    def test_a_shape_comes_back(self):
        part, pictured = PARTS[2], PicturedScene(body(), camera(), (lights()[0],))
        zeros = MovableScene.of(body(), material(), PARTS).start([pictured])
        x = jnp.asarray(60 * np.random.default_rng(4).normal(size=body().count))
        dented = part.moved(pictured, x, part.prepared(body())).splats
        own = (*zeros[:2], x, *(one[0] for one in zeros[3:]))
        found = fitted(sj.inverse.NormalOffsets, steps=150, seen=observations(x=own))
        before, after = (
            degrees(each.normals, dented.normals)[seen_well(dented)]
            for each in (body(), found.splats)
        )
        assert np.median(before) > 3
        assert np.median(after) < 0.4 * np.median(before)
        np.testing.assert_allclose(jnp.linalg.norm(found.splats.normals, axis=1), 1, atol=1e-12)
