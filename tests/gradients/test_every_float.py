"""The gradient of a whole picture in every float of scene and camera, against central differences,
in float64.

A step must change neither which splats are visible nor which surface a shadow map sees; at 1e-6 of
a parameter's scale the chosen directions do not.

Gradients where things end: silhouettes against nothing and over a surface, edges of shadows. The
picture is smooth there. Against central differences, and over a way as long as a pixel: what the
gradients along it add up to is what the picture does. That leaves little to the jumps that have no
gradient, of fragments that enter or leave the front surface.
"""

import dataclasses
import re
from functools import cache

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from worlds import FAST, WORLDS, World, fields_of, named, uneven, view, with_leaf

import splatjax as sj

pytestmark = [
    pytest.mark.slow,
    pytest.mark.once,
    pytest.mark.usefixtures("double"),
]  # in float64 whatever the precision of the run

STEP = 1e-6  # of a parameter's own scale
AGREEMENT = 1e-5  # relative; rounding over the step leaves about 1e-9
LONG = {
    ("lamp and maps", "plain"),
    ("lamp inside", "plain"),
    ("sun and beam", "plain"),
    ("ball over sheet", "plain"),
    ("solved body", "solved"),
    ("extended lights", "plain"),
}  # what they add to the others, long tests show
RECORDS = [
    pytest.param(world, path, name, marks=[pytest.mark.long] if (world, path) in LONG else [])
    for world, small in WORLDS.items()
    for path in small.paths
    for name in named(jax.eval_shape(small.make))
    if path != "solved" or "gaussians" not in name  # in whose place the medium is read
]


def test_every_float_is_covered():
    """A new field, and a new light, is to be given to one of the worlds."""
    worlds = [small.make() for small in WORLDS.values()]
    fields = {field for world in worlds for field in fields_of(world)}
    labels = {"Material.wavelengths"}  # on which no picture depends
    assert {name for name, is_given in fields if is_given} == {name for name, _ in fields} - labels
    exported = [each for each in vars(sj.scene).values() if isinstance(each, type)]
    lights = {each for each in exported if issubclass(each, sj.scene.AbstractLight)}
    lights = {each for each in lights if not re.match("Abstract|.*Stratum", each.__name__)}
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
    way = np.random.default_rng(len(name)).normal(size=leaf.shape)
    if name.endswith("normals"):  # they are unit vectors: turn them
        normals = np.asarray(leaf)
        way -= np.sum(way * normals, axis=1, keepdims=True) * normals
    return jnp.asarray(way * np.mean(np.abs(leaf)))


@pytest.mark.parametrize(("world", "path", "name"), RECORDS)
def test_gradient_is_that_of_central_differences(world, path, name):
    start, gradient, value = rendered(world, path)
    leaf, derivative = named(start)[name], np.asarray(named(gradient)[name])
    assert np.all(np.isfinite(derivative))
    way = direction_of(name, leaf)
    ends = [value(with_leaf(start, name, leaf + step * way)) for step in (STEP, -STEP)]
    difference = (ends[0] - ends[1]) / (2 * STEP)
    expected = np.vdot(derivative, way)
    assert abs(difference) > 1e-7
    np.testing.assert_allclose(expected, difference, rtol=AGREEMENT)


PATHS_AGREE = 0.02  # of the norm: the support of the Gaussians, and clusters
CENTERS_AGREE = 0.1  # where every splat moves through the window of what is in front


def differences(found: World, expected: World) -> dict[str, float]:
    def error(ours, theirs):
        theirs = np.asarray(theirs)
        return float(np.linalg.norm(np.asarray(ours, float) - theirs) / np.linalg.norm(theirs))

    return named(jax.tree.map(error, found, expected))


@pytest.mark.long
def test_fast_and_plain_gradients_agree():
    errors = differences(*(rendered("lamp and maps", path)[1] for path in ("fast", "plain")))
    for name, error in errors.items():
        assert error < (CENTERS_AGREE if "centers" in name or "camera" in name else PATHS_AGREE), (
            errors
        )


IN_FLOAT32 = 1e-4  # of the norm; 3e-5 measured, 5e-6 but for the specular strength


@pytest.mark.parametrize(
    ("world", "path"),
    [
        ("scattered once", "plain"),
        pytest.param("lamp and maps", "plain", marks=pytest.mark.long),
        pytest.param("lamp and maps", "fast", marks=pytest.mark.long),
    ],
)
def test_float32_gradients_are_those_of_float64(world, path):
    single, double = rendered(world, path, jnp.float32)[1], rendered(world, path)[1]
    assert {leaf.dtype for leaf in jax.tree.leaves(single)} == {jnp.dtype(jnp.float32)}
    errors = differences(single, double)
    assert max(errors.values()) < IN_FLOAT32, errors


