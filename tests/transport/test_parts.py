"""Random numbers, directions, interfaces, sums, and what is refused."""

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest
from media import INFINITE, layer

import splatjax as sj
from splatjax.scattering import ExactFresnel
from splatjax.transport._random import threefry, uniforms
from splatjax.transport._tally import Sum, total
from splatjax.transport._walk import fresnel

KEY = jax.random.key(5)
HALF_SPACE = [layer([0.1, 0.1], 1.0, 1.0)]


def test_threefry_is_that_of_jax():
    words = jnp.arange(8, dtype=jnp.uint32) * jnp.uint32(0x9E3779B9)
    keys = jnp.asarray([0x13198A2E, 0x03707344], jnp.uint32)
    theirs = jax.extend.random.threefry_2x32(keys, words)
    ours = jnp.concatenate(threefry(keys[0], keys[1], words[:4], words[4:]))
    np.testing.assert_array_equal(ours, theirs)


def test_uniforms_are_uniform_and_independent(dtype):
    numbers = np.concatenate(
        [uniforms(KEY, jnp.asarray(n), 4096, dtype) for n in range(50)], axis=1
    )
    assert numbers.dtype == dtype
    assert numbers.min() > 0
    assert numbers.max() <= 1
    counts = np.stack([np.histogram(row, 64, (0, 1))[0] for row in numbers])
    expected = numbers.shape[1] / 64
    chi = np.sum((counts - expected) ** 2 / expected, axis=1)
    assert np.all(np.abs(chi - 63) < 5 * np.sqrt(2 * 63))
    correlation = np.corrcoef(np.concatenate([numbers[:, 1:], numbers[:, :-1]]))
    assert np.all(np.abs(correlation - np.eye(8)) < 5 / np.sqrt(numbers.shape[1]))


@pytest.mark.parametrize("g", [-0.6, 0.0, 1e-6, 0.5, 0.95])
def test_henyey_and_greensteins_angles(float64, g):
    """Its moments are the powers of g: the mean Legendre polynomials of the cosine. The direction
    itself is a unit vector.
    """
    xi = (jnp.arange(200_000.0) + 0.5) / 200_000
    for start in ((0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (0.0, 0.0, -1.0)):
        before = tuple(jnp.full_like(xi, each) for each in start)
        angle = (xi * 7919) % 1.0
        after = sj.transport.HenyeyGreenstein(jnp.asarray(g)).scatter(
            before, jnp.zeros(xi.shape, jnp.int32), xi, angle
        )
        np.testing.assert_allclose(sum(each * each for each in after), 1, rtol=1e-12)
        cosine = np.asarray(sum(a * b for a, b in zip(before, after, strict=True)))
        np.testing.assert_allclose(cosine.mean(), g, atol=1e-6)
        np.testing.assert_allclose((1.5 * cosine**2 - 0.5).mean(), g * g, atol=1e-6)
        # No direction about the axis is preferred.
        across = np.stack([np.asarray(each) for each in after]).mean(axis=1)
        np.testing.assert_allclose(across, g * np.asarray(start), atol=1e-4)


@pytest.mark.parametrize("eta", [1.3, 1.0, 1 / 1.5])
def test_reflectance_has_the_moments_of_diffusion(float64, eta):
    mu = (jnp.arange(400_000.0) + 0.5) / 400_000
    reflectance, onward = fresnel(mu, jnp.full_like(mu, eta), jnp.ones_like(mu))
    moment = 2 * jnp.mean(mu * reflectance)
    np.testing.assert_allclose(
        moment, ExactFresnel().first_moment(jnp.asarray([eta]))[0], atol=2e-6
    )
    # Snell's law, where light goes on.
    goes = np.asarray(reflectance) < 1
    np.testing.assert_allclose((1 - onward**2)[goes], (eta**2 * (1 - mu**2))[goes], atol=1e-12)


@pytest.mark.parametrize("eta", [1.0, 1.4, 1 / 1.3])
def test_diffuse_light_enters_with_unit_power(float64, eta):
    xi = (jnp.arange(400_000.0) + 0.5) / 400_000
    (x, _, z), weight = sj.transport.DiffuseIncidence().enter(xi, xi, jnp.asarray([1.0, eta]))
    np.testing.assert_allclose(jnp.mean(weight), 1, atol=2e-6)
    assert np.all(np.asarray(z) >= 0)
    assert np.max(np.abs(x)) <= min(1, 1 / eta) + 1e-9


def test_sums_keep_what_rounding_takes(dtype):
    term = jnp.asarray(0.1, jnp.float32)
    added = jax.lax.fori_loop(
        0, 300_000, lambda _, each: each.plus(term), Sum.zeros((), jnp.float32)
    )
    np.testing.assert_allclose(added.over(300_000), np.float32(0.1), rtol=1e-7)
    naive = jax.lax.fori_loop(0, 300_000, lambda _, each: each + term, jnp.zeros((), jnp.float32))
    assert abs(float(naive) / 30_000 - 1) > 1e-4
    values = jnp.full((8192, 2), 0.1, jnp.float32)
    np.testing.assert_allclose(
        total(jnp.ones(8192, jnp.float32), values), 8192 * np.float32(0.1), rtol=2e-6
    )


def test_rings_are_where_they_say(dtype):
    edges = jnp.geomspace(0.1, 2.0, 129, dtype=dtype)
    found = sj.transport.monte_carlo(HALF_SPACE, 65_536, KEY, edges=edges)
    a, b = (np.asarray(edges, np.float64)[part] for part in (slice(None, -1), slice(1, None)))
    np.testing.assert_allclose(found.radii, 2 / 3 * (b**3 - a**3) / (b**2 - a**2), rtol=1e-6)
    area = np.pi * np.diff(np.asarray(edges) ** 2)
    inside = np.sum(np.asarray(found.reflected.value)[:, 0] * area)
    # What leaves within the first edge and beyond the last is in no ring, and in the total.
    assert 0.2 < inside < 0.9 * float(found.total_reflectance.value[0])
    profile = found.profile()
    np.testing.assert_array_equal(profile.deviation, found.reflected.deviation)
    np.testing.assert_allclose(profile(found.radii), found.reflected.value, rtol=1e-6)


def test_progress_is_told(float32):
    told = []
    sj.transport.monte_carlo(
        HALF_SPACE, 2_000_000, KEY, progress=lambda done, photons: told.append((done, photons))
    )
    assert len(told) > 1
    assert told == sorted(told)
    assert told[-1] == (2_000_000, 2_000_000)


def test_bad_arguments_are_refused():
    half_space = layer(0.1, 1.0, 1.3, INFINITE)
    for arguments, message in (
        (([half_space, half_space], 10, KEY), "layer 1 of 2 is infinitely thick"),
        (([sj.Film(jnp.zeros(1))], 10, KEY), "none of these 1 is a Layer"),
        (([half_space], 1, KEY), "photons must be at least 2"),
        (([half_space], 2**30, KEY), "photons must be .* below 2\\^30"),
    ):
        with pytest.raises(ValueError, match=message):
            sj.transport.monte_carlo(*arguments)
    with pytest.raises(ValueError, match="steps of edges"):
        sj.transport.monte_carlo([half_space], 10, KEY, edges=jnp.asarray([0.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match=r"HenyeyGreenstein\.g must be between -1 and 1"):
        sj.transport.HenyeyGreenstein(jnp.asarray(1.0))
    with pytest.raises(ValueError, match="one for each of the 1 layers; got 2"):
        sj.transport.monte_carlo(
            [half_space], 10, KEY, phase=sj.transport.HenyeyGreenstein(jnp.zeros(2))
        )
