"""The gradient of a whole picture in every float of scene and camera, against central differences,
in float64.

A step must change neither which splats are visible nor which surface a shadow map sees; at 1e-6 of
a parameter's scale the chosen directions do not. What the picture does over longer ways is in
`test_edges.py`.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evidence import write_evidence
from PIL import Image
from worlds import PLAIN, WORLDS, World, fields_of, named, with_leaf

import splatjax as sj
from splatjax.scene import AbstractLight

pytestmark = [pytest.mark.slow, pytest.mark.once]  # in float64 whatever the precision of the run

STEP = 1e-6  # of a parameter's own scale
AGREEMENT = 1e-5  # relative; rounding over the step leaves about 1e-9
LONG = "lamp inside", "sun and beam"  # what they add to the other worlds, long tests show
RECORDS = [
    pytest.param(world, path, name, marks=[pytest.mark.long] if world in LONG else [])
    for world, small in WORLDS.items()
    for path in small.paths
    for name in named(jax.eval_shape(small.make))
]


def test_every_float_is_covered():
    """A new field, and a new light, is to be given to one of the worlds."""
    worlds = [small.make() for small in WORLDS.values()]
    fields = {field for world in worlds for field in fields_of(world)}
    assert {name for name, is_given in fields if is_given} == {name for name, _ in fields}
    exported = [each for each in vars(sj).values() if isinstance(each, type)]
    lights = {each for each in exported if issubclass(each, AbstractLight)}
    assert lights == {type(light) for world in worlds for light in world.scene.lights}


def loss(frame: sj.Frame) -> jax.Array:
    """A mean of `beauty` with weights of both signs: nothing cancels by symmetry."""
    share = np.random.default_rng(5).uniform(-0.5, 1.0, frame.beauty.shape)
    return jnp.mean(jnp.asarray(share, frame.beauty.dtype) * frame.beauty)


@cache
def rendered(world: str, path: str, precision=jnp.float64):
    """A world, the gradient of its loss, and a function that gives the loss; kept by its arguments
    as they are spelled.
    """
    start, settings = WORLDS[world].make(), WORLDS[world].paths[path]
    start = jax.tree.map(lambda leaf: leaf.astype(precision), start)
    plan = sj.make_plan(start.scene, start.camera, settings)

    @jax.jit
    def loss_and_gradient(world: World):
        def value(world: World):
            frame = sj.render(world.scene, world.camera, settings, plan)
            return loss(frame), frame.overflow

        return jax.value_and_grad(value, has_aux=True)(world)

    (_, overflow), gradient = loss_and_gradient(start)
    assert float(overflow) == 0
    return start, gradient, lambda world: float(loss_and_gradient(world)[0][0])


def direction_of(name: str, leaf: jax.Array) -> jax.Array:
    """A random way to go, in the parameter's own scale."""
    way = np.random.default_rng(len(name)).normal(size=leaf.shape)
    if name.endswith("normals"):  # they are unit vectors: turn them
        normals = np.asarray(leaf)
        way -= np.sum(way * normals, axis=1, keepdims=True) * normals
    return jnp.asarray(way * np.mean(np.abs(leaf)))


@pytest.mark.parametrize(("world", "path", "name"), RECORDS)
def test_gradient_is_that_of_central_differences(world, path, name):
    with jax.enable_x64(True):
        start, gradient, value = rendered(world, path)
        leaf, derivative = named(start)[name], np.asarray(named(gradient)[name])
        assert np.all(np.isfinite(derivative))
        way = direction_of(name, leaf)
        ends = [value(with_leaf(start, name, leaf + step * way)) for step in (STEP, -STEP)]
        difference = (ends[0] - ends[1]) / (2 * STEP)
        expected = np.vdot(derivative, way)
        assert abs(difference) > 1e-7
        if not np.isclose(expected, difference, rtol=AGREEMENT, atol=0):
            where = write_evidence(f"{world} {path} {name}", start, name, way, STEP)
            pytest.fail(
                f"gradient along {name}: {expected:.12g}, by differences {difference:.12g}; see "
                f"{where}"
            )


PATHS_AGREE = 0.02  # of the norm: the support of the Gaussians, and clusters
CENTERS_AGREE = 0.1  # where every splat moves through the window of what is in front


def differences(found: World, expected: World) -> dict[str, float]:
    """Of gradients, in shares of the norm."""
    pairs = {
        name: (np.asarray(named(found)[name], float), np.asarray(each))
        for name, each in named(expected).items()
    }
    return {
        name: float(np.linalg.norm(a - b) / np.linalg.norm(b)) for name, (a, b) in pairs.items()
    }


def test_fast_and_plain_gradients_agree():
    with jax.enable_x64(True):
        errors = differences(*(rendered("lamp and maps", path)[1] for path in ("fast", "plain")))
    print({name: f"{error:.1e}" for name, error in errors.items()})
    for name, error in errors.items():
        assert error < (CENTERS_AGREE if "centers" in name or "camera" in name else PATHS_AGREE), (
            errors
        )


IN_FLOAT32 = 1e-4  # of the norm; 3e-5 measured, 5e-6 but for the specular strength


@pytest.mark.parametrize("path", ["plain", pytest.param("fast", marks=pytest.mark.long)])
def test_float32_gradients_are_those_of_float64(path):
    with jax.enable_x64(True):
        single, double = (
            rendered("lamp and maps", path, jnp.float32)[1],
            rendered("lamp and maps", path)[1],
        )
        assert {leaf.dtype for leaf in jax.tree.leaves(single)} == {jnp.dtype(jnp.float32)}
        errors = differences(single, double)
    print({name: f"{error:.1e}" for name, error in errors.items()})
    assert max(errors.values()) < IN_FLOAT32, errors


def test_forward_mode_of_the_plain_path_is_its_reverse_mode():
    with jax.enable_x64(True):
        start, gradient, _ = rendered("sun and beam", "plain")
        plan = sj.make_plan(start.scene, start.camera, PLAIN)
        rng = np.random.default_rng(21)
        tangent = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), start)

        @jax.jit
        def forward(world: World, tangent: World):
            return jax.jvp(
                lambda w: loss(sj.render(w.scene, w.camera, PLAIN, plan)), (world,), (tangent,)
            )[1]

        products = jax.tree.map(lambda g, t: float(jnp.vdot(g, t)), gradient, tangent)
        found, expected = float(forward(start, tangent)), sum(jax.tree.leaves(products))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_a_wrong_gradient_leaves_pictures(tmp_path, monkeypatch):
    """Derivatives by differences and in forward mode look alike: what is between them is blank."""
    monkeypatch.chdir(tmp_path)
    with jax.enable_x64(True):
        start = WORLDS["sun and beam"].make()
        name = "scene.lights.0.direction"
        path = write_evidence("sun", start, name, direction_of(name, named(start)[name]), STEP)
    pixels = np.asarray(Image.open(path).convert("RGB"), float)
    picture, by_differences, forward, between = np.split(pixels, 4)
    assert np.ptp(picture) > 200
    assert np.ptp(by_differences) > 200
    assert np.max(np.abs(by_differences - forward)) <= 1
    assert np.min(between) >= 253
