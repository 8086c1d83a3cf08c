"""Light that scatters once: against walks in media that hardly scatter twice, against closed forms,
and in a picture.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from media import layer

import splatjax as sj
from splatjax.scattering import SingleScattering

ETAS = (1.0, 1.4)


def single(albedo=0.9, eta=1.0, channels=1):
    return SingleScattering(sj.Medium([1 - albedo] * channels, albedo, eta))


@pytest.mark.parametrize("eta", ETAS)
def test_it_is_what_walks_scatter_where_hardly_any_light_scatters_twice(eta, float32):
    albedo = 2e-3
    found = sj.transport.monte_carlo(
        [layer(1 - albedo, albedo, eta)],
        1_000_000,
        jax.random.key(7),
        edges=jnp.geomspace(0.05, 6.0, 12),
    )
    ours = single(albedo, eta)
    total = found.total_reflectance
    # What scatters twice adds less than the albedo to one.
    slack = 4 * total.deviation + albedo * total.value
    assert abs(float((ours.total_reflectance() - total.value)[0])) < float(slack[0])
    profile = found.profile()
    # Within a ring the profile is steep: compare energies, by many radii a ring.
    edges = np.asarray(found.edges)
    r = np.linspace(edges[1:-2], edges[2:-1], 101)
    middle = 0.5 * (r[1:] + r[:-1])
    values = np.asarray(ours(jnp.asarray(middle)))[..., 0]
    rings = np.mean(values * middle, axis=0) / np.mean(middle, axis=0)
    difference = np.abs(rings - np.asarray(profile.values[1:-1, 0]))
    assert np.all(difference < 4 * profile.deviation[1:-1, 0] + 3 * albedo * rings)


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
    np.testing.assert_allclose(
        float(ours.total_reflectance()[0]), 0.35 * (1 - np.log(2)), rtol=1e-5
    )
    mu_i, mu_o = jnp.asarray([1.0, 0.3, 0.05]), jnp.asarray([0.2, 0.9, 0.05])
    expected = 0.7 / (4 * np.pi * np.asarray(mu_i + mu_o))
    np.testing.assert_allclose(np.asarray(ours.reflected(mu_i, mu_o))[:, 0], expected, rtol=1e-5)


def test_it_is_reciprocal():
    """The radiance per irradiance outside is the same both ways, once what enters is counted as
    what leaves.
    """
    ours = single(eta=1.5)
    there, back = (
        ours.reflected(*pair)[0]
        for pair in (map(jnp.asarray, (0.9, 0.2)), map(jnp.asarray, (0.2, 0.9)))
    )

    def enters(mu):
        inside = np.sqrt(1 - (1 - mu * mu) / 2.25)
        across, along = (
            (mu - 1.5 * inside) / (mu + 1.5 * inside),
            (inside - 1.5 * mu) / (inside + 1.5 * mu),
        )
        return 1 - 0.5 * (across**2 + along**2)

    np.testing.assert_allclose(float(there) * enters(0.9), float(back) * enters(0.2), rtol=1e-5)


def test_gradients_at_matched_indices_are_the_limits_and_finite_at_grazing_angles(float64):
    @jax.jit
    def radiance(eta, mu_i, mu_o):
        return single(0.9, eta).reflected(mu_i, mu_o)[0]

    slope = jax.jit(jax.grad(radiance))
    for mu in ((0.7, 0.4), (1.0, 1.0), (0.0, 0.5), (0.5, 0.0), (0.0, 0.0)):
        found = float(slope(1.0, *mu))
        assert np.isfinite(found)
        if min(mu) > 0:
            step = 1e-5
            expected = float(radiance(1 + step, *mu) - radiance(1 - step, *mu)) / (2 * step)
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-8)


def test_a_table_without_it_is_the_rest():
    ours = single(channels=2)
    radii = jnp.asarray([0.1, 0.5, 2.0])
    table = sj.scattering.Tabulated(
        radii, 2 * ours(radii), total=2 * ours.total_reflectance()
    ).without(ours)
    np.testing.assert_allclose(np.asarray(table.values), np.asarray(ours(radii)), rtol=1e-5)
    np.testing.assert_allclose(
        np.asarray(table.total), np.asarray(ours.total_reflectance()), rtol=1e-5
    )


def test_a_table_from_zero_is_refused():
    table = sj.scattering.Tabulated(jnp.asarray([0.0, 1.0]), jnp.ones((2, 1)))
    with pytest.raises(ValueError, match="infinite at r = 0"):
        table.without(single())


def test_photon_beam_is_it_and_the_rest():
    beam = sj.scattering.PhotonBeam(
        sj.Medium(jnp.asarray([0.02]), jnp.asarray([0.8]), jnp.asarray([1.3]))
    )
    rest, once = beam.multiply_scattered(), SingleScattering(beam.medium)
    r = jnp.asarray([0.2, 1.0, 4.0])
    np.testing.assert_allclose(np.asarray(rest(r) + once(r)), np.asarray(beam(r)), rtol=1e-5)
    total = rest.total_reflectance() + once.total_reflectance()
    np.testing.assert_allclose(np.asarray(total), np.asarray(beam.total_reflectance()), rtol=1e-5)
