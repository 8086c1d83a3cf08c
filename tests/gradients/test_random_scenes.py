"""Any scene, any loss: if the loss is finite, so is every derivative of it. Contents are drawn,
shapes and plans are fixed.

`make random-scenes` draws 10,000 of them over all shapes, in both precisions; the suite draws 200
over a few.
"""

import dataclasses
import math
import os
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import unit
from hypothesis import HealthCheck, Phase, given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from worlds import FAST, PLAIN, World, named, with_leaf

import splatjax as sj
from splatjax.diffusion import ClusterPlan
from splatjax.diffusion._neighbors import find_neighbors

pytestmark = [pytest.mark.slow, pytest.mark.once]

SCENES = int(os.environ.get("SPLATJAX_RANDOM_SCENES", "200"))
IN_SUITE = 1
SHADOWS = sj.splatting.ShadowSettings(resolution=12, bias=0.4, softness=0.8)
# A hundred times the lists of a typical scene hold all splats in all tiles.
ROOMY = dataclasses.replace(FAST, rasterizer=dataclasses.replace(FAST.rasterizer, spare=100.0))


@dataclasses.dataclass(frozen=True)
class Shape:
    """What a program is compiled for: all that is not drawn."""

    splats: int
    gaussians: int
    # One letter each: d directional, s with shadow; p point, q with shadow, c with shadow among the
    # splats; b beam.
    lights: str
    # a albedo, s specular, r roughness.
    maps: str = ""
    channels: int = 1
    width: int = 9
    height: int = 8
    fast: bool = True
    precision: str = "float32"
    single: bool = False


SHAPES = [
    Shape(12, 1, "q", "a"),
    Shape(9, 1, "c", fast=False, width=5, height=5),
    # Beyond the suite.
    Shape(10, 2, "s", "r", precision="float64"),
    Shape(
        8,
        2,
        "pb",
        "as",
        channels=2,
        fast=False,
        precision="float64",
        single=True,
        width=6,
        height=5,
    ),
    Shape(1, 1, "d"),
    Shape(1, 1, "d", precision="float64"),
    Shape(0, 1, "q"),
    Shape(0, 1, "s", fast=False, precision="float64"),
    Shape(2, 3, "", "a", channels=3),
    Shape(40, 2, "dp", "asr", channels=3, width=20, height=12),
    Shape(40, 2, "dp", "asr", channels=3, width=20, height=12, precision="float64"),
    Shape(30, 6, "sq", "a", channels=3, width=16, height=16),
    Shape(30, 6, "sq", "a", channels=3, width=16, height=16, precision="float64"),
    Shape(16, 2, "c", "a"),
    Shape(16, 2, "c", "a", precision="float64"),
    Shape(25, 1, "b", width=1, height=1),
    Shape(25, 1, "b", width=1, height=1, precision="float64"),
    Shape(12, 1, "d", single=True),
    Shape(12, 1, "d", single=True, precision="float64"),
    Shape(20, 2, "s", "r", fast=False),
    Shape(20, 2, "s", "r", fast=False, precision="float64"),
    Shape(14, 3, "qb", "s", fast=False),
    Shape(14, 3, "qb", "s", fast=False, precision="float64"),
    Shape(3, 1, "ddd", "ar", channels=5),
    Shape(100, 4, "qs", "", channels=3, width=24, height=24),
]


# What is drawn, by how the names of leaves end: from where to where, evenly or in orders of size.
EVENLY = {
    "centers": (-10, 10),
    "splats.albedo": (0, 1),
    "splats.specular": (0, 2),
    "splats.roughness": (0, 2),
    "irradiance": (0, 100),
    "intensity": (0, 100),
    "power": (0, 100),
    "weights": (-0.2, 1),
    "eta": (1, 2),
    "material.specular": (0, 1),
    "material.roughness": (0, 1.2),
    "sigma_a": (0, 2),
    "sigma_s_prime": (1e-3, 2),
    "strength": (0, 1),
    "focal_length": (0.3, 3.3),
    "principal_point": (0, 1),
}
IN_ORDERS = {
    "radii": (1e-3, 30),
    "areas": (1e-4, 100),
    "variances": (1e-3, 1e3),
    "variance": (math.exp(-5), math.exp(5)),
}


