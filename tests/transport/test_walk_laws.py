"""Symmetries of transport."""

import jax
import jax.numpy as jnp
import numpy as np
from media import INFINITE, layer

import splatjax as sj

KEY = jax.random.key(7)
PHOTONS, FEW = 400_000, 10_000
# Of rings given here: as many as there are by default, so that walks alike in their layers are one
# program.
EDGES = 129
# Standard errors between two estimates: of some dozens here, none should be farther off.
ERRORS = 3.5


def agree(one, other, rtol=0.0) -> None:
    difference = np.abs(np.asarray(one.value) - np.asarray(other.value))
    error = np.hypot(np.asarray(one.deviation), np.asarray(other.deviation))
    assert np.all(error > 0)
    assert np.all(difference < ERRORS * error + rtol * np.abs(np.asarray(one.value))), (
        one.value,
        other.value,
        error,
    )


def test_a_split_slab_is_the_whole(float32):
    whole = sj.transport.monte_carlo([layer(0.1, 2.0, 1.4, 1.0)], PHOTONS, KEY, eta_below=1.2)
    parts = [layer(0.1, 2.0, 1.4, 0.3), layer(0.1, 2.0, 1.4, 0.7)]
    split = sj.transport.monte_carlo(parts, PHOTONS, jax.random.fold_in(KEY, 1), eta_below=1.2)
    agree(whole.total_reflectance, split.total_reflectance)
    agree(whole.total_transmittance, split.total_transmittance)
    absorbed = type(split.absorbed)(
        split.absorbed.value.sum(0), jnp.linalg.norm(split.absorbed.deviation, axis=0)
    )
    agree(whole.absorbed, absorbed)
    # Ring by ring, where many photons leave.
    many = np.asarray(whole.reflected.deviation[:, 0]) < 0.05 * np.asarray(
        whole.reflected.value[:, 0]
    )
    pull = (whole.reflected.value - split.reflected.value) / np.hypot(
        whole.reflected.deviation, split.reflected.deviation
    )
    chi = np.sum(np.asarray(pull)[many] ** 2)
    assert np.sum(many) > 40
    assert abs(chi - np.sum(many)) < 4 * np.sqrt(2 * np.sum(many))


def test_light_goes_back_the_way_it_came(float32):
    """Reciprocity: a stack lets as much diffuse light through from above as from below."""
    stack = [layer(0.3, 1.0, 1.5, 0.4), layer(0.02, 3.0, 1.3, 1.0)]
    down, up = (
        sj.transport.monte_carlo(
            each,
            PHOTONS,
            jax.random.fold_in(KEY, number),
            incidence=sj.transport.DiffuseIncidence(),
        )
        for number, each in enumerate((stack, stack[::-1]))
    )

    def arriving(found):
        entering = np.asarray(1 - found.specular)
        part = found.total_transmittance
        return type(part)(part.value * entering, part.deviation * entering)

    assert abs(down.specular[0] - up.specular[0]) > 0.01
    assert abs(down.total_reflectance.value[0] - up.total_reflectance.value[0]) > 0.05
    agree(arriving(down), arriving(up))


def test_similarity(float32):
    """Scattering far and forward looks like a little in all directions, for a medium that absorbs
    little.
    """
    isotropic = sj.transport.monte_carlo([layer(0.0041, 2.62, 1.5)], FEW, KEY)
    forward = sj.transport.monte_carlo(
        [layer(0.0041, 2.62, 1.5)], FEW, KEY, phase=sj.transport.HenyeyGreenstein(0.9)
    )
    agree(isotropic.total_reflectance, forward.total_reflectance, rtol=2e-3)


def test_units(dtype):
    """Centimeters for millimeters: the same walks."""
    edges = jnp.linspace(0.0, 4.0, EDGES, dtype=dtype)
    one = sj.transport.monte_carlo([layer(0.125, 2.0, 1.4, 1.5)], FEW, KEY, edges=edges)
    ten = sj.transport.monte_carlo([layer(0.25, 4.0, 1.4, 0.75)], FEW, KEY, edges=edges / 2)
    np.testing.assert_allclose(one.reflected.value, ten.reflected.value / 4, rtol=1e-5)
    np.testing.assert_allclose(one.transmitted.deviation, ten.transmitted.deviation / 4, rtol=1e-5)


def test_channels_that_walk_alike_are_walks_of_their_own(float32):
    """White Monte Carlo: absorption by weight gives what each channel gives alone, and slabs that
    differ do not share.
    """
    edges = jnp.linspace(0.0, 4.0, EDGES)
    absorptions = [0.4, 0.01, 0.1]
    together = sj.transport.monte_carlo(
        [layer(absorptions, 2.0, 1.4, 1.0)], PHOTONS, KEY, edges=edges
    )
    for channel, sigma_a in enumerate(absorptions):
        alone = sj.transport.monte_carlo(
            [layer(sigma_a, 2.0, 1.4, 1.0)], PHOTONS, jax.random.fold_in(KEY, channel), edges=edges
        )
        picked = jax.tree.map(lambda each, c=channel: each[c : c + 1], together.total_reflectance)
        agree(picked, alone.total_reflectance)
    ordered = np.asarray(together.total_reflectance.value)
    assert ordered[1] > ordered[2] > ordered[0]
    # A half space of one index is its own image in any scale; a slab is not.
    medium = sj.Medium(jnp.asarray([0.1, 0.2, 0.4]), jnp.asarray([1.0, 2.0, 4.0]), jnp.full(3, 1.4))
    half_space = sj.transport.monte_carlo(
        [sj.Layer(medium, jnp.asarray(INFINITE))], PHOTONS, KEY, edges=edges
    )
    np.testing.assert_allclose(
        half_space.total_reflectance.value, half_space.total_reflectance.value[0], rtol=1e-6
    )
    slab = sj.transport.monte_carlo([sj.Layer(medium, jnp.asarray(1.0))], FEW, KEY, edges=edges)
    assert np.all(np.diff(slab.total_transmittance.value) < -0.05)


def test_a_film_is_a_thin_layer_that_absorbs(float32):
    thin = 1e-3
    below = layer(0.05, 2.0, 1.4, 2.0)
    film = sj.transport.monte_carlo([sj.Film(jnp.asarray([0.3])), below], PHOTONS, KEY)
    slab = sj.transport.monte_carlo(
        [layer(0.3 / thin, 1e-3, 1.4, thin), below], PHOTONS, jax.random.fold_in(KEY, 1)
    )
    agree(film.total_reflectance, slab.total_reflectance, rtol=1e-3)
    agree(film.absorbed, slab.absorbed, rtol=1e-3)
    bare = sj.transport.monte_carlo([below], PHOTONS, KEY)
    assert film.total_reflectance.value[0] < 0.6 * bare.total_reflectance.value[0]


def test_the_same_key_gives_the_same_numbers(dtype):
    stack = [layer(0.1, 1.0, 1.4, 2.0)]
    one, again, other = (
        sj.transport.monte_carlo(stack, FEW, jax.random.key(seed)) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.reflected.value, again.reflected.value)
    assert np.any(np.asarray(one.reflected.value) != np.asarray(other.reflected.value))
