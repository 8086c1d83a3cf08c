"""Any scene, any loss: if the loss is finite, so is every derivative of it. Contents are drawn,
shapes and plans are fixed.

`make random-scenes` draws 10,000 of them over all shapes, in both precisions; the suite draws 200
over a few.
"""

import dataclasses
import math
import os
from collections.abc import Callable
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from worlds import World, named, with_leaf

import splatjax as sj
from splatjax.diffusion import DenseDiffuser
from splatjax.diffusion._clustered import LayerPlan
from splatjax.diffusion._neighbors import Boxes, Neighbors, find_neighbors
from splatjax.splatting import DenseRasterizer, ShadowSettings
from splatjax.splatting._bins import BinCapacity
from splatjax.splatting._grid import TileGrid
from splatjax.splatting._rasterizer import Places
from splatjax.splatting._tiles import TilePlan

pytestmark = [pytest.mark.slow, pytest.mark.once]

SCENES = int(os.environ.get("SPLATJAX_RANDOM_SCENES", "200"))
IN_SUITE = 2
SHADOWS = ShadowSettings(resolution=12, bias=0.4, softness=0.8)


@dataclasses.dataclass(frozen=True)
class Shape:
    """What a program is compiled for: all that is not drawn."""

    splats: int
    gaussians: int
    lights: str
    """One letter each: d directional, s with shadow; p point, q with shadow, c with shadow among
    the splats; b beam.
    """
    maps: str = ""
    """a albedo, s specular, r roughness."""
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


def number(low: float, high: float):
    return st.floats(float(np.float32(low)), float(np.float32(high)), width=32)


def rows(shape: tuple[int, ...], low: float, high: float):
    return arrays(np.float64, shape, elements=number(low, high))


@st.composite
def worlds(draw, shape: Shape) -> Callable[[], World]:
    """What makes a scene of a shape; splats on each other, lights on splats, black texels and huge
    discs are likely.
    """
    count, channels = shape.splats, shape.channels

    def directions(*leading: int) -> np.ndarray:
        way = draw(rows((*leading, 3), -1, 1))
        length = np.linalg.norm(way, axis=-1, keepdims=True)
        return np.where(length > 1e-3, way / np.maximum(length, 1e-3), [0.0, 0.0, 1.0])

    centers = draw(rows((count, 3), -10, 10))
    radii = np.exp(draw(rows((count,), math.log(1e-3), math.log(30))))
    areas = np.exp(draw(rows((count,), math.log(1e-4), math.log(100))))
    albedo = draw(rows((count, channels), 0, 1)) if "a" in shape.maps else None
    specular = draw(rows((count,), 0, 2)) if "s" in shape.maps else None
    roughness = draw(rows((count,), 0, 2)) if "r" in shape.maps else None
    discs = (centers, directions(count), radii, areas, albedo, specular, roughness)

    def position() -> np.ndarray:
        if count and draw(st.booleans()):
            return centers[draw(st.integers(0, count - 1))]
        return draw(rows((3,), -30, 30))

    def light(letter: str):
        power = draw(rows((channels,), 0, 100))
        if letter in "ds":
            return letter, directions(), power
        if letter == "q":  # outside, as planned
            return letter, (60 + 40 * draw(number(0, 1))) * directions(), power
        if letter in "pc":
            return letter, position(), power
        return letter, position(), directions(), power, math.exp(draw(number(-5, 5)))

    lamps = [light(letter) for letter in shape.lights]
    medium = [draw(rows((channels,), 0, high)) for high in (2, 2, 1, 1)] if shape.single else None
    variances = np.exp(draw(rows((shape.gaussians,), math.log(1e-3), math.log(1e3))))
    weights = draw(rows((shape.gaussians, channels), -0.2, 1))
    surface = [1 + draw(number(0, 1)), draw(number(0, 1)), draw(number(0, 1.2))]

    eye, forward = draw(rows((3,), -40, 40)), directions()
    helper = np.eye(3)[np.argmin(np.abs(forward))]
    right = np.cross(forward, helper)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    if draw(st.booleans()):  # towards the splats
        eye = -(5 + 35 * draw(number(0, 1))) * forward
    focal_length = 0.3 + draw(number(0, 3))

    def made() -> World:
        def numbers(*drawn):
            return [None if each is None else jnp.asarray(each, shape.precision) for each in drawn]

        def lamp(letter, *drawn):
            if letter == "b":
                return sj.GaussianBeam(*numbers(*drawn))
            return (sj.DirectionalLight if letter in "ds" else sj.PointLight)(
                *numbers(*drawn), cast_shadows=letter in "sqc"
            )

        single = None
        if medium is not None:
            sigma_a, sigma_s_prime, more, strength = numbers(*medium)
            single = sj.SingleScattering(
                sj.Medium(sigma_a, sigma_s_prime + 1e-3, 1 + more), strength
            )
        material = sj.Material(
            sj.SumOfGaussians(*numbers(variances, weights)), *numbers(*surface), single
        )
        camera = sj.Camera(*numbers(eye, rotation, focal_length), shape.width, shape.height)
        return World(
            sj.Scene(sj.Splats(*numbers(*discs)), tuple(lamp(*each) for each in lamps), material),
            camera,
        )

    return made


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
    """Compiled once per shape, with room for every splat everywhere."""
    settings = sj.RenderSettings(shadows=SHADOWS)
    if not shape.fast:
        settings = sj.RenderSettings(
            shadows=SHADOWS, rasterizer=DenseRasterizer(), diffuser=DenseDiffuser()
        )
    plan = roomy(sj.make_plan(*typical(shape), settings), shape)

    @jax.jit
    def found(world: World, factors: jax.Array):
        def loss(world: World):
            frame = sj.render(world.scene, world.camera, settings, plan)
            total = jnp.zeros((), world.camera.focal_length.dtype)
            for factor, name in zip(factors, LAYERS, strict=True):
                layer = getattr(frame, name)
                share = jnp.asarray(
                    np.random.default_rng(len(name)).normal(size=layer.shape), layer.dtype
                )
                total = total + factor * jnp.sum(share * jnp.where(jnp.isfinite(layer), layer, 0.0))
            return jnp.where(jnp.isfinite(frame.overflow) & (frame.overflow == 0), total, jnp.nan)

        return jax.value_and_grad(loss)(world)

    return found


