"""Tiles that show anything, packed: shares of two surfaces, and pictures put together from both."""

import bodies
import jax.numpy as jnp
import numpy as np

from splatjax.splatting import SIDE, Atlas, TileGrid

VIEW = bodies.perspective(width=22, height=13)
FRONT, BEHIND = (0, 2, 3, 5), (2, 5)  # of six tiles


def packed():
    farthest = np.full((2, 6), -np.inf)
    farthest[0, list(FRONT)], farthest[1, list(BEHIND)] = 40.0, 41.0
    rng = np.random.default_rng(3)
    front, behind = (
        np.where(np.isin(np.arange(6), each)[:, None], rng.uniform(size=(6, SIDE**2)), 0)
        for each in (FRONT, BEHIND)
    )
    atlas = Atlas.of(jnp.asarray(farthest.reshape(2, 2, 3), float), VIEW, 8)
    return atlas, front, behind


def test_what_shows_has_a_place_and_what_does_not_has_none():
    atlas, front, behind = packed()
    assert float(atlas.needed) == 6 / 8
    np.testing.assert_array_equal(atlas.tiles, [*FRONT, *(6 + each for each in BEHIND), 12, 12])
    np.testing.assert_array_equal(
        np.asarray(atlas.places)[np.asarray(atlas.tiles)[:6]], np.arange(6)
    )
    assert np.all(np.delete(np.asarray(atlas.places), np.asarray(atlas.tiles)[:6]) == 8)
    rows = atlas.pack(jnp.asarray(front, float), jnp.asarray(behind, float))
    np.testing.assert_allclose(
        rows[:6], np.concatenate([front[list(FRONT)], behind[list(BEHIND)]]), rtol=1e-6
    )
    np.testing.assert_array_equal(rows[6:], 0)


def test_behind_has_the_share_that_the_front_leaves():
    atlas, front, behind = packed()
    shares = atlas.shares(atlas.pack(jnp.asarray(front, float), jnp.asarray(behind, float)))
    expected = np.concatenate([front[list(FRONT)], (behind * (1 - front))[list(BEHIND)]])
    np.testing.assert_allclose(shares[:6], expected, atol=1e-6)


def test_both_surfaces_add_to_the_picture():
    atlas, front, behind = packed()
    values = atlas.pack(jnp.asarray(front, float), jnp.asarray(behind, float))
    grid = TileGrid(VIEW.width, VIEW.height)
    for found, tiles in ((atlas.picture, front + behind), (atlas.front_picture, front)):
        expected = grid.join(jnp.asarray(tiles, float)[:, None])
        np.testing.assert_allclose(found(values[..., None])[..., 0], expected[0], rtol=1e-6)
        layers = found(jnp.stack([values, 2 * values], axis=1)[..., None])  # rows before the pixels
        np.testing.assert_allclose(
            layers[..., 0], np.stack([expected[0], 2 * expected[0]]), rtol=1e-6
        )
    poisoned = atlas.poisoned_unless(jnp.asarray(False)).picture(values[..., None])
    assert np.all(np.isnan(poisoned))
