"""Numbers that nobody here made."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from media import layer

import splatjax as sj
from splatjax.transport import MonteCarlo

KEY = jax.random.key(2026)
# Standard errors by which an estimate may be off.
ERRORS = 3
# As many as the rings of the other program have at most: one number of rings is one program.
EDGES = 400
# Where totals alone are asked for: sorting photons into rings takes a third of the time.
ONE_RING = jnp.asarray([0.0, 1.0])


# How many times the photons of the suite, for half the error.
SCORES = pytest.mark.parametrize("score", [1, pytest.param(4, marks=pytest.mark.long)])


def within(estimate, reference, deviation) -> None:
    """Hold an estimate to a reference, and its error below what makes that worth something."""
    value, error = np.asarray(estimate.value), np.asarray(estimate.deviation)
    assert np.all(error < deviation), error
    assert np.all(np.abs(value - reference) < ERRORS * error), (value, reference, error)


@SCORES
def test_van_de_hulsts_slab(float32, score):
    """Albedo 0.9, g 0.75, optical thickness 2, indices matched: van de Hulst 1980, table 35."""
    slab = layer(1.0, 9 * 0.25, 1.0, 0.2)
    found = sj.transport.monte_carlo(
        [slab], score * 625_000, KEY, edges=ONE_RING, phase=sj.transport.HenyeyGreenstein(0.75)
    )
    within(found.total_reflectance, 0.09739, 4e-4 / score**0.5)
    within(found.total_transmittance, 0.66096, 4e-4 / score**0.5)


@SCORES
def test_giovanellis_half_space(float32, score):
    """Albedo 0.9, isotropic, index 1.5: Giovanelli 1955. What the surface reflects is counted."""
    found = sj.transport.monte_carlo(
        [layer(1.0, 9.0, 1.5)], score * 750_000, KEY, edges=jnp.linspace(0.0, 4.0, EDGES)
    )
    np.testing.assert_allclose(found.specular, 0.04, rtol=1e-6)
    entering = 1 - found.specular
    total = type(found.total_reflectance)(
        found.specular + entering * found.total_reflectance.value,
        entering * found.total_reflectance.deviation,
    )
    within(total, 0.2600, 4e-4 / score**0.5)
    # Photons too faint to follow are given up: others carry for them, and nothing of theirs is
    # counted.
    np.testing.assert_array_equal(found.unfinished.value, 0)
    assert abs(found.balance()[0]) < 1e-5


@SCORES
def test_chandrasekhars_half_space(float32, score):
    """Isotropic, indices matched, normal incidence: 1 - H(1) sqrt(1 - albedo). One walk serves all
    four.
    """
    albedo = np.asarray([0.2, 0.5, 0.9, 0.95])
    found = sj.transport.monte_carlo(
        [layer(1 / albedo - 1, 1.0, 1.0)], score * 900_000, KEY, edges=ONE_RING
    )
    within(
        found.total_reflectance, [0.03523052, 0.11522588, 0.41494748, 0.53554099], 4e-4 / score**0.5
    )


def chi_squared(ours, photons, theirs, their_photons, places) -> None:
    """Hold rings to those of another program. It gives no errors: they are ours, by the number of
    photons.
    """
    value, error = (
        np.asarray(each)[: len(places), 0][places] for each in (ours.value, ours.deviation)
    )
    chi = np.sum((value - theirs[places]) ** 2 / (error**2 * (1 + photons / their_photons)))
    freedom = np.sum(places)
    assert freedom > 30
    assert abs(chi - freedom) < 4 * np.sqrt(2 * freedom), (chi, freedom)


@pytest.mark.shared
@pytest.mark.parametrize(
    "name",
    [
        "skin1_R_near",
        "skin1_R_far",
        "skin1_G_near",
        pytest.param("marble_G_far", marks=pytest.mark.long),
        "slab_marbleG_d2.0",
    ],
)
def test_ring_by_ring(float32, monte_carlo, name):
    """MCML: Wang, Jacques and Zheng 1995, run for this project."""
    data = monte_carlo(name)
    inputs, photons = data["inputs"], 500_000
    (one,) = inputs["layers"]
    thickness = one["d"] if one["d"] < 1e7 else float("inf")
    edges = inputs["dr"] * jnp.arange(EDGES, dtype=jnp.float32)
    found = sj.transport.monte_carlo(
        [layer(one["mua"], one["mus"], one["n"], thickness)], photons, KEY, edges=edges
    )
    entering = 1 - data["Rsp"]
    np.testing.assert_allclose(found.specular, data["Rsp"], rtol=1e-4)
    # Rings that a few hundred photons reached: their sums are nearly normal.
    area = np.diff(np.asarray(edges, np.float64)[: inputs["nr"]] ** 2) * np.pi
    for side, column in ((found.reflected, "Rd_r"), (found.transmitted, "Tt_r")):
        theirs = np.asarray(data[column])[:-1] / entering
        places = theirs * area * inputs["photons"] > 300
        if column == "Rd_r" or thickness < float("inf"):
            chi_squared(side, photons, theirs, inputs["photons"] * entering, places)
    total = data["Rd"] / entering
    # Their error, by the spread of a share among so many photons, is no larger than ours scaled.
    error = float(found.total_reflectance.deviation[0]) * np.sqrt(1 + photons / inputs["photons"])
    assert abs(float(found.total_reflectance.value[0]) - total) < ERRORS * error


def test_what_is_reported_adds_up(float32):
    film = sj.Film(jnp.asarray([0.1]))
    stack = [film, layer(0.2, 1.0, 1.4, 0.5), layer(0.05, 3.0, 1.3, 2.0)]
    found = sj.transport.monte_carlo(
        stack, 200_000, KEY, eta_below=1.5, incidence=sj.transport.DiffuseIncidence()
    )
    assert isinstance(found, MonteCarlo)
    assert np.all(np.abs(found.balance()) < 1e-5)
    assert np.all(np.asarray(found.absorbed.value) > 0.01)
    few = sj.transport.monte_carlo(
        [layer(0.0, 2.0, 1.4)], 100_000, KEY, edges=jnp.linspace(0.0, 4.0, EDGES), flights=200
    )
    assert few.unfinished.value[0] > 0.05
    assert abs(few.balance()[0]) < 1e-6
