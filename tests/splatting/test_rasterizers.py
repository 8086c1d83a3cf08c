"""The tile rasterizer against the plain one in float32, in value and gradient; what a picture must
be at degenerate places.
"""

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from splatjax.scene import Splats
from splatjax.splatting import (
    BinCapacity,
    DenseRasterizer,
    SplattingSettings,
    TileCapacity,
    TileGrid,
    TileRasterizer,
)

SETTINGS = SplattingSettings()
TILES = TileRasterizer(lanes=8, slots=16)
VIEWS = {"perspective": bodies.perspective, "orthographic": bodies.orthographic}

# Of the largest. A fragment at a limit may fall on either side of it, which moves a pixel by its
# small weight; all others agree. float64 is held to rounding in `test_random_bodies.py`.
VALUE, GRADIENT, OUTLIERS = 2e-4, 2e-3, 0.005


def attributes(count):
    """Two rows that vary, and one that is constant."""
    i = jnp.arange(count, dtype=float)
    return jnp.stack([jnp.sin(0.7 * i), jnp.cos(1.3 * i) + 0.5, jnp.full(count, 0.625)])


def flat(surfaces):
    """Everything that a picture holds, one plane after another."""
    planes = []
    for each in (surfaces.front, surfaces.behind):
        there = each.weight_sum > 0
        planes += [
            *each.attributes,
            jnp.where(there, each.depth, 0.0),
            each.weight_sum,
            each.coverage,
        ]
    return jnp.stack(planes)


def both(view, body, rows, rasterizer):
    """Give the picture, and the gradients of a fixed random functional of it."""

    def picture(body, rows):
        surfaces = bodies.drawn(body, rows, view, SETTINGS, rasterizer)
        return flat(surfaces), surfaces.needed

    planes, pullback, needed = jax.vjp(picture, body, rows, has_aux=True)
    cotangent = jnp.asarray(np.random.default_rng(4).normal(size=planes.shape), planes.dtype)
    d_body, d_rows = pullback(cotangent)
    return (
        planes,
        {
            "centers": d_body.centers,
            "normals": d_body.normals,
            "radii": d_body.radii,
            "rows": d_rows,
        },
        needed,
    )


@jax.jit
def compared(views, scenes, rows, tiles):
    """Every scene by both rasterizers: one program."""

    def one(scene):
        return both(views, scene, rows, DenseRasterizer()), both(views, scene, rows, tiles)

    return jax.lax.map(one, scenes)


def roomy(planned: list[TileRasterizer]) -> TileRasterizer:
    """Give a rasterizer with room for what each of these has room for."""
    each = [tiles.capacity for tiles in planned]
    bins = {
        name: max(getattr(capacity.bins, name) for capacity in each)
        for name in ("pairs", "blocks", "chunks")
    }
    return TileRasterizer(
        TILES.lanes, TILES.slots, TileCapacity(max(c.splats for c in each), BinCapacity(**bins))
    )


def compare(view, scenes: dict[str, Splats]):
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes.values())
    tiles = roomy([TILES.planned(scene, [view], SETTINGS) for scene in scenes.values()])
    count = next(iter(scenes.values())).count
    results = compared(view, stacked, attributes(count), tiles)
    for i, name in enumerate(scenes):
        (plain, plain_gradients, _), (fast, fast_gradients, needed) = jax.tree.map(
            lambda leaf, i=i: np.asarray(leaf[i]), results
        )
        assert needed <= 1, name
        close(fast, plain, VALUE, f"{name}: picture")
        for argument, expected in plain_gradients.items():
            found = fast_gradients[argument]
            assert np.all(np.isfinite(found)), f"{name}: gradient in {argument}"
            assert np.all(np.isfinite(expected)), f"{name}: plain gradient in {argument}"
            close(found, expected, GRADIENT, f"{name}: gradient in {argument}")
    return {name: np.asarray(results[1][0][i]) for i, name in enumerate(scenes)}


def close(found, expected, tolerance, what):
    """Differences are at most `tolerance` of the largest, but for a share of outliers."""
    error = np.abs(found - expected) / max(np.max(np.abs(expected)), 1e-12)
    share = np.mean(error > tolerance)
    assert share <= OUTLIERS, (
        f"{what}: {share:.2%} beyond {tolerance}, the largest {error.max():.1e}"
    )


COUNT = 400


