"""Symmetries of transport, and derivatives by the likelihood of paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from media import INFINITE, layer

import splatjax as sj

KEY = jax.random.key(7)
# The first two fill all lanes, so that walks alike in their layers are one program.
PHOTONS, SOME, FEW = 400_000, 65_536, 10_000
# Of rings given here: as many as there are by default, for the same reason.
EDGES = 129
# Standard errors between two estimates: of some dozens here, none should be farther off.
ERRORS = 3.5


def agree(one, other, rtol=0.0) -> None:
    error = np.hypot(one.deviation, other.deviation)
    assert np.all(error > 0)
    slack = ERRORS * error + rtol * np.abs(one.value)
    np.testing.assert_array_less(np.abs(one.value - other.value), slack)


def test_a_split_slab_is_the_whole(float32):
    whole = sj.transport.monte_carlo([layer(0.1, 2.0, 1.4, 1.0)], PHOTONS, KEY, eta_below=1.2)
    parts = [layer(0.1, 2.0, 1.4, 0.3), layer(0.1, 2.0, 1.4, 0.7)]
    split = sj.transport.monte_carlo(parts, PHOTONS, jax.random.fold_in(KEY, 1), eta_below=1.2)
    agree(whole.total_reflectance, split.total_reflectance)
    agree(whole.total_transmittance, split.total_transmittance)
    absorbed = sj.transport.SampleMean(
        jnp.sum(split.absorbed.value, axis=0, keepdims=True),
        jnp.linalg.norm(split.absorbed.deviation, axis=0, keepdims=True),
    )
    agree(whole.absorbed, absorbed)
    # Ring by ring, where many photons leave.
    many = whole.reflected.deviation[:, 0] < 0.05 * whole.reflected.value[:, 0]
    error = np.hypot(whole.reflected.deviation, split.reflected.deviation)
    pull = ((whole.reflected.value - split.reflected.value) / error)[many]
    assert pull.size > 40
    assert abs(np.sum(pull**2) - pull.size) < 4 * np.sqrt(2 * pull.size)


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

    arriving = (
        jax.tree.map(
            lambda part, found=found: part * (1 - found.specular), found.total_transmittance
        )
        for found in (down, up)
    )
    assert abs(down.specular[0] - up.specular[0]) > 0.01
    assert abs(down.total_reflectance.value[0] - up.total_reflectance.value[0]) > 0.05
    agree(*arriving)


def test_similarity(float32):
    """Scattering far and forward looks like a little in all directions, for a medium that absorbs
    little.
    """
    medium = [layer(0.0041, 2.62, 1.5)]
    isotropic, forward = (sj.transport.monte_carlo(medium, FEW, KEY, g=g) for g in (0.0, 0.9))
    agree(isotropic.total_reflectance, forward.total_reflectance, rtol=2e-3)


def test_units(dtype):
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

    def walk(key, photons=PHOTONS, **medium):
        return sj.transport.monte_carlo([layer(**medium, eta=1.4)], photons, key, edges=edges)

    absorptions = [0.4, 0.01, 0.1]
    together = walk(KEY, sigma_a=absorptions, sigma_s_prime=2.0, thickness=1.0).total_reflectance
    for channel, sigma_a in enumerate(absorptions):
        key = jax.random.fold_in(KEY, channel)
        alone = walk(key, sigma_a=sigma_a, sigma_s_prime=2.0, thickness=1.0).total_reflectance
        agree(jax.tree.map(lambda each, c=channel: each[c : c + 1], together), alone)
    assert together.value[1] > together.value[2] > together.value[0]
    # A half space of one index is its own image in any scale; a slab is not.
    scaled = {"sigma_a": [0.1, 0.2, 0.4], "sigma_s_prime": [1.0, 2.0, 4.0]}
    totals = walk(KEY, **scaled, thickness=INFINITE).total_reflectance.value
    np.testing.assert_allclose(totals, totals[0], rtol=1e-6)
    slab = walk(KEY, SOME, **scaled, thickness=1.0)
    assert np.all(np.diff(slab.total_transmittance.value) < -0.05)


@pytest.mark.once
def test_batches_of_media_are_walks_of_each(float32):
    def total(sigma_a):
        layers = [layer(sigma_a, 1.0, 1.3, jnp.inf)]
        return sj.transport.monte_carlo(layers, 1e4, KEY).total_reflectance

    absorptions = jnp.asarray([0.1, 0.4])
    expected = jax.tree.map(lambda *rows: jnp.stack(rows), *map(total, absorptions))
    agree(jax.vmap(total)(absorptions), expected)


def test_a_film_is_a_thin_layer_that_absorbs(float32):
    thin, below = 1e-3, layer(0.05, 2.0, 1.4, 2.0)
    film = sj.transport.monte_carlo([sj.Film([0.3]), below], PHOTONS, KEY)
    slab = sj.transport.monte_carlo(
        [layer(0.3 / thin, 1e-3, 1.4, thin), below], PHOTONS, jax.random.fold_in(KEY, 1)
    )
    agree(film.total_reflectance, slab.total_reflectance, rtol=1e-3)
    agree(film.absorbed, slab.absorbed, rtol=1e-3)
    bare = sj.transport.monte_carlo([below], PHOTONS, KEY)
    assert film.total_reflectance.value[0] < 0.6 * bare.total_reflectance.value[0]


KEY_OF_PATHS = jax.random.key(11)
RINGS = jnp.linspace(0.0, 3.0, 11)


def slab(sigma_a, sigma_s_prime) -> list[sj.Layer]:
    return [layer(sigma_a, sigma_s_prime, 1.4, 1.0), layer(0.3, 1.5, 1.3, 0.5)]


ABSORBING = {
    "a layer": (lambda sigma_a: slab(sigma_a, 2.0), 3_000, 1e-4),
    "a film": (lambda depth: [sj.Film(depth[None]), layer(0.1, 2.0, 1.4, 1.0)], 2_000, 1e-3),
}


@pytest.mark.parametrize("case", ABSORBING)
def test_absorption_by_differences_of_the_same_walks(float64, case):
    """Photons fly alike whatever is absorbed, so that the derivative is that of the estimate
    itself, ring by ring.
    """
    stack, photons, tolerance = ABSORBING[case]
    at, step = jnp.asarray(0.2), 1e-4

    def estimate(absorption):
        return sj.transport.monte_carlo(stack(absorption), photons, KEY_OF_PATHS, edges=RINGS)

    value, slope = jax.jvp(estimate, (at,), (jnp.asarray(1.0),))
    below, above = estimate(at - step), estimate(at + step)
    totals = "total_reflectance", "total_transmittance"
    for part in ("reflected", "transmitted", *totals, "absorbed"):
        found, one, other = (getattr(each, part).value for each in (slope, below, above))
        # A photon given up on one side of the difference and kept on the other is 1e-4 of one in
        # 3,000.
        np.testing.assert_allclose(
            found, (other - one) / (2 * step), rtol=tolerance, atol=1e-4 * np.abs(found).max()
        )
    np.testing.assert_array_equal(value.reflected.value, estimate(at).reflected.value)
    np.testing.assert_array_equal(slope.reflected.deviation, 0)
    assert slope.total_reflectance.value[0] < -0.1


def derivatives(stack, photons, runs=16):
    """Derivatives of results by separate walks, and of each the mean and its standard error."""
    slopes = [
        jax.jvp(
            lambda scale, key=jax.random.fold_in(KEY_OF_PATHS, 100 + run): sj.transport.monte_carlo(
                stack(scale), photons // runs, key
            ),
            (jnp.asarray(0.0),),
            (jnp.asarray(1.0),),
        )[1]
        for run in range(runs)
    ]

    def mean(*values):
        values = jnp.stack(values)
        return sj.transport.SampleMean(
            jnp.mean(values, axis=0), jnp.std(values, axis=0, ddof=1) / runs**0.5
        )

    names = ("total_reflectance", "total_transmittance", "absorbed")
    return {name: mean(*(getattr(slope, name).value for slope in slopes)) for name in names}


@pytest.mark.parametrize("score", [1, pytest.param(4, marks=pytest.mark.long)])
def test_scattering_by_differences_of_other_walks(float32, score):
    # A long step: dividing by it magnifies the errors of the differences, and what they bend over
    # it is a tenth of those.
    photons, step = score * 250_000, 0.2
    by_scattering = derivatives(lambda more: slab(0.2, 2.0 + more), photons)
    below, above = (
        sj.transport.monte_carlo(
            slab(0.2, 2.0 + sign * step), photons, jax.random.fold_in(KEY_OF_PATHS, sign + 2)
        )
        for sign in (-1, 1)
    )
    for name, found in by_scattering.items():
        one, other = getattr(below, name), getattr(above, name)
        difference = (other.value - one.value) / (2 * step)
        error = jnp.hypot(other.deviation, one.deviation) / (2 * step)
        agree(found, sj.transport.SampleMean(difference, error))
        allowed = ERRORS * np.hypot(error, found.deviation)
        assert np.all(allowed < 0.4 / score**0.5 * np.max(np.abs(difference))), name


def test_a_half_space_knows_albedo_alone(float32):
    """`sigma_a dR/dsigma_a + sigma_s dR/dsigma_s = 0` for the total, and what is not reflected is
    absorbed.
    """
    by_both, by_absorption, by_scattering = (
        derivatives(lambda more, a=a, s=s: [layer(0.2 + a * more, 1.0 + s * more, 1.3)], 400_000)
        for a, s in ((0.2, 1.0), (1.0, 0.0), (0.0, 1.0))
    )
    along = by_both["total_reflectance"]
    assert np.all(np.abs(along.value) < ERRORS * along.deviation)
    assert np.all(along.deviation < 0.1 * np.abs(0.2 * by_absorption["total_reflectance"].value))
    for by in (by_absorption, by_scattering):
        reflected, absorbed = by["total_reflectance"], by["absorbed"]
        balance = reflected.value + absorbed.value[0]
        assert np.all(
            np.abs(balance) < ERRORS * np.hypot(reflected.deviation, absorbed.deviation[0])
        )


def test_errors_are_the_spread_of_estimates(float32):
    runs = [
        sj.transport.monte_carlo([layer(0.2, 1.0, 1.3)], SOME, jax.random.key(seed))
        for seed in range(25)
    ]
    values = np.ravel([run.total_reflectance.value for run in runs])
    stated = np.mean([run.total_reflectance.deviation for run in runs])
    assert 0.65 < np.std(values, ddof=1) / stated < 1.4


@pytest.mark.once
def test_reverse_mode_is_forward_mode():
    rows = jnp.asarray(np.random.default_rng(3).normal(size=10))

    def loss(coefficients):
        found = sj.transport.monte_carlo(
            slab(coefficients[0], coefficients[1]), 2_000, KEY_OF_PATHS, edges=RINGS
        )
        return (
            rows @ found.reflected.value[:, 0]
            + found.absorbed.value[1, 0]
            + found.profile()(RINGS[3:4])[0, 0]
        )

    at, reverse = jnp.asarray([0.2, 2.0]), jax.grad(loss)
    forward = [jax.jvp(loss, (at,), (direction,))[1] for direction in jnp.eye(2)]
    assert np.min(np.abs(forward)) > 1e-3
    for found in (reverse(at), jax.jit(reverse)(at)):
        np.testing.assert_allclose(found, forward, rtol=1e-4)


def reflectance(sigma_a, eta=1.4, thickness=1.0):
    slab = [layer(sigma_a, 2.0, eta, thickness)]
    return sj.transport.monte_carlo(slab, 2_000, KEY_OF_PATHS).total_reflectance.value[0]


def test_without_absorption_it_is_the_limit(float64):
    """The path lengths of all that leaves: one-sided differences of the same walks tend to it."""
    far, near = ((reflectance(h) - reflectance(0.0)) / h for h in (2e-4, 1e-4))
    np.testing.assert_allclose(2 * near - far, jax.grad(reflectance)(0.0), rtol=1e-5)


def test_what_paths_do_not_know_is_refused(dtype):
    for argument, name in ((1, "eta"), (2, "thickness")):
        with pytest.raises(ValueError, match=f"no derivative in {name}"):
            jax.grad(reflectance, argument)(0.2, 1.4, 1.0)