def typical(shape: Shape) -> tuple[sj.Scene, sj.Camera]:
    """Some scene of the shape, to plan with: light c stands among the splats, the others far
    away.
    """
    count, channels = shape.splats, shape.channels
    rng = np.random.default_rng(count)

    def ones(*sizes):
        return jnp.ones(sizes, shape.precision)

    def light(letter: str):
        if letter in "ds":
            return sj.DirectionalLight(-ones(3), ones(channels), cast_shadows=letter == "s")
        if letter in "pqc":
            return sj.PointLight(
                (0 if letter == "c" else 100) * ones(3), ones(channels), cast_shadows=letter != "p"
            )
        return sj.GaussianBeam(ones(3), -ones(3), ones(channels), ones())

    centers = jnp.asarray(rng.uniform(-5, 5, (count, 3)), shape.precision)
    normals = centers / jnp.linalg.norm(centers, axis=1, keepdims=True)
    maps = (ones(count, channels), ones(count), ones(count))
    maps = [
        each if letter in shape.maps else None for letter, each in zip("asr", maps, strict=True)
    ]
    splats = sj.Splats(centers, normals, 2 * ones(count), ones(count), *maps)
    gaussians = sj.SumOfGaussians(
        4.0 ** jnp.arange(shape.gaussians, dtype=shape.precision), ones(shape.gaussians, channels)
    )
    single = None
    if shape.single:
        single = sj.SingleScattering(
            sj.Medium(ones(channels), ones(channels), ones(channels)), ones(channels)
        )
    camera = sj.Camera.look_at(20 * ones(3), 0 * ones(3), width=shape.width, height=shape.height)
    scene = sj.Scene(
        splats, tuple(map(light, shape.lights)), sj.Material(gaussians, single_scattering=single)
    )
    return scene, camera


