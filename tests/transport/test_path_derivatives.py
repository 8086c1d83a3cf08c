"""Derivatives by the likelihood of paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from media import layer

import splatjax as sj

KEY = jax.random.key(11)
ERRORS = 3.5
EDGES = jnp.linspace(0.0, 3.0, 11)


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
        return sj.transport.monte_carlo(stack(absorption), photons, KEY, edges=EDGES)

    value, slope = jax.jvp(estimate, (at,), (jnp.asarray(1.0),))
    below, above = estimate(at - step), estimate(at + step)
    for part in (
        "reflected",
        "transmitted",
        "total_reflectance",
        "total_transmittance",
        "absorbed",
    ):
        found, one, other = (
            np.asarray(getattr(each, part).value) for each in (slope, below, above)
        )
        # A photon given up on one side of the difference and kept on the other is 1e-4 of one in
        # 3,000.
        np.testing.assert_allclose(
            found, (other - one) / (2 * step), rtol=tolerance, atol=1e-4 * np.abs(found).max()
        )
    np.testing.assert_array_equal(value.reflected.value, estimate(at).reflected.value)
    np.testing.assert_array_equal(slope.reflected.deviation, 0)
    assert slope.total_reflectance.value[0] < -0.1


@pytest.mark.parametrize("score", [1, pytest.param(4, marks=pytest.mark.long)])
def test_scattering_by_differences_of_other_walks(float32, score):
    """Within their errors, for all that is reported."""
    # A long step: dividing by it magnifies the errors of the differences, and what they bend over
    # it is a tenth of those.
    photons, step = score * 250_000, 0.2
    _, _, by_scattering = sj.transport.path_derivatives(slab(0.2, 2.0), photons, KEY)
    below, above = (
        sj.transport.monte_carlo(
            slab(0.2, 2.0 + sign * step), photons, jax.random.fold_in(KEY, sign + 2)
        )
        for sign in (-1, 1)
    )
    for name in ("total_reflectance", "total_transmittance", "absorbed"):
        one, other, found = getattr(below, name), getattr(above, name), getattr(by_scattering, name)
        difference = (np.asarray(other.value) - np.asarray(one.value)) / (2 * step)
        error = np.hypot(other.deviation, one.deviation) / (2 * step)
        allowed = ERRORS * np.hypot(error, found.deviation[0])
        assert np.all(np.abs(found.value[0] - difference) < allowed), (
            name,
            found.value[0],
            difference,
            allowed,
        )
        assert np.all(allowed < 0.4 / score**0.5 * np.max(np.abs(difference))), name


def test_a_half_space_knows_albedo_alone(float32):
    """`sigma_a dR/dsigma_a + sigma_s dR/dsigma_s = 0` for the total, and what is not reflected is
    absorbed.
    """
    found, by_absorption, by_scattering = sj.transport.path_derivatives(
        [layer(0.2, 1.0, 1.3)], 400_000, KEY
    )
    along = (
        0.2 * by_absorption.total_reflectance.value + 1.0 * by_scattering.total_reflectance.value
    )
    error = np.hypot(
        0.2 * by_absorption.total_reflectance.deviation, by_scattering.total_reflectance.deviation
    )
    assert np.all(np.abs(along) < ERRORS * error)
    assert np.all(error < 0.1 * np.abs(0.2 * by_absorption.total_reflectance.value))
    for by in (by_absorption, by_scattering):
        balance = by.total_reflectance.value[0] + by.absorbed.value[0, 0]
        assert np.all(
            np.abs(balance)
            < ERRORS * np.hypot(by.total_reflectance.deviation[0], by.absorbed.deviation[0, 0])
        )
    assert np.all(found.total_reflectance.deviation > 0)


def test_errors_are_the_spread_of_estimates_and_of_derivatives(float32):
    """Twenty-five runs scatter as much as each says of itself."""
    runs = [
        sj.transport.path_derivatives([layer(0.2, 1.0, 1.3)], 4_000, jax.random.key(seed))
        for seed in range(25)
    ]
    for each in zip(*runs, strict=True):
        values = np.ravel([part.total_reflectance.value for part in each])
        stated = np.mean([part.total_reflectance.deviation for part in each])
        assert 0.65 < np.std(values, ddof=1) / stated < 1.4


@pytest.mark.once
def test_reverse_mode_is_forward_mode():
    rows = jnp.asarray(np.random.default_rng(3).normal(size=10))

    def loss(coefficients):
        found = sj.transport.monte_carlo(
            slab(coefficients[0], coefficients[1]), 2_000, KEY, edges=EDGES
        )
        return (
            rows @ found.reflected.value[:, 0]
            + found.absorbed.value[1, 0]
            + found.profile()(EDGES[3:4])[0, 0]
        )

    at = jnp.asarray([0.2, 2.0])
    reverse, compiled = jax.grad(loss)(at), jax.jit(jax.grad(loss))(at)
    forward = [jax.jvp(loss, (at,), (direction,))[1] for direction in jnp.eye(2)]
    np.testing.assert_allclose(reverse, forward, rtol=1e-4)
    np.testing.assert_allclose(reverse, compiled, rtol=1e-4)
    assert np.all(np.abs(np.asarray(reverse)) > 1e-3)


def test_without_absorption_it_is_the_limit(float64):
    """The path lengths of all that leaves: one-sided differences of the same walks tend to it."""

    def reflectance(sigma_a):
        return sj.transport.monte_carlo(
            [layer(sigma_a, 2.0, 1.4, 1.0)], 2_000, KEY
        ).total_reflectance.value[0]

    slope = jax.grad(reflectance)(jnp.asarray([0.0]))[0]
    quotients = [
        (reflectance(jnp.asarray([h])) - reflectance(jnp.asarray([0.0]))) / h for h in (2e-4, 1e-4)
    ]
    np.testing.assert_allclose(2 * quotients[1] - quotients[0], slope, rtol=1e-5)


def test_what_paths_do_not_know_is_refused(dtype):
    def reflectance(thickness, eta):
        return sj.transport.monte_carlo(
            [layer(0.2, 2.0, eta, thickness)], 100, KEY
        ).total_reflectance.value[0]

    for argument, name in enumerate(("thickness", "eta")):
        with pytest.raises(ValueError, match=f"no derivative in {name}"):
            jax.grad(reflectance, argument)(1.0, 1.4)
