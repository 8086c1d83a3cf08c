"""Any scene, any loss: if the loss is finite, so is every derivative of it. Contents are drawn, shapes and plans are fixed.

`make random-scenes` draws 10,000 of them over all shapes, in both precisions; the suite draws 200 over a few.
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
from hypothesis import HealthCheck, Phase, given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from worlds import World, named

import splatjax as sj
from splatjax.diffusion import ClusterDiffuser, DenseDiffuser
from splatjax.diffusion._clustered import LayerPlan
from splatjax.splatting import BinCapacity, DenseRasterizer, ShadowSettings, TileCapacity, TileRasterizer

pytestmark = [pytest.mark.slow, pytest.mark.once]

SCENES = int(os.environ.get("SPLATJAX_RANDOM_SCENES", "200"))
IN_SUITE = 4
SHADOWS = ShadowSettings(resolution=12, bias=0.4, softness=0.8)


@dataclasses.dataclass(frozen=True)
class Shape:
    """What a program is compiled for: all that is not drawn."""

    splats: int
    gaussians: int
    lights: str
    """One letter each: d directional, s with shadow; p point, q with shadow, c with shadow among the splats; b beam."""
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
    Shape(10, 2, "s", "r", precision="float64"),
    Shape(9, 1, "c", fast=False, width=5, height=5),
    Shape(8, 2, "pb", "as", channels=2, fast=False, precision="float64", single=True, width=6, height=5),
    # Beyond the suite.
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
    return st.floats(low, high, width=32)


def rows(shape: tuple[int, ...], low: float, high: float):
    return arrays(np.float64, shape, elements=number(low, high))


@st.composite
def worlds(draw, shape: Shape) -> World:
    """A scene of a shape; places on each other, lights on splats, black texels, tiny and huge radii are as likely as anything."""
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
    arrays_ = (centers, directions(count), radii, areas, albedo, specular, roughness)
    splats = sj.Splats(*(None if each is None else jnp.asarray(each) for each in arrays_))

    def position() -> np.ndarray:
        if count and draw(st.booleans()):
            return centers[draw(st.integers(0, count - 1))]
        return draw(rows((3,), -30, 30))

    def light(letter: str):
        power = jnp.asarray(draw(rows((channels,), 0, 100)))
        if letter in "ds":
            return sj.DirectionalLight(jnp.asarray(directions()), power, cast_shadows=letter == "s")
        if letter in "pqc":
            return sj.PointLight(jnp.asarray(position()), power, cast_shadows=letter != "p")
        variance = jnp.asarray(math.exp(draw(number(-5, 5))))
        return sj.GaussianBeam(jnp.asarray(position()), jnp.asarray(directions()), power, variance)

    single = None
    if shape.single:
        low, high = draw(rows((channels,), 0, 2)), draw(rows((channels,), 0, 2))
        eta = 1 + draw(rows((channels,), 0, 1))
        medium = sj.Medium(*(jnp.asarray(each) for each in (low, high + 1e-3, eta)))
        single = sj.SingleScattering(medium, jnp.asarray(draw(rows((channels,), 0, 1))))
    variances = np.exp(draw(rows((shape.gaussians,), math.log(1e-3), math.log(1e3))))
    gaussians = sj.SumOfGaussians(jnp.asarray(variances), jnp.asarray(draw(rows((shape.gaussians, channels), -0.2, 1))))
    material = sj.Material(gaussians, 1 + draw(number(0, 1)), draw(number(0, 1)), draw(number(0, 1.2)), single)

    eye, forward = draw(rows((3,), -40, 40)), directions()
    helper = np.eye(3)[np.argmin(np.abs(forward))]
    right = np.cross(forward, helper)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    if draw(st.booleans()):  # towards the splats
        eye = -(5 + 35 * draw(number(0, 1))) * forward
    camera = sj.Camera(*(jnp.asarray(each) for each in (eye, rotation, 0.3 + draw(number(0, 3)))), shape.width, shape.height)
    made = World(sj.Scene(splats, tuple(light(letter) for letter in shape.lights), material), camera)
    return jax.tree.map(lambda leaf: leaf.astype(shape.precision), made)


LAYERS = ("beauty", "coverage", "depth", "position", "normal", "albedo", "shadow", "irradiance", "layers", "specular")


@cache
def loss_and_gradient(shape: Shape):
    """Compiled once per shape, with room for every splat everywhere."""
    settings = sj.RenderSettings(shadows=SHADOWS)
    if not shape.fast:
        settings = sj.RenderSettings(shadows=SHADOWS, rasterizer=DenseRasterizer(), diffuser=DenseDiffuser())
    plan = roomy(sj.plan(*typical(shape), settings), shape)

    @jax.jit
    def found(world: World, factors: jax.Array):
        def loss(world: World):
            frame = sj.render(world.scene, world.camera, settings, plan)
            total = jnp.zeros((), world.camera.focal_length.dtype)
            for factor, name in zip(factors, LAYERS, strict=True):
                layer = getattr(frame, name)
                share = jnp.asarray(np.random.default_rng(len(name)).normal(size=layer.shape), layer.dtype)
                total = total + factor * jnp.sum(share * jnp.where(jnp.isfinite(layer), layer, 0.0))
            return jnp.where(jnp.isfinite(frame.overflow) & (frame.overflow == 0), total, jnp.nan)

        return jax.value_and_grad(loss)(world)

    return found


def typical(shape: Shape) -> tuple[sj.Scene, sj.Camera]:
    """Some scene of the shape, to plan with: light c stands among the splats, the others far away."""
    count, channels = shape.splats, shape.channels
    rng = np.random.default_rng(count)

    def ones(*sizes):
        return jnp.ones(sizes, shape.precision)

    def light(letter: str):
        if letter in "ds":
            return sj.DirectionalLight(-ones(3), ones(channels), cast_shadows=letter == "s")
        if letter in "pqc":
            return sj.PointLight((0 if letter == "c" else 100) * ones(3), ones(channels), cast_shadows=letter != "p")
        return sj.GaussianBeam(ones(3), -ones(3), ones(channels), ones())

    centers = jnp.asarray(rng.uniform(-5, 5, (count, 3)), shape.precision)
    normals = centers / jnp.linalg.norm(centers, axis=1, keepdims=True)
    maps = (ones(count, channels), ones(count), ones(count))
    maps = [each if letter in shape.maps else None for letter, each in zip("asr", maps, strict=True)]
    splats = sj.Splats(centers, normals, 2 * ones(count), ones(count), *maps)
    gaussians = sj.SumOfGaussians(4.0 ** jnp.arange(shape.gaussians, dtype=shape.precision), ones(shape.gaussians, channels))
    single = None
    if shape.single:
        single = sj.SingleScattering(sj.Medium(ones(channels), ones(channels), ones(channels)), ones(channels))
    camera = sj.Camera.look_at(20 * ones(3), 0 * ones(3), width=shape.width, height=shape.height)
    scene = sj.Scene(splats, tuple(map(light, shape.lights)), sj.Material(gaussians, single_scattering=single))
    return scene, camera


def roomy(plan: sj.Plan, shape: Shape) -> sj.Plan:
    """Give every list room for everything, and every layer any variance."""

    def widened(part):
        if isinstance(part, TileRasterizer):
            size = (shape.width, shape.height) if part is plan.camera else (SHADOWS.resolution,) * 2
            tiles = -(-size[0] // part.side) * -(-size[1] // part.side) + part.lanes
            room = BinCapacity(*_room(shape.splats, tiles, part.lanes, part.slots))
            return TileRasterizer(part.side, part.lanes, part.slots, TileCapacity(max(shape.splats, 1), room))
        if isinstance(part, ClusterDiffuser):
            assert part.layers is not None
            tiles = -(-shape.width // 8) * -(-shape.height // 8) + part.lanes
            room = BinCapacity(*_room(64 + shape.splats, tiles, part.lanes, part.slots))
            layers = tuple(
                LayerPlan(each.level, each.stride, 0.0, math.inf, None if each.capacity is None else room) for each in part.layers
            )
            return eqx.tree_at(lambda d: d.layers, part, layers, is_leaf=lambda leaf: isinstance(leaf, tuple))
        return part

    return jax.tree.map(widened, plan, is_leaf=lambda part: isinstance(part, TileRasterizer | ClusterDiffuser))


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
    @given(world=worlds(shape), factors=arrays(np.float64, len(LAYERS), elements=st.sampled_from([0.0, 1.0, -2.0])))
    def check(world, factors):
        loss, gradient = loss_and_gradient(shape)(world, jnp.asarray(factors, shape.precision))
        finite.append(bool(jnp.isfinite(loss)))
        if finite[-1]:
            wrong = [name for name, leaf in named(gradient).items() if not np.all(np.isfinite(np.asarray(leaf)))]
            assert not wrong, f"gradient of a loss of {float(loss):g} is not finite in {wrong}"

    with jax.enable_x64(shape.precision == "float64"):
        check()
    print(f"{len(finite)} scenes, {np.mean(finite):.0%} with a finite loss")
    assert np.mean(finite) > 0.9
