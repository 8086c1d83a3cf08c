"""A rough interface: drawn facets, limits, and what it does to a slab."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from splatjax.scattering import (
    BetterDipole,
    Dipole,
    EganFresnel,
    ExactFresnel,
    Layer,
    LayeredMultipole,
    Medium,
    Multipole,
    RoughFresnel,
)

DRAWN = 1.5e-3
"""Two million facets leave 3e-4; the critical angle between the nodes of the quadrature 1e-3."""


def internal_reflectance(cosine, eta):
    total = eta**2 * (1 - cosine**2) >= 1
    outside = np.sqrt(np.where(total, 1.0, 1 - eta**2 * (1 - cosine**2)))
    across, along = (
        (eta * cosine - outside) / (eta * cosine + outside),
        (cosine - eta * outside) / (cosine + eta * outside),
    )
    return np.where(total, 1.0, 0.5 * (across**2 + along**2))


@pytest.mark.parametrize("eta", [0.7, 1.3, 1.5])
@pytest.mark.parametrize("roughness", [0.2, 0.6])
def test_moments_are_those_of_drawn_facets(float64, eta, roughness):
    """Cosines of diffuse light, facets by Beckmann's slopes, each counted by how much of it is
    seen.
    """
    noise = np.random.default_rng(0)
    cosine = np.repeat(np.sqrt((np.arange(2000) + 0.5) / 2000), 1000)
    p, q = noise.normal(scale=roughness / np.sqrt(2), size=(2, cosine.size))
    seen = np.maximum(cosine + p * np.sqrt(1 - cosine**2), 0)
    reflected = internal_reflectance(seen / np.sqrt(1 + p**2 + q**2), eta)
    seen, reflected, cosine = (each.reshape(2000, 1000) for each in (seen, reflected, cosine))
    rough = np.sum(seen * reflected, axis=1) / np.sum(seen, axis=1)
    fresnel, etas = RoughFresnel(roughness), jnp.asarray([eta])
    np.testing.assert_allclose(fresnel.first_moment(etas), [np.mean(rough)], atol=DRAWN)
    np.testing.assert_allclose(
        fresnel.second_moment(etas), [1.5 * np.mean(rough * cosine[:, 0])], atol=DRAWN
    )


def test_without_roughness_it_is_smooth_and_without_contrast_nothing(dtype):
    etas = jnp.asarray([0.7, 1.0, 1.4], dtype)
    for smooth in (ExactFresnel(), EganFresnel()):
        flat = RoughFresnel(0.0, smooth)
        np.testing.assert_allclose(flat.first_moment(etas), smooth.first_moment(etas), atol=1e-6)
        np.testing.assert_allclose(flat.second_moment(etas), smooth.second_moment(etas), atol=1e-6)
    rough = RoughFresnel(1.0)
    np.testing.assert_allclose(rough.first_moment(etas)[1], 0, atol=1e-6)
    assert rough.first_moment(etas).dtype == dtype
    # All that meets it inside comes back when nothing can leave.
    np.testing.assert_allclose(rough.first_moment(jnp.asarray([60.0], dtype)), 1, atol=1e-2)


def test_derivatives_in_roughness_and_index(float64):
    # Between the kinks that the critical angle makes at the nodes.
    def moments(roughness, eta):
        fresnel = RoughFresnel(roughness)
        return fresnel.first_moment(eta), fresnel.second_moment(eta)

    check_grads(
        jax.jit(moments),
        (jnp.asarray(0.37), jnp.asarray([1.33, 1.5])),
        order=1,
        rtol=2e-3,
        eps=1e-7,
    )


def test_into_rarer_media_and_matched_ones_derivatives_are_finite_in_either_mode(float64):
    fresnel, etas = RoughFresnel(0.4), jnp.asarray([0.7, 1.0, 1.4])
    for moment in ("first_moment", "second_moment"):
        forward, reverse = (
            np.diag(jax.jit(way(getattr(fresnel, moment)))(etas))
            for way in (jax.jacfwd, jax.jacrev)
        )
        np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
        matched = jax.jacrev(getattr(ExactFresnel(), moment))(etas)[1, 1]
        np.testing.assert_allclose(forward[1], matched, rtol=1e-5, atol=1e-9)


def test_a_rough_surface_changes_the_top_of_layers_alone(float64):
    medium = Medium(jnp.asarray([0.02]), jnp.asarray([2.0]), jnp.asarray([1.4]))
    layer, rough = Layer(medium, jnp.asarray(2.0)), RoughFresnel(0.5)
    slab, both = Multipole(layer, surface=rough), Multipole(layer, fresnel=rough)
    smooth = Multipole(layer)
    assert float(slab.total_reflectance()[0]) != float(smooth.total_reflectance()[0])
    assert float(slab.total_transmittance()[0]) != float(both.total_transmittance()[0])
    stack = LayeredMultipole([layer, Layer(medium, jnp.asarray(jnp.inf))], surface=rough)
    k = jnp.asarray([[0.0], [0.7]])
    lower = Multipole(Layer(medium, jnp.asarray(jnp.inf)), eta_above=medium.eta).response(k)
    expected = Multipole(layer, eta_below=medium.eta, surface=rough).response(k).over(lower)
    np.testing.assert_allclose(
        stack.response(k).reflectance_above, expected.reflectance_above, rtol=1e-12
    )
    lossless = Layer(Medium(jnp.zeros(1), medium.sigma_s_prime, medium.eta), jnp.asarray(2.0))
    closed = Multipole(lossless, surface=rough)
    np.testing.assert_allclose(
        closed.total_reflectance() + closed.total_transmittance(), 1, rtol=1e-12
    )


def test_half_spaces_take_a_rough_surface(float64):
    medium = Medium(jnp.asarray([0.02]), jnp.asarray([2.0]), jnp.asarray([1.4]))
    for model in (Dipole, BetterDipole):
        change = (
            model(medium, RoughFresnel(0.5)).total_reflectance() - model(medium).total_reflectance()
        )
        assert 1e-4 < abs(float(change[0])) < 0.1
