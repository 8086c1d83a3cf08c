"""Numbers that nobody here made. Random numbers, directions, interfaces, sums, and what is refused;
light that scatters once: against walks in media that hardly scatter twice, and closed forms.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32
from media import balance, layer, reflectance

import splatjax as sj
from splatjax.transport._results import Sum, total
from splatjax.transport._rounds import uniforms
from splatjax.transport._walk import fresnel, scatter

KEY = jax.random.key(2026)
# Standard errors by which an estimate may be off.
ERRORS = 3
# As many as the rings of the other program have at most: one number of rings is one program.
EDGES = 400
RINGS = jnp.linspace(0.0, 4.0, EDGES)
# Where totals alone are needed: sorting photons into rings takes a third of the time.
ONE_RING = jnp.asarray([0.0, 1.0])


# How many times the photons of the suite, for half the error.
SCORES = pytest.mark.parametrize("score", [1, pytest.param(4, marks=pytest.mark.long)])


def within(estimate, reference, deviation) -> None:
    value, error = np.asarray(estimate.value), np.asarray(estimate.deviation)
    assert np.all(error < deviation), error
    assert np.all(np.abs(value - reference) < ERRORS * error), (value, reference, error)


# Layer, photons, settings; what the surface reflects, what comes back with it, what goes through.
PUBLISHED = {
    # Albedo 0.9, g 0.75, optical thickness 2, indices matched: van de Hulst 1980, table 35.
    "van de Hulst's slab": (
        layer(1.0, 9 * 0.25, 1.0, 0.2),
        625_000,
        {"edges": RINGS, "g": 0.75},
        (0, 0.09739, 0.66096),
    ),
    # Albedo 0.9, isotropic, index 1.5: Giovanelli 1955. What the surface reflects is counted.
    "Giovanelli's half space": (
        layer(1.0, 9.0, 1.5),
        750_000,
        {"edges": RINGS},
        (0.04, 0.2600, None),
    ),
    # Isotropic, indices matched, normal incidence: 1 - H(1) sqrt(1 - albedo). One walk serves all.
    "Chandrasekhar's half spaces": (
        layer(1 / np.asarray([0.2, 0.5, 0.9, 0.95]) - 1, 1.0, 1.0),
        900_000,
        {"edges": ONE_RING},
        (0, np.asarray([0.03523052, 0.11522588, 0.41494748, 0.53554099]), None),
    ),
}


@SCORES
@pytest.mark.parametrize("case", PUBLISHED)
def test_totals_are_those_published(float32, case, score):
    """Photons too faint to follow are given up: others carry for them, and nothing of theirs is
    counted.
    """
    medium, photons, settings, (surface, reflected, transmitted) = PUBLISHED[case]
    found = sj.transport.monte_carlo([medium], score * photons, KEY, **settings)
    np.testing.assert_allclose(found.specular, surface, rtol=1e-6)
    deviation = 4e-4 / score**0.5 / (1 - surface)
    within(found.total_reflectance, (reflected - surface) / (1 - surface), deviation)
    if transmitted is not None:
        within(found.total_transmittance, transmitted, deviation)
    np.testing.assert_array_equal(found.unfinished.value, 0)
    assert np.all(np.abs(balance(found)) < 1e-5)


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
    is_slab = thickness < float("inf")
    sides = [(found.reflected, "Rd_r"), (found.transmitted, "Tt_r")]
    for ours, column in sides if is_slab else sides[:1]:
        theirs = np.asarray(data[column])[:-1] / entering
        places = np.flatnonzero(theirs * area * inputs["photons"] > 300)
        value, error = (np.asarray(each)[places, 0] for each in (ours.value, ours.deviation))
        error *= np.sqrt(1 + photons / inputs["photons"] / entering)
        chi_squared = np.sum(((value - theirs[places]) / error) ** 2)
        assert len(places) > 30
        assert abs(chi_squared - len(places)) < 4 * np.sqrt(2 * len(places)), column
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
    assert np.all(np.abs(balance(found)) < 1e-5)
    assert np.all(np.asarray(found.absorbed.value) > 0.01)
    few = sj.transport.monte_carlo([layer(0.0, 2.0, 1.4)], 100_000, KEY, edges=RINGS, flights=200)
    assert few.unfinished.value[0] > 0.05
    assert abs(balance(few)[0]) < 1e-6


KEY_OF_PARTS = jax.random.key(5)
HALF_SPACE = [layer([0.1, 0.1], 1.0, 1.0)]


@pytest.mark.once
def test_random_words_are_those_of_jax():
    number, lanes = jnp.asarray(7), jnp.arange(100, dtype=jnp.uint32)
    words = [
        threefry_2x32(
            jax.random.key_data(KEY_OF_PARTS),
            jnp.concatenate([lanes, jnp.full_like(lanes, 14 + half)]),
        )
        for half in (0, 1)
    ]
    expected = ((jnp.concatenate(words).reshape(4, 100) >> 8) + 1) / 2**24
    found = uniforms(KEY_OF_PARTS, number, 100, jnp.float32)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("g", [-0.6, 0.0, 1e-6, 0.5, 0.95])
def test_henyey_and_greensteins_angles(float64, g):
    """Its moments are the powers of g: the mean Legendre polynomials of the cosine. The direction
    itself is a unit vector.
    """
    xi = (jnp.arange(200_000.0) + 0.5) / 200_000
    for start in ((0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (0.0, 0.0, -1.0)):
        before = tuple(jnp.full_like(xi, each) for each in start)
        angle = (xi * 7919) % 1.0
        after = scatter(before, jnp.full_like(xi, g), xi, angle)
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
        moment, sj.scattering.ExactFresnel().first_moment(jnp.asarray([eta]))[0], atol=2e-6
    )
    # Snell's law, where light goes on.
    goes = np.asarray(reflectance) < 1
    np.testing.assert_allclose((1 - onward**2)[goes], (eta**2 * (1 - mu**2))[goes], atol=1e-12)


def test_sums_keep_what_rounding_takes(dtype):
    term, nothing = jnp.asarray(0.1, jnp.float32), jnp.zeros((), jnp.float32)
    added = jax.lax.fori_loop(0, 300_000, lambda _, each: each.plus(term), Sum(nothing, nothing))
    mean = added.high / 300_000 + added.low / 300_000
    np.testing.assert_allclose(mean, np.float32(0.1), rtol=1e-7)
    values = jnp.full((8192, 2), 0.1, jnp.float32)
    np.testing.assert_allclose(
        total(jnp.ones(8192, jnp.float32), values), 8192 * np.float32(0.1), rtol=2e-6
    )


def test_rings_are_where_they_say(float64):
    edges = np.geomspace(0.1, 2.0, 129)
    found = sj.transport.monte_carlo(HALF_SPACE, 65_536, KEY_OF_PARTS, edges=edges)
    means = 2 / 3 * np.diff(edges**3) / np.diff(edges**2)
    np.testing.assert_allclose(found.radii, means, rtol=1e-6)
    inside = np.pi * np.sum(found.reflected.value[:, 0] * np.diff(edges**2))
    # What leaves within the first edge and beyond the last is in no ring, and in the total.
    assert 0.2 < inside < 0.9 * float(found.total_reflectance.value[0])
    profile = found.profile()
    np.testing.assert_array_equal(profile.deviation, found.reflected.deviation)
    np.testing.assert_allclose(profile(found.radii), found.reflected.value, rtol=1e-6)


def test_progress_is_told(float32):
    reports = []
    sj.transport.monte_carlo(
        [layer(0.02, 1.0, 1.0)],
        1_000_000,
        KEY,
        edges=RINGS,
        progress=lambda *progress: reports.append(progress),
    )
    assert len(reports) > 1
    assert reports == sorted(reports)
    assert reports[-1] == (1_000_000, 1_000_000)


@pytest.mark.parametrize(
    ("layers", "settings", "message"),
    [
        (HALF_SPACE * 2, {}, "layer 1 of 2 is infinitely thick"),
        ([sj.Film(0.0)], {}, "none of these 1"),
        (HALF_SPACE, {"photons": 1}, "photons must be at least 2"),
        (HALF_SPACE, {"photons": 2**30}, "photons must be .* below 2\\^30"),
        (HALF_SPACE, {"edges": [0.0, 1.0, 1.0]}, "steps of edges"),
        (HALF_SPACE, {"g": [0, 0]}, "of the 1 layers; got 2"),
        (HALF_SPACE, {"g": 1.0}, "g must be between -1 and 1"),
    ],
)
def test_bad_arguments_are_refused(layers, settings, message):
    with pytest.raises(ValueError, match=message):
        sj.transport.monte_carlo(layers, key=KEY_OF_PARTS, **({"photons": 10} | settings))


ETAS = (1.0, 1.4)


def single(albedo=0.9, eta=1.0, channels=1):
    return sj.SingleScattering(sj.Medium([1 - albedo] * channels, albedo, eta))


@pytest.mark.parametrize("eta", ETAS)
def test_it_is_what_walks_scatter_where_hardly_any_light_scatters_twice(eta, float32):
    albedo, edges = 2e-3, np.geomspace(0.05, 6.0, 12)
    medium, key = [layer(1 - albedo, albedo, eta)], jax.random.key(7)
    found = sj.transport.monte_carlo(medium, 1_000_000, key, edges=edges)
    ours, total = single(albedo, eta), found.total_reflectance
    # What scatters twice adds less than the albedo to one.
    slack = 4 * total.deviation + albedo * total.value
    np.testing.assert_array_less(np.abs(ours.total_reflectance() - total.value), slack)
    # Within a ring the profile is steep: compare energies, by many radii a ring.
    r = np.linspace(edges[1:-2], edges[2:-1], 101)
    middle = 0.5 * (r[1:] + r[:-1])
    values = np.asarray(ours(jnp.asarray(middle)))[..., 0]
    rings = np.mean(values * middle, axis=0) / np.mean(middle, axis=0)
    value, deviation = (
        np.asarray(each)[1:-1, 0] for each in (found.reflected.value, found.reflected.deviation)
    )
    np.testing.assert_array_less(np.abs(rings - value), 4 * deviation + 3 * albedo * rings)


@pytest.mark.parametrize("eta", ETAS)
def test_radiance_integrates_to_the_total_and_to_the_directional_albedo(eta):
    ours, mu_i = single(eta=eta), jnp.asarray([1.0, 0.3, 0.0])
    nodes, weights = np.polynomial.legendre.leggauss(400)
    mu, weights = 0.25 * (nodes + 1) ** 2, 0.5 * (nodes + 1) * weights
    mu_o = jnp.broadcast_to(jnp.asarray(mu)[:, None], (len(mu), 3))
    radiance = np.asarray(ours.reflected(jnp.broadcast_to(mu_i, mu_o.shape), mu_o))[..., 0]
    found = 2 * np.pi * (weights * mu) @ radiance
    np.testing.assert_allclose(found, ours.directional_albedo(mu_i)[:, 0], rtol=2e-3)
    np.testing.assert_allclose(found[0], ours.total_reflectance()[0], rtol=1e-4)


def test_matched_indices_have_the_closed_forms():
    """Chandrasekhar 1960: `alpha / 4 pi (mu + mu_0)`, and `alpha (1 - log 2) / 2` in all along the
    normal.
    """
    ours = single(0.7)
    np.testing.assert_allclose(ours.total_reflectance(), 0.35 * (1 - np.log(2)), rtol=1e-5)
    mu_i, mu_o = jnp.asarray([[1.0, 0.3, 0.05], [0.2, 0.9, 0.05]])
    expected = 0.7 / (4 * np.pi * (mu_i + mu_o))
    np.testing.assert_allclose(ours.reflected(mu_i, mu_o)[:, 0], expected, rtol=1e-5)


def test_it_is_reciprocal():
    """The radiance per irradiance outside is the same both ways, once what enters is counted as
    what leaves.
    """
    cosines = jnp.asarray([0.9, 0.2])
    there, back = single(eta=1.5).reflected(cosines, cosines[::-1])[:, 0]
    steep, grazing = (1 - reflectance(mu, 1 / 1.5) for mu in (0.9, 0.2))  # of what enters
    np.testing.assert_allclose(there * steep, back * grazing, rtol=1e-5)


def test_gradients_at_matched_indices_are_the_limits_and_finite_at_grazing_angles(float64):
    @jax.jit
    def radiance(eta, mu_i, mu_o):
        return single(0.9, eta).reflected(mu_i, mu_o)[0]

    slope, step = jax.jit(jax.grad(radiance)), 1e-5
    for mu in ((0.7, 0.4), (1.0, 1.0)):
        expected = (radiance(1 + step, *mu) - radiance(1 - step, *mu)) / (2 * step)
        np.testing.assert_allclose(slope(1.0, *mu), expected, rtol=1e-4, atol=1e-8)
    for mu in ((0.0, 0.5), (0.5, 0.0), (0.0, 0.0)):
        assert np.isfinite(slope(1.0, *mu))


@pytest.mark.long
@pytest.mark.once
@pytest.mark.parametrize("sigma_a", [1.0, 2.0, 5.0])
def test_the_profile_of_absorbing_media_that_scatter_forward(float32, sigma_a):
    """In rings around the point of entry, in mean free paths; the shape of multiple scattering is
    that of isotropic scattering.
    """
    medium, edges = sj.Medium([sigma_a], [1.0], 1.4), np.asarray([0, 0.2, 0.5, 1, 2, 4])
    edges = edges / float(medium.sigma_t_prime[0])
    walk = sj.transport.monte_carlo(
        [sj.Layer(medium, jnp.inf)], 400_000, jax.random.key(3), edges=edges, g=0.8
    )
    profile = sj.fitting.TransportModel(0.8).profile(medium)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    r = jnp.asarray(middle[:, None] + half[:, None] * nodes[None])
    means = np.sum(weights[None] * r * profile(r)[..., 0], axis=1) / (2 * middle)
    ratio = means / np.asarray(walk.reflected.value)[:, 0]
    np.testing.assert_allclose(ratio, 1, atol=0.25)


def test_a_table_and_a_photon_beam_are_it_and_the_rest():
    r, ours = jnp.asarray([0.1, 0.5, 2.0]), single(0.97, 1.3, channels=2)
    table = sj.scattering.Tabulated(r, 2 * ours(r), total=2 * ours.total_reflectance())
    beam = sj.scattering.PhotonBeam(ours.medium)
    assert jax.tree.all(jax.tree.map(np.array_equal, beam.single_scattered(), ours))
    for whole, rest in ((table, table.without(ours)), (beam, beam.multiply_scattered())):
        np.testing.assert_allclose(rest(r) + ours(r), whole(r), rtol=1e-5)
        total = rest.total_reflectance() + ours.total_reflectance()
        np.testing.assert_allclose(total, whole.total_reflectance(), rtol=1e-5)
