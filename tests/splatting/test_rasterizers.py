"""The tile rasterizer gives what the plain one gives, in value and gradient, on random scenes; what
a picture must be at degenerate places; what a plan cannot hold.

Nothing is left out for being near a tie: no two numbers that are compared are equal but for
rounding, since what is drawn is drawn from a continuum, and splats in one place differ from the
limit of the front by epsilon.
"""

import dataclasses
from functools import cache

import bodies
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_bodies import KINDS, disagreement, random_body, seeds

from splatjax._combination import DeviceMesh
from splatjax.splatting import (
    DenseRasterizer,
    SplattingSettings,
    TileGrid,
    TileRanges,
    TileRasterizer,
    bin_items,
    make_shadow_map,
    plan_pairs,
)
from splatjax.splatting._rasterizer import may_show_behind

WIDTH, HEIGHT = 21, 18
IN_SUITE = 45
TILES = TileRasterizer(lanes=4, slots=4)
SETTINGS = SplattingSettings(full_coverage=0.3)
# float64: both do the same sums in another order; 6e-13 and 6e-11 found in 3,000 scenes.
VALUE, GRADIENT = 1e-10, 1e-8
# float32: of the largest. A fragment at a limit may fall on either side of it, which moves a pixel
# by its small weight; all others agree. How sums are rounded depends on the processor: the gradient
# in the view, a sum over all fragments, is off by 1.9e-3 to 2.4e-3 in one of the scenes.
VALUE32, GRADIENT32, OUTLIERS = 2e-4, 3e-3, 0.02
# Of less weight a mean is rounding over rounding: a weight at the rim is a difference of nearly
# equal numbers.
MEANINGFUL = 1e-6
UNSEEN = "facing away", "none is seen"


@cache
def by_both(count: int, perspective: bool):
    """Return a function of a scene: all that is seen, and the gradients of a random sum of it, by
    both rasterizers.
    """
    rng = np.random.default_rng(count)
    rows = 2 if perspective else 0  # lights blend no attributes
    attributes = jnp.asarray(rng.normal(size=(rows, count)), float)
    factors = jnp.asarray(rng.normal(size=(2, rows + 3, HEIGHT, WIDTH)), float)
    given = random_body(0, count, perspective, WIDTH, HEIGHT)
    plain = DenseRasterizer().make_plan(given[:1], given[1:], SETTINGS)
    # With capacity for every splat in every tile: one program for all scenes.
    everywhere = jnp.full(TILES.grid(given[1]).padded_count, count)
    plans = TILES.plan_for([[(everywhere[0], everywhere)]], count, given[1]), plain

    def evaluate(plan, body, view):
        def total(body, view, attributes):
            drawn, planes, summed = bodies.drawn(body, attributes, view, SETTINGS, plan), {}, []
            for name in ("front", "behind"):
                each = getattr(drawn, name)
                means = jnp.concatenate([each.attributes, each.depth[None]])
                means = jnp.where(each.weight_sum > 0, means, 0.0)
                # As in a picture, a mean counts by its coverage: alone, its derivative is rounding
                # over its weights.
                other = jnp.stack([each.weight_sum, each.coverage])
                summed.append(jnp.concatenate([means * each.coverage[None], other]))
                planes[f"{name} means"] = jnp.where(each.weight_sum > MEANINGFUL, means, 0.0)
                planes |= {f"{name} weights": other[0], f"{name} coverage": other[1]}
            return jnp.vdot(factors, jnp.stack(summed)), (planes, drawn.needed)

        d_total = jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)
        (_, (planes, needed)), (d_body, d_view, d_rows) = d_total(body, view, attributes)
        gradients = {name: getattr(d_body, name) for name in ("centers", "normals", "radii")}
        # A scale by its logarithm, beside places and rotations.
        d_view = jax.tree.map(lambda leaf, d: d if leaf.ndim else leaf * d, view, d_view)
        d_view = jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(d_view)])
        return planes, gradients | {"attributes": d_rows, "view": d_view}, needed

    return jax.jit(lambda body, view: [evaluate(plan, body, view) for plan in plans])


def open_tiles(weight_sum: jax.Array) -> int:
    grid = TileGrid(WIDTH, HEIGHT)
    weights = grid.cut(weight_sum[None])[:, 0]
    gaps = (weights > 0) & may_show_behind(weights, grid, SETTINGS.hidden_from)
    return int(jnp.sum(jnp.any(gaps, axis=1)))


def compare(count: int, perspective: bool, off, bounds: tuple[float, float]) -> None:
    """Compare random scenes; `off` measures how far one array is from another."""
    both, behind, most_open = by_both(count, perspective), 0, 0
    for seed in seeds(IN_SUITE if count > 1 else len(KINDS)):
        (*fast, needed), (*plain, _) = both(*random_body(seed, count, perspective, WIDTH, HEIGHT))
        assert float(needed) <= 1
        weights = plain[0]["front weights"]
        behind += int(jnp.sum(plain[0]["behind weights"] > 0))
        most_open = max(most_open, open_tiles(weights))
        assert seed >= len(KINDS) or KINDS[seed] not in UNSEEN or not np.any(weights)
        for bound, ours, theirs in zip(bounds, fast, plain, strict=True):
            for name, expected in theirs.items():
                assert np.all(np.isfinite(expected)), (seed, name)
                error = off(ours[name], expected)
                assert error < bound, f"scene {seed} of {count}: {name} differ by {error:.1e}"
    assert count == 1 or behind > 200
    assert count == 1 or perspective or most_open > TILES.lanes


