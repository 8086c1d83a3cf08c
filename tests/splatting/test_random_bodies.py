"""The tile rasterizer gives what the plain one gives, in value and gradient: passes 2 and 3, and
shadow maps, on random scenes.

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

from splatjax.splatting import (
    BinCapacity,
    DenseRasterizer,
    SplattingSettings,
    TileCapacity,
    TileGrid,
    TileRasterizer,
)

WIDTH, HEIGHT = 21, 18
IN_SUITE = 45
# float64: both do the same sums in another order; 6e-13 and 6e-11 found in 3,000 scenes.
VALUE, GRADIENT = 1e-10, 1e-8
# of less weight a mean is rounding over rounding: a weight at the rim is a difference of nearly
# equal numbers
TOLD = 1e-6


@dataclasses.dataclass(frozen=True)
class Use:
    """What a rasterizer is used for."""

    attributes: int
    tiles: TileRasterizer
    settings: SplattingSettings


# Lights blend no attributes; here in small tiles, and the front leaves so much open that not all
# open tiles are swept at once.
USES = {
    True: Use(2, TileRasterizer(lanes=4, slots=4), SplattingSettings()),
    False: Use(0, TileRasterizer(lanes=4, slots=4), SplattingSettings(full_coverage=0.6)),
}


def with_room(tiles: TileRasterizer, count: int) -> TileRasterizer:
    """Give room for every splat in every tile: one program for all scenes."""
    grid = TileGrid(WIDTH, HEIGHT, tiles.lanes, tiles.slots)
    pairs, chunks = -(-count * grid.tiles // 1024) * 1024, grid.tiles // grid.lanes
    capacity = TileCapacity(count, BinCapacity(pairs, chunks * -(-count // grid.slots), chunks))
    return TileRasterizer(tiles.lanes, tiles.slots, capacity)


@cache
def by_both(count: int, perspective: bool):
    """Give a function of a scene: all that is seen, and the gradients of a random sum of it, by
    both rasterizers.
    """
    use = USES[perspective]
    rng = np.random.default_rng(count)
    rows = jnp.asarray(rng.normal(size=(use.attributes, count)))
    factors = jnp.asarray(rng.normal(size=(2 * (use.attributes + 3), HEIGHT, WIDTH)))

    def found(rasterizer, body, view):
        def total(body, view, rows):
            surfaces = bodies.drawn(body, rows, view, use.settings, rasterizer)
            planes, summed = {}, []
            for name, each in (("front", surfaces.front), ("behind", surfaces.behind)):
                depth = jnp.where(each.weight_sum > 0, each.depth, 0.0)
                told = each.weight_sum > TOLD
                planes |= {f"{name} depth": jnp.where(told, depth, 0.0)}
                planes |= {f"{name} attributes": jnp.where(told[None], each.attributes, 0.0)}
                planes |= {f"{name} weight sum": each.weight_sum, f"{name} coverage": each.coverage}
                # As in a picture, a mean counts by its coverage: alone, its derivative is rounding
                # over its weights.
                means = jnp.concatenate([each.attributes, depth[None]]) * each.coverage[None]
                summed += [means, each.weight_sum[None], each.coverage[None]]
            return jnp.vdot(factors, jnp.concatenate(summed)), (planes, surfaces.needed)

        d_total = jax.value_and_grad(total, argnums=(0, 1, 2), has_aux=True)
        (_, (planes, needed)), (d_body, d_view, d_rows) = d_total(body, view, rows)
        gradients = {
            "centers": d_body.centers,
            "normals": d_body.normals,
            "radii": d_body.radii,
            "attributes": d_rows,
        }
        of_view = jax.tree.map(
            lambda leaf, d: (d if leaf.ndim else leaf * d).reshape(-1), view, d_view
        )  # scale per share
        return planes, gradients | {"view": jnp.concatenate(jax.tree.leaves(of_view))}, needed

    @jax.jit
    def both(body, view):
        return tuple(
            found(each, body, view) for each in (with_room(use.tiles, count), DenseRasterizer())
        )

    return both


@pytest.mark.parametrize(("count", "perspective"), [(24, True), (24, False), (1, True)])
def test_tiles_give_what_the_plain_rasterizer_gives(float64, count, perspective):
    both, worst, behind, most_open = by_both(count, perspective), {}, 0, 0
    for seed in seeds(IN_SUITE if count > 1 else len(KINDS)):
        body, view = random_body(seed, count, perspective, WIDTH, HEIGHT)
        (values, gradients, needed), (plain, plain_gradients, _) = both(body, view)
        assert float(needed) <= 1
        behind += int(jnp.sum(plain["behind weight sum"] > 0))
        most_open = max(
            most_open, open_tiles(np.asarray(plain["front weight sum"]), USES[perspective])
        )
        for bound, found, expected in (
            (VALUE, values, plain),
            (GRADIENT, gradients, plain_gradients),
        ):
            for name, each in expected.items():
                assert np.all(np.isfinite(each)), (seed, name)
                error = disagreement(found[name], each)
                assert error < bound, (
                    f"scene {seed} of {count} splats: {name} differ by {error:.1e}"
                )
                worst[name] = max(worst.get(name, 0.0), error)
    print({name: f"{error:.1e}" for name, error in worst.items()})
    print(f"{behind} pixels show something behind the front; at most {most_open} tiles are open")
    if count > 1:
        assert behind > 200
        assert perspective or most_open > USES[perspective].tiles.lanes


def open_tiles(weight_sum: np.ndarray, use: Use) -> int:
    """Count the tiles with a pixel that the front covers in part."""
    gaps = (weight_sum > 0) & (weight_sum < use.settings.full_coverage)
    return int(
        jnp.sum(
            jnp.any(
                TileGrid(WIDTH, HEIGHT).cut(jnp.asarray(gaps)[None].astype(float)) > 0, axis=(1, 2)
            )
        )
    )


BORDER = 20  # pixels


def test_a_picture_is_the_middle_of_a_larger_one(float64):
    """Which splats are left out for lying beside the picture is common to both rasterizers."""

    @jax.jit
    def seen(body, view):
        larger = dataclasses.replace(view, width=WIDTH + 2 * BORDER, height=HEIGHT + 2 * BORDER)
        rows = jnp.ones((0, body.count))
        return [
            bodies.drawn(body, rows, each, SplattingSettings(), DenseRasterizer())
            for each in (view, larger)
        ]

    middle = slice(BORDER, -BORDER), slice(BORDER, -BORDER)
    for seed in seeds(IN_SUITE):
        small, large = seen(*random_body(seed, 24, True, WIDTH, HEIGHT))
        for found, expected in ((small.front, large.front), (small.behind, large.behind)):
            assert disagreement(found.weight_sum, expected.weight_sum[middle]) < VALUE, seed
            assert disagreement(found.depth, expected.depth[middle]) < VALUE, seed