SIZE = 32
EDGES_AGREE = 1e-3
OVER_A_PIXEL = 1e-2
EDGE_STEP = 1e-4  # mm
POINTS = 16  # along a way
BALL = 4.5


@cache
def moved_apart():
    """A ball over a sheet that ends within the picture: a function of how far the ball, the sheet
    and the light are moved, which gives a weighed sum of beauty, the frame, and the gradient.

    All in one program: each takes its time to compile.
    """
    sheet = bodies.sheet(8.0, 1.2, center=(-2.7, 0.2, -6.0))
    body = uneven(bodies.joined(sheet, bodies.sphere(500, BALL, (1.0, 0.5, 4.0))))
    light = sj.DirectionalLight([-0.5, -0.3, -1.0], [2.0, 3.0])
    scene = sj.Scene(body, (light,), sj.Material(sj.SumOfGaussians([0.5], [[0.5, 0.3]])))
    camera = view((3.0, 2.0, 40.0), 30.0, SIZE)
    # The plain path gives the same digits here, in twice the time. Of the diffuser, nothing is
    # tested.
    settings = dataclasses.replace(FAST, diffuser=sj.diffusion.DenseDiffuser())
    plan = sj.make_plan(scene, camera, settings)
    is_sheet, way = (jnp.arange(body.count) < sheet.count)[:, None], jnp.asarray([[1.0, 0.3, 0.0]])

    def summed(moved, share):
        centers = body.centers + jnp.where(is_sheet, moved[1], moved[0]) * way
        direction = light.direction.at[1].add(moved[2])
        lit = (dataclasses.replace(light, direction=direction),)
        there = sj.Scene(dataclasses.replace(body, centers=centers), lit, scene.material)
        frame = sj.render(there, camera, settings, plan)
        return jnp.sum(share * frame.beauty), frame

    return jax.jit(jax.value_and_grad(summed, has_aux=True))


def edges(frame: sj.Frame) -> dict[str, np.ndarray]:
    given = frame.depth, frame.coverage, frame.shadow[0]
    depth, coverage, shadow = (np.asarray(each) for each in given)
    front = np.where(np.isfinite(depth), depth, 0)
    steep, inside = np.hypot(*np.gradient(front)) > 2, coverage == 1
    on_sheet = (front > 44) & ~steep & inside
    return {
        "outer": (coverage > 0) & ~inside,
        "inner": steep & inside & ~binary_dilation(coverage == 0, iterations=2),
        "shadow": (shadow > 0.05) & (shadow < 0.95) & on_sheet,
    }


# What is looked at, what moves (ball, sheet, light), and how far: a pixel is 0.67 mm at the ball;
# the shadow falls 10 mm deep.
CASES = {
    "outer-sheet": ("outer", 1, 0.67),
    "inner-ball": ("inner", 0, 0.67),
    "shadow-ball": ("shadow", 0, 0.67),
    "shadow-light": ("shadow", 2, 0.067),
}


@pytest.mark.parametrize("case", CASES)
def test_edges_move_as_their_gradient_says(case):
    where, which, far = CASES[case]
    found = moved_apart()
    (_, frame), _ = found(jnp.zeros(3), jnp.zeros((SIZE, SIZE, 2)))
    mask = edges(frame)[where]
    assert np.sum(mask) >= 15
    share = jnp.asarray(
        mask[..., None] * np.random.default_rng(3).uniform(-0.5, 1, (SIZE, SIZE, 2))
    )
    way = np.eye(3)[which]

    def at(t):
        (value, _), gradient = found(jnp.asarray(t * way), share)
        return float(value), float(gradient[which])

    start, slope = at(0.0)
    difference = (at(EDGE_STEP)[0] - at(-EDGE_STEP)[0]) / (2 * EDGE_STEP)
    np.testing.assert_allclose(slope, difference, rtol=EDGES_AGREE)
    slopes = [at((i + 0.5) / POINTS * far)[1] for i in range(POINTS)]
    moved, followed = at(far)[0] - start, far * np.mean(slopes)
    assert abs(moved) > 0.01 * abs(start)
    allowed = OVER_A_PIXEL * far * np.mean(np.abs(slopes))
    assert abs(followed - moved) < allowed, (followed, moved)