@pytest.mark.parametrize(
    ("count", "perspective"),
    [(24, True), (24, False), pytest.param(1, True, marks=pytest.mark.long)],
)
def test_tiles_give_what_the_plain_rasterizer_gives(float64, count, perspective):
    compare(count, perspective, disagreement, (VALUE, GRADIENT))


@pytest.mark.once
@pytest.mark.parametrize("perspective", [True, pytest.param(False, marks=pytest.mark.long)])
def test_in_float32_too(perspective):
    def off(ours, theirs):
        error = np.abs(ours - theirs) / np.max(np.abs(theirs), initial=1e-12)
        return np.quantile(error, 1 - OUTLIERS) if error.size else 0.0

    compare(24, perspective, off, (VALUE32, GRADIENT32))


def test_a_picture_is_a_part_of_a_larger_one(float64):
    """Its middle, or beside it with an off-center principal point. Which splats are left out for
    lying beside the picture is common to both rasterizers.
    """
    border, right, down = 20, 13, -17
    plan = DenseRasterizer().make_plan([], [], SETTINGS)

    @jax.jit
    def weights(body, view):
        larger = dataclasses.replace(view, width=WIDTH + 2 * border, height=HEIGHT + 2 * border)
        middle = jnp.asarray(WIDTH / 2 - right), jnp.asarray(HEIGHT / 2 - down)
        beside = dataclasses.replace(view, principal_pixel=middle)
        nothing = jnp.zeros((0, body.count))
        drawn = (
            bodies.drawn(body, nothing, each, SETTINGS, plan) for each in (view, beside, larger)
        )
        return [(each.front.weight_sum, each.behind.weight_sum) for each in drawn]

    for seed in seeds(IN_SUITE):
        small, beside, large = weights(*random_body(seed, 24, True, WIDTH, HEIGHT))
        for ours, other, theirs in zip(small, beside, large, strict=True):
            assert disagreement(ours, theirs[border:-border, border:-border]) < VALUE, seed
            rows, columns = (slice(border + s, s - border) for s in (down, right))
            assert disagreement(other, theirs[rows, columns]) < VALUE, seed


@pytest.mark.once
@pytest.mark.long
def test_too_small_a_capacity_makes_the_picture_nan_and_is_reported():
    """Never a wrong picture; and where there is little behind the front, little capacity for it."""
    view, body = bodies.perspective(width=96, height=96), bodies.bumpy(500)
    whole = TileRasterizer(lanes=2, slots=16).make_plan([body], [view], SETTINGS)
    plan = whole.fitted(body, [view], SETTINGS)
    assert plan.places.behind < whole.places.behind
    few = dataclasses.replace(plan.places, behind=2)
    for short in ({}, {"splats": 100}, {"pairs": 1024}, {"places": few}):
        tried = dataclasses.replace(plan, **short)
        make = jax.jit(make_shadow_map, static_argnums=(2, 3, 4))
        seen = make(body, view, SETTINGS, tried, DeviceMesh())
        assert (float(seen.needed) > 1) == bool(short), short
        assert np.all(np.isnan(seen.planes) == bool(short)), short


@pytest.mark.parametrize("short", [False, True])
def test_too_small_a_capacity_is_reported(short):
    """Of boxes from a tenth of a pixel to without end."""
    grid, rng, count = TileGrid(61, 45, lanes=4, slots=4), np.random.default_rng(11), 900
    middle = rng.uniform(-10, 70, (2, count))
    half = np.exp(rng.uniform(np.log(0.1), np.log(30.0), (2, count)))
    half = np.where(rng.uniform(size=half.shape) < 0.05, np.inf, half)
    sides = jnp.asarray(np.stack([middle - half, middle + half], axis=1).reshape(4, count))
    ranges = TileRanges.of(tuple(sides), jnp.asarray(rng.uniform(size=count) < 0.9), grid)
    pairs = 1024 if short else plan_pairs([ranges.per_tile(grid)], grid)
    needed = jax.jit(lambda ranges: bin_items(ranges, grid, pairs).needed)(ranges)
    assert (float(needed) > 1) == short


def test_long_lists_in_a_large_picture_keep_all_items():
    """Lists so long that a sort key of 32 bits does not hold length and tile."""
    grid, counts = TileGrid(8192, 8192, lanes=2, slots=1), [3000, 4000, 10, 10]
    tiles = jnp.repeat(jnp.arange(4, dtype=jnp.int32), jnp.asarray(counts))
    one = jnp.ones_like(tiles)
    ranges = TileRanges(tiles, 0 * one, one, one)
    pairs = plan_pairs([jnp.asarray(counts)], grid)
    bins = jax.jit(lambda ranges: bin_items(ranges, grid, pairs))(ranges)
    assert float(bins.needed) <= 1
    for tile, count in enumerate(counts):
        ids = np.asarray(bins.block(jnp.asarray([tile]), jnp.asarray(0), count + 1))
        first = sum(counts[:tile])
        np.testing.assert_array_equal(ids, [[*range(first, first + count), len(tiles)]])


def test_too_many_tiles_are_refused():
    """A picture whose tiles have numbers too large to be sorted."""
    view = bodies.perspective(width=1 << 14, height=1 << 14)
    bodies.assert_refused(
        lambda: TileRasterizer().make_plan([bodies.bumpy(9)], [view], SETTINGS), r"16384 x 16384"
    )
    assert TileGrid(1 << 14, (1 << 14) - 8).padded_count < 1 << 22