def roomy(plan: sj.Plan, shape: Shape) -> sj.Plan:
    """Give every list room for everything, and every layer any variance."""

    def widened(part):
        if isinstance(part, TilePlan):
            of_camera = part is plan.raster
            size = (shape.width, shape.height) if of_camera else (SHADOWS.resolution,) * 2
            rasterizer = part.rasterizer
            tiles = TileGrid(*size, rasterizer.lanes).tiles
            room = _room(shape.splats, tiles, rasterizer.lanes, rasterizer.slots)
            places = Places(tiles, tiles)
            return TilePlan(rasterizer, max(shape.splats, 1), BinCapacity(*room), places)
        if isinstance(part, LayerPlan):
            none, endless = jnp.zeros(()), jnp.full((), jnp.inf)
            return LayerPlan(part.level, part.support, none, endless, far_reaching(part.neighbors))
        return part

    return jax.tree.map(widened, plan, is_leaf=lambda part: isinstance(part, TilePlan | LayerPlan))


FARTHEST = 1e15  # mm, to which all is near


def far_reaching(neighbors: Neighbors | None) -> Neighbors | None:
    if neighbors is None:
        return None

    def anywhere(boxes: Boxes) -> Boxes:
        return Boxes(jnp.full_like(boxes.low, -FARTHEST), jnp.full_like(boxes.high, FARTHEST))

    boxes = anywhere(neighbors.points), anywhere(neighbors.sources)
    return Neighbors(find_neighbors(*boxes, 10 * FARTHEST), *boxes, jnp.asarray(10 * FARTHEST))


def _room(items: int, tiles: int, lanes: int, slots: int) -> tuple[int, int, int]:
    """Pairs, blocks and chunks when every tile lists every item."""
    chunks = -(-tiles // lanes)
    return max(1024, -(-items * tiles // 1024) * 1024), chunks * max(-(-items // slots), 1), chunks


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
        make=worlds(shape),
        factors=arrays(np.float64, len(LAYERS), elements=st.sampled_from([0.0, 1.0, -2.0])),
    )
    def check(make, factors):
        world = make()
        loss, gradient = loss_and_gradient(shape)(world, jnp.asarray(factors, shape.precision))
        finite.append(bool(jnp.isfinite(loss)))
        if finite[-1]:
            wrong = [
                name
                for name, leaf in named(gradient).items()
                if not np.all(np.isfinite(np.asarray(leaf)))
            ]
            shown = eqx.tree_pformat(world, short_arrays=False) if wrong else ""
            assert not wrong, (
                f"the gradient of a loss of {float(loss):g} is not finite in {wrong}, of {shown}"
            )

    with jax.enable_x64(shape.precision == "float64"):
        check()
    print(f"{len(finite)} scenes, {np.mean(finite):.0%} with a finite loss")
    assert np.mean(finite) > 0.9


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


def degenerate(case: str) -> World:
    world = World(*typical(SHAPE))
    for name, value in DEGENERATE[case].items():
        leaf = named(world)[name]
        world = with_leaf(world, name, jnp.broadcast_to(jnp.asarray(value, leaf.dtype), leaf.shape))
    return world


@pytest.mark.parametrize("case", DEGENERATE)
def test_gradients_are_finite_at_degenerate_places(case):
    loss, gradient = loss_and_gradient(SHAPE)(degenerate(case), jnp.ones(10))
    assert np.isfinite(float(loss))
    for name, leaf in named(gradient).items():
        assert np.all(np.isfinite(np.asarray(leaf))), name


@pytest.mark.parametrize("count", [0, 1])
def test_gradients_are_finite_with_one_splat_and_with_none(count):
    shape = Shape(count, 1, "s", fast=False)
    loss, gradient = loss_and_gradient(shape)(World(*typical(shape)), jnp.ones(10))
    assert np.isfinite(float(loss))
    assert all(np.all(np.isfinite(np.asarray(leaf))) for leaf in jax.tree.leaves(gradient))


@pytest.mark.parametrize("above", [0.0, 1e-14, 1e-7, 1e-5])
def test_gradients_are_finite_with_a_light_on_the_surface(above):
    shape = SHAPES[1]
    world = World(*typical(shape))
    splats = world.scene.splats
    splats = eqx.tree_at(lambda s: s.centers, splats, splats.centers.at[3].set(0.0))
    world = eqx.tree_at(lambda w: w.scene.splats, world, splats)
    world = with_leaf(world, "scene.lights.0.position", above * splats.normals[3])
    loss, gradient = loss_and_gradient(shape)(world, jnp.ones(10))
    assert np.isfinite(float(loss))
    assert all(np.all(np.isfinite(np.asarray(leaf))) for leaf in jax.tree.leaves(gradient))