@st.composite
def contents(draw, shape: Shape) -> list[np.ndarray]:
    """Numbers for the leaves of a scene of a shape; splats on each other, lights on splats, black
    texels and huge discs are likely.
    """

    def between(low: float, high: float, *size: int):
        low, high = float(np.float32(low)), float(np.float32(high))
        return draw(arrays(np.float64, size, elements=st.floats(low, high, width=32)))

    def directions(*size: int) -> np.ndarray:
        way = between(-1, 1, *size)
        length = np.linalg.norm(way, axis=-1, keepdims=True)
        return np.where(length > 1e-3, way / np.maximum(length, 1e-3), [0.0, 0.0, 1.0])

    numbers = {}

    def place_of(letter: str) -> np.ndarray:
        if letter == "q":  # outside, as planned
            return between(60, 100) * directions(3)
        if shape.splats and draw(st.booleans()):
            return numbers["scene.splats.centers"][draw(st.integers(0, shape.splats - 1))]
        return between(-30, 30, 3)

    for name, leaf in named(typical(shape)).items():
        where, _, field = name.rpartition(".")
        if field in ("normals", "direction"):
            numbers[name] = directions(*leaf.shape)
        elif field in ("position", "origin", "rotation"):
            numbers[name] = place_of(shape.lights[int(where[-1])]) if "lights" in where else None
        elif field in IN_ORDERS:
            numbers[name] = np.exp(between(*np.log(IN_ORDERS[field]), *leaf.shape))
        else:
            ends = next(ends for end, ends in EVENLY.items() if name.endswith(end))
            numbers[name] = between(*ends, *leaf.shape)

    forward = directions(3)
    right = unit(np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))]))
    numbers["camera.rotation"] = np.stack([right, np.cross(forward, right), forward])
    is_towards_splats = draw(st.booleans())
    eye = -between(5, 40) * forward if is_towards_splats else between(-40, 40, 3)
    return list((numbers | {"camera.position": eye}).values())


LAYERS = (
    "beauty",
    "coverage",
    "depth",
    "position",
    "normal",
    "albedo",
    "shadow",
    "irradiance",
    "layers",
    "specular",
)


@cache
def loss_and_gradient(shape: Shape):
    settings = dataclasses.replace(ROOMY if shape.fast else PLAIN, shadows=SHADOWS)
    start = typical(shape)
    plan = sj.make_plan(start.scene, start.camera, settings)
    if shape.fast:
        plan = dataclasses.replace(plan, diffusion=far_reaching(plan.diffusion))

    @jax.jit
    def found(world: World, factors: jax.Array):
        def loss(world: World):
            frame = sj.render(world.scene, world.camera, settings, plan)
            total = jnp.zeros((), world.camera.focal_length.dtype)
            for factor, name in zip(factors, LAYERS, strict=True):
                layer = jnp.where(jnp.isfinite(getattr(frame, name)), getattr(frame, name), 0.0)
                share = np.random.default_rng(len(name)).normal(size=layer.shape)
                total = total + factor * jnp.vdot(jnp.asarray(share, layer.dtype), layer)
            return jnp.where(jnp.isfinite(frame.overflow) & (frame.overflow == 0), total, jnp.nan)

        return jax.value_and_grad(loss)(world)

    return found


@cache
def typical(shape: Shape) -> World:
    """Some scene of the shape, to plan with: light c stands among the splats, the others far
    away.
    """
    count, channels = shape.splats, shape.channels

    def ones(*sizes):
        return jnp.ones(sizes, shape.precision)

    def light(letter: str):
        match letter:
            case "d" | "s":
                return sj.DirectionalLight(-ones(3), ones(channels), cast_shadows=letter == "s")
            case "b":
                return sj.GaussianBeam(ones(3), -ones(3), ones(channels), ones())
            case _:
                place = (0 if letter == "c" else 100) * ones(3)
                return sj.PointLight(place, ones(channels), cast_shadows=letter != "p")

    centers = np.random.default_rng(count).uniform(-5, 5, (count, 3))
    centers = jnp.asarray(centers, shape.precision)
    normals = centers / jnp.linalg.norm(centers, axis=1, keepdims=True)
    maps = {"a": ones(count, channels), "s": ones(count), "r": ones(count)}
    given = (maps[letter] if letter in shape.maps else None for letter in "asr")
    splats = sj.Splats(centers, normals, 2 * ones(count), ones(count), *given)
    variances = 4.0 ** jnp.arange(shape.gaussians, dtype=shape.precision)
    gaussians = sj.SumOfGaussians(variances, ones(shape.gaussians, channels))
    medium = sj.Medium(ones(channels), ones(channels), ones(channels))
    single = sj.SingleScattering(medium, ones(channels)) if shape.single else None
    material = sj.Material(gaussians, single_scattering=single)
    camera = sj.Camera.look_at(20 * ones(3), 0 * ones(3), width=shape.width, height=shape.height)
    camera = dataclasses.replace(camera, principal_point=0.5 * ones(2))
    return World(sj.Scene(splats, tuple(map(light, shape.lights)), material), camera)


FARTHEST = 1e15  # mm, to which all is near


def far_reaching(plan: ClusterPlan) -> ClusterPlan:
    """Let all sources be near all points, whatever the variances."""
    reaches = np.where(np.isfinite(plan.reaches), FARTHEST, 0.0)
    layers = plan.sources.layers
    lists = find_neighbors(plan.point_boxes, plan.source_boxes, layers, reaches.tolist())
    farthest = jnp.full_like(plan.reaches, 10 * FARTHEST)
    margin = jnp.full_like(plan.margin, jnp.inf)
    return dataclasses.replace(plan, lists=lists, reaches=farthest, margin=margin)