def every_scene(kind, view) -> dict[str, Splats]:
    """Scenes of equally many splats, so that one program draws all."""
    rng = np.random.default_rng(9)
    places, up = rng.uniform(-8, 8, (COUNT, 3)), np.asarray([0.0, 0.0, 1.0])
    attitudes = rng.normal(size=(COUNT, 3)) * 0.3 + up
    axes = np.asarray(view.rotation, float)
    random = rng.normal(size=(COUNT, 3))
    toward = (
        np.asarray(view.position) - places
        if kind == "perspective"
        else np.tile(-axes[2], (COUNT, 1))
    )
    alone = np.where(np.arange(COUNT)[:, None] == 7, attitudes, -toward)
    half = COUNT // 2
    return {
        "bumpy": bodies.bumpy(COUNT),
        "one sphere before another": bodies.joined(
            bodies.sphere(half, 9.0, (-3.0, 1.0, -8.0)),
            bodies.sphere(half, 4.0, (4.0, -2.0, 9.0), seed=1),
        ),
        "larger than the picture": bodies.splats(places, attitudes, 60.0),
        "behind the eye": bodies.splats(places * 0.2 + [0, 0, 60.0], attitudes, 2.0),
        "through the eye": bodies.splats(places * 0.4 + [0, 0, 40.0], attitudes, 3.0),
        "nearly edge on": bodies.splats(places, np.cross(axes[2], random) + 1e-3 * attitudes, 2.0),
        "edge on": bodies.splats(places, np.cross(toward, random), 2.0),
        "facing away": bodies.splats(places, -toward, 2.0),
        "off screen": bodies.splats(places + np.asarray([500.0, 0, 0]), attitudes, 2.0),
        "in one tile": bodies.splats(places * 0.05, attitudes, 0.3),
        "in one place": bodies.splats(np.zeros((COUNT, 3)), np.tile(-axes[2], (COUNT, 1)), 2.0),
        "one that is seen": bodies.splats(places, alone, 2.0),
    }


@pytest.mark.once
@pytest.mark.parametrize("kind", VIEWS)
def test_tiles_draw_what_the_plain_rasterizer_draws(kind):
    view = VIEWS[kind]()
    pictures = compare(view, every_scene(kind, view))
    weights = {name: planes[[4, 10]] for name, planes in pictures.items()}
    for name in (
        "facing away",
        "off screen",
        *(["behind the eye"] if kind == "perspective" else []),
    ):
        assert not np.any(pictures[name]), name
    assert np.max(weights["edge on"]) < 1e-4
    assert np.min(weights["larger than the picture"][0]) > 0
    assert np.sum(weights["one that is seen"] > 0) > 5
    assert np.sum(pictures["one sphere before another"][-1] > 0.5) > 2, (
        "no inner silhouette was seen"
    )


@pytest.mark.once
@pytest.mark.parametrize("rasterizer", [DenseRasterizer(), TILES])
def test_what_of_a_tile_lies_beyond_the_picture_shows_nothing(rasterizer):
    """The pixels of a tile that are none must not be shaded, nor count as seen."""
    view, size, rng = bodies.perspective(width=21, height=18), 30, np.random.default_rng(5)
    body = bodies.splats(
        rng.uniform(-8, 8, (size, 3)), rng.normal(size=(size, 3)) * 0.3 + [0, 0, 1], 6.0
    )
    rasterizer = rasterizer.planned(body, [view], SETTINGS)
    summed = jax.jit(lambda body: rasterizer.summed(body, attributes(size), view, SETTINGS))(body)
    within = TileGrid(view.width, view.height).within_picture()
    assert not np.any(np.asarray(summed.front.weights)[~within])
    assert not np.any(np.asarray(summed.behind.weights)[~within])
    assert np.mean(np.asarray(summed.front.weights)[within] > 0) > 0.5
    assert np.any(np.asarray(summed.behind.weights) > 0)


@pytest.mark.parametrize(
    "rasterizer",
    [DenseRasterizer(), TileRasterizer(capacity=TileCapacity(1, BinCapacity(1024, 4, 1)))],
)
def test_no_splat_gives_an_empty_picture(rasterizer):
    view, nothing = bodies.perspective(), bodies.splats(np.zeros((0, 3)), np.zeros((0, 3)), 1.0)
    surfaces = bodies.drawn(nothing, jnp.zeros((2, 0)), view, SETTINGS, rasterizer)
    assert not np.any(flat(surfaces))
    assert float(surfaces.needed) == 0


@pytest.mark.once
@pytest.mark.parametrize(
    "capacity",
    [TileCapacity(500, BinCapacity(1024, 4, 4)), TileCapacity(100, BinCapacity(8192, 400, 8))],
)
def test_too_small_a_capacity_poisons_the_picture_and_says_so(capacity):
    view, body = bodies.perspective(), bodies.bumpy(500)

    @jax.jit
    def picture(body):
        tiles = TileRasterizer(lanes=8, slots=16, capacity=capacity)
        return bodies.drawn(body, attributes(500), view, SETTINGS, tiles)

    surfaces = picture(body)
    assert float(surfaces.needed) > 1
    assert bool(jnp.all(jnp.isnan(surfaces.front.depth)))
    assert bool(jnp.all(jnp.isnan(surfaces.front.attributes)))


def test_a_rasterizer_without_capacity_says_what_to_do():
    view, body = bodies.perspective(), bodies.splats(np.zeros((1, 3)), [[0.0, 0, 1]], 1.0)
    with pytest.raises(ValueError, match="plan"):
        bodies.drawn(body, attributes(1), view, SETTINGS, TileRasterizer())