def is_finite(shape: Shape, world: World, factors=1.0) -> bool:
    factors = jnp.broadcast_to(jnp.asarray(factors, shape.precision), len(LAYERS))
    loss, gradient = loss_and_gradient(shape)(world, factors)
    wrong = [name for name, leaf in named(gradient).items() if not np.all(np.isfinite(leaf))]
    shown = eqx.tree_pformat(world, short_arrays=False) if wrong else ""
    message = f"the gradient of a loss of {float(loss):g} is not finite in {wrong}, {shown}"
    assert not (np.isfinite(loss) and wrong), message
    return bool(np.isfinite(loss))


@pytest.mark.parametrize("shape", SHAPES if SCENES > 200 else SHAPES[:IN_SUITE], ids=str)
def test_gradients_of_a_finite_loss_are_finite(shape):
    scenes = -(-SCENES // (len(SHAPES) if SCENES > 200 else IN_SUITE))
    finite = []

    @settings(
        max_examples=scenes,
        deadline=None,
        derandomize=True,
        database=None,
        phases=[Phase.generate, Phase.shrink],
        suppress_health_check=list(HealthCheck),
    )
    @given(
        numbers=contents(shape),
        factors=arrays(np.float64, len(LAYERS), elements=st.sampled_from([0.0, 1.0, -2.0])),
    )
    def check(numbers, factors):
        leaves = [jnp.asarray(each, shape.precision) for each in numbers]
        world = jax.tree.unflatten(jax.tree.structure(typical(shape)), leaves)
        finite.append(is_finite(shape, world, factors))

    with jax.enable_x64(shape.precision == "float64"):
        typical(shape)  # which is kept: beartype draws numbers of its own as it is made
        check()
    assert np.mean(finite) > 0.9, f"{len(finite)} scenes, {np.mean(finite):.0%} with a finite loss"


SHAPE = SHAPES[0]  # in float32, on the fast path, a point light with a shadow map
DEGENERATE = {
    "empty picture": {"camera.rotation": [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]},
    "grazing splats": {
        "scene.splats.normals": np.cross([1.0, 1.0, 1.0], [0.3, -1.0, 0.2])
        / np.sqrt(3 * 1.13 - 0.25)
    },
    "splats seen from behind": {"scene.splats.normals": -np.ones(3) / np.sqrt(3)},
    "all splats in one place": {"scene.splats.centers": [0.0, 0.0, 0.0]},
    "black texels": {"scene.splats.albedo": [0.0]},
    "no light": {"scene.lights.0.intensity": [0.0]},
    "splats smaller than anything": {"scene.splats.radii": 1e-6},
    "a splat larger than the picture": {"scene.splats.radii": 40.0},
    "no weight": {"scene.material.gaussians.weights": 0.0},
    "hardly any weight": {"scene.material.gaussians.weights": 1e-36},
    "white": {"scene.material.gaussians.weights": 1.0},
    "equal indices": {"scene.material.eta": 1.0},
    "mirror": {"scene.material.roughness": 0.0},
    "a very narrow layer": {"scene.material.gaussians.variances": 1e-8},
    "a very wide layer": {"scene.material.gaussians.variances": 1e8},
    "the camera in a splat": {
        "camera.position": [0.0, 0.0, 0.0],
        "scene.splats.centers": [0.0, 0.0, 0.02],
    },
}


@pytest.mark.parametrize(
    ("shape", "changes"),
    [pytest.param(SHAPE, changes, id=case) for case, changes in DEGENERATE.items()]
    + [
        pytest.param(Shape(count, 1, lights, fast=False), {}, marks=pytest.mark.long)
        for count, lights in ((0, "d"), (0, "s"), (1, "s"))
    ],
)
def test_gradients_are_finite_at_degenerate_places_and_with_one_splat_or_none(shape, changes):
    world = typical(shape)
    for name, value in changes.items():
        leaf = named(world)[name]
        world = with_leaf(world, name, jnp.broadcast_to(jnp.asarray(value, leaf.dtype), leaf.shape))
    assert is_finite(shape, world)


@pytest.mark.long
@pytest.mark.parametrize("above", [0.0, 1e-14, 1e-7, 1e-5])
def test_gradients_are_finite_with_a_light_on_the_surface(above):
    shape = SHAPES[1]
    world = typical(shape)
    splats = world.scene.splats
    world = with_leaf(world, "scene.splats.centers", splats.centers.at[3].set(0.0))
    world = with_leaf(world, "scene.lights.0.position", above * splats.normals[3])
    assert is_finite(shape, world)
