"""Slabs and stacks: the inverse Hankel transform, the image sum, energy, limits, adding, the seam,
what is refused. Fresnel moments: integrals by an independent rule, published fits, and the limits
at equal indices.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from media import INFINITE, layer, reflectance
from scipy.integrate import quad
from scipy.special import expn

from splatjax.scattering import (
    Dipole,
    EganFresnel,
    ExactFresnel,
    Film,
    Layer,
    LayeredMultipole,
    Medium,
    Multipole,
    inverse_hankel_transform,
)
from splatjax.scattering._slab import diffuse_transmittance, hyperbolic_ratio

MARBLE_GREEN = (0.0041, 2.62, 1.5)


def image_sum(slab: Layer, eta_above: float, eta_below: float, r: np.ndarray, images: int):
    """Donner and Jensen's multipole, source by source: reflectance and transmittance of one
    channel.
    """
    medium, d = slab.medium, float(slab.thickness)
    length, sigma_tr = 1 / medium.sigma_t_prime[0], jnp.sqrt(medium.squared_sigma_tr[0])
    above, below = (
        2 / 3 * length * float(ExactFresnel().boundary(medium.eta / eta)[0])
        for eta in (eta_above, eta_below)
    )
    period = 2 * (d + above + below)

    def field(z):
        q = np.hypot(r, z)
        return z * (1 + sigma_tr * q) * np.exp(-sigma_tr * q) / q**3

    reflected = transmitted = 0.0
    for i in range(-images, images + 1):
        real, virtual = i * period + length, i * period - length - 2 * above
        reflected = reflected + field(real) - field(virtual)
        transmitted = transmitted + field(d - real) - field(d - virtual)
    scale = float(medium.albedo_prime[0]) / (4 * np.pi)
    return scale * reflected, scale * transmitted


@pytest.mark.parametrize("thickness", [1.35, 2.0, 8.0])
def test_closed_form_is_the_image_sum(float64, thickness):
    slab = layer(0.032, 0.74, 1.3, thickness)
    r = jnp.asarray([0.0, 0.03, 0.3, 1.0, 4.0, 10.0])
    profile = Multipole(slab, eta_above=1.1, eta_below=1.0)
    found = jnp.stack([profile(r), profile.transmittance(r)])[..., 0]
    np.testing.assert_allclose(found, image_sum(slab, 1.1, 1.0, np.asarray(r), 200), rtol=1e-10)


def test_a_slab_without_absorption_keeps_all_light(float64):
    white, lossy = (
        Multipole(layer(sigma_a, 2.0, 1.4, 3.0), eta_above=1.1, eta_below=1.5)
        for sigma_a in (0.0, 1e-9)
    )
    total = white.total_reflectance()
    np.testing.assert_allclose(total + white.total_transmittance(), 1, rtol=1e-14)
    np.testing.assert_allclose(lossy.total_reflectance(), total, rtol=1e-7)


def test_a_thick_slab_is_the_half_space(float64):
    dipole = Dipole(layer(*MARBLE_GREEN, INFINITE).medium)
    r = jnp.asarray([0.0, 0.1, 1.0, 10.0])
    for thickness in (300.0, INFINITE):
        slab = Multipole(layer(*MARBLE_GREEN, thickness))
        np.testing.assert_allclose(slab(r), dipole(r), rtol=1e-10)
        np.testing.assert_allclose(slab.total_reflectance(), dipole.total_reflectance(), rtol=1e-14)
    np.testing.assert_array_equal(slab.total_transmittance(), 0)
    np.testing.assert_array_equal(slab.transmittance(r), 0)


def test_the_sum_of_images_has_its_derivatives_where_it_is_expanded(float64):
    """The even function of s, expanded about 0 and computed: values and derivatives meet at the
    border, `s H = 0.05`.
    """
    depths = jnp.asarray([1.3, 0.4, 0.6, 2.3])
    ratio = jax.value_and_grad(lambda u: hyperbolic_ratio(u, *depths))
    border, s = 0.05**2 / 2.3**2, 0.7
    below, above = (ratio(border * side) for side in (1 - 1e-9, 1 + 1e-9))
    np.testing.assert_allclose(below[0], above[0], rtol=1e-12)
    np.testing.assert_allclose(below[1], above[1], rtol=1e-7)
    exact = np.sinh(s * 1.3) * np.cosh(s * 0.4) / np.sinh(s * 2.3)
    np.testing.assert_allclose(ratio(s * s)[0], exact, rtol=1e-14)
    np.testing.assert_allclose(ratio(0.0)[0], 1.3 / 2.3, rtol=1e-14)


def test_a_stack_of_one_is_its_layer_and_a_film_of_no_depth_changes_nothing(float64):
    slab, lower = layer(*MARBLE_GREEN, 2.0), layer(0.02, 2.0, 1.3, INFINITE)
    r, etas, film = jnp.asarray([0.0, 1.0]), {"eta_above": 1.2, "eta_below": 1.1}, Film(0.0)
    one = Multipole(slab, **etas)
    np.testing.assert_allclose(LayeredMultipole([slab], **etas)(r), one(r), rtol=1e-14)
    np.testing.assert_allclose(one.length_scale(), 1 / slab.medium.sigma_t_prime, rtol=1e-14)
    bare, films = (LayeredMultipole(s)(r) for s in ([slab, lower], [film, slab, film, lower]))
    np.testing.assert_allclose(films, bare, rtol=1e-12)


def test_films_on_each_other_are_one(float64):
    slab, thin = layer(0.1, 3.0, 1.4, INFINITE), Film(0.125)
    bare, one, two = (
        LayeredMultipole([*films, slab]).total_reflectance()
        for films in ([], [Film(0.25)], [thin, thin])
    )
    np.testing.assert_allclose(two, one, rtol=1e-14)
    # In as a beam, out as diffuse light: 0.779 and 0.649 of it at an optical depth of a quarter.
    np.testing.assert_allclose(one / bare, np.exp(-0.25) * 2 * expn(3, 0.25), rtol=1e-12)


def test_diffuse_transmittance_is_an_exponential_integral(float64):
    t = np.array([0.0, 1e-12, 1e-3, 0.25, 1.0, 5.0, 50.0])
    np.testing.assert_allclose(diffuse_transmittance(jnp.asarray(t)), 2 * expn(3, t), rtol=1e-12)
    slope = jax.vmap(jax.grad(diffuse_transmittance))(jnp.asarray(t))
    np.testing.assert_allclose(slope, -2 * expn(2, t), rtol=1e-9)


@pytest.mark.parametrize(("free_paths", "growth"), [(4, 0.069), (10, 0.034), (20, 0.023)])
def test_the_seam_between_matched_halves(float64, free_paths, growth):
    """Each half keeps its own extrapolated boundary: transmittance grows by a known amount."""
    sigma_a, sigma_s_prime, eta = MARBLE_GREEN
    thickness = free_paths / (sigma_a + sigma_s_prime)
    whole, halves = (
        LayeredMultipole([layer(*MARBLE_GREEN, thickness / n)] * n, eta_above=eta, eta_below=eta)
        for n in (1, 2)
    )
    found = halves.total_transmittance()[0] / whole.total_transmittance()[0] - 1
    assert abs(found - growth) < 5.1e-4
    if free_paths == 4:
        assert abs(halves.total_reflectance()[0] / whole.total_reflectance()[0] - 0.97) < 5e-3


def test_the_seam_without_absorption(float64):
    """Matched everywhere, `T = (l + z_b) / (d + 3 z_b - l)`."""
    d, length, boundary = 6.0, 0.5, 2 / 3 * 0.5
    found = LayeredMultipole([layer(0.0, 2.0, 1.0, d / 2)] * 2).total_transmittance()
    np.testing.assert_allclose(found, (length + boundary) / (d + 3 * boundary - length), rtol=1e-13)


def test_three_layers_of_skin(float64):
    """Donner and Jensen's skin with the thicknesses and the index that we chose; reference: the
    same sums in another program.
    """
    per_cm = (
        ((2.1, 2.1, 5.0), (48.0, 60.0, 65.0), 0.25),
        ((0.16, 0.19, 0.30), (32.0, 40.0, 46.0), 2.0),
        ((0.085, 1.0, 25.0), (4.5, 4.7, 4.8), INFINITE),
    )
    stack = [
        Layer(Medium(np.asarray(a) / 10, np.asarray(s) / 10, eta=1.4), d) for a, s, d in per_cm
    ]
    profile = LayeredMultipole(stack, fresnel=EganFresnel())
    np.testing.assert_allclose(profile.total_reflectance(), [0.5377, 0.5348, 0.4093], atol=6e-5)


@pytest.mark.once
def test_too_thin_is_refused(dtype):
    for stack in ([layer(*MARBLE_GREEN, 0.3)], [layer(*MARBLE_GREEN, d) for d in (0.3, INFINITE)]):
        with pytest.raises(ValueError, match=r"thickness \* sigma_t' of a Layer .* 0\.78"):
            LayeredMultipole(stack)

    traced = jax.jit(lambda d: Multipole(layer(*MARBLE_GREEN, d)).total_reflectance())
    assert np.isnan(traced(0.3)[0])
    assert np.isfinite(traced(0.5)[0])


@pytest.mark.shared
def test_slab_against_monte_carlo(float64, monte_carlo):
    data, slab = monte_carlo("slab_marbleG_d2.0"), Multipole(layer(*MARBLE_GREEN, 2.0))
    entering = 1 - data["Rsp"]
    np.testing.assert_allclose(slab.total_reflectance(), data["Rd"] / entering, rtol=2e-3)
    np.testing.assert_allclose(slab.total_transmittance(), data["Tt"] / entering, rtol=1.2e-2)
    # Beyond the spike of light that was not scattered, ring by ring.
    r, reference = (np.asarray(data[name])[3:40] for name in ("r_opt", "Tt_r"))
    off = slab.transmittance(jnp.asarray(r))[:, 0] * entering - reference
    assert np.sqrt(np.sum(r * off**2) / np.sum(r * reference**2)) < 0.06


ROUNDING = 1e-13  # of the value at the origin; 1e-15 is reached


def source(r, depth, sigma):
    """What `exp(-depth sqrt(k^2 + sigma^2))` transforms to: a point source seen from a plane
    (Sommerfeld).
    """
    d = np.hypot(r, depth)
    return depth * (1 + sigma * d) * np.exp(-sigma * d) / (2 * np.pi * d**3)


@pytest.mark.parametrize("sigma", [0.0, 1e-3, 0.1, 3.0])
def test_transform_of_a_point_source(float64, sigma):
    depth = np.array([0.2, 1.0])
    r = np.concatenate([[0.0], np.geomspace(1e-3, 300, 60)])

    def transform(k):
        return jnp.exp(-jnp.sqrt(k * k + sigma**2) * jnp.broadcast_to(jnp.asarray(depth), k.shape))

    found = np.asarray(inverse_hankel_transform(transform, jnp.asarray(r), jnp.asarray(depth)))
    expected = source(r[:, None], depth, sigma)
    # Near the axis to all digits; farther out what is left of them after r^-1.
    scale = source(0.0, depth, sigma) * depth / np.maximum(r[:, None], depth)
    assert np.max(np.abs(found - expected) / scale) < ROUNDING


def test_derivatives_of_transforms(float64):
    def value(r, sigma):
        return inverse_hankel_transform(
            lambda k: jnp.exp(-jnp.sqrt(k * k + sigma**2)), r, jnp.ones(1)
        )

    given = jnp.asarray([0.02, 0.3, 4.0]), jnp.asarray(0.4)
    check_grads(jax.jit(value), given, order=1, modes=["rev"], rtol=1e-6)
    # At the axis a round function is flat; beside it the series has the slope of the source.
    slope = jax.jacfwd(lambda r: value(r, 0.0))
    assert slope(jnp.asarray(0.0))[0] == 0
    near, exact = 0.01, -3 * 0.01 / (2 * np.pi * (1 + 1e-4) ** 2.5)
    np.testing.assert_allclose(slope(jnp.asarray(near))[0], exact, rtol=1e-10)


# Two accurate quadratures of one integral differ by rounding.
EXACT = 1e-12

# The published table has six digits.
PRINTED = 6e-7

# How far the published polynomials may be from the integrals they fit, between 1/1.5 and 1.5.
POLYNOMIAL = 6e-3


INDICES = (1 / 1.5, 1 / 1.3, 0.97, 1.05, 1.1, 1.3, 1.4, 1.5, 2.5)

# eta, exact 2 C1, Egan and Hilgeman's, exact 3 C2, d'Eon and Irving's
TABLE = (
    (1.1, 0.194345, 0.193424, 0.087920, 0.083291),
    (1.3, 0.444457, 0.444845, 0.300267, 0.297448),
    (1.4, 0.528985, 0.529569, 0.388783, 0.386347),
    (1.5, 0.596346, 0.596811, 0.464431, 0.462609),
    (1 / 1.3, 0.061132, 0.061788, 0.035350, 0.035378),
    (1 / 1.5, 0.091778, 0.092825, 0.063048, 0.063068),
)


def moments(model, eta: jax.Array) -> jax.Array:
    return jnp.stack([model.first_moment(eta), model.second_moment(eta), model.boundary(eta)])


@pytest.mark.parametrize("eta", INDICES)
def test_exact_moments_are_the_integrals(float64, eta):
    """(power + 1) times the integral of mu^power F(mu), split at the critical angle."""
    critical, found = np.sqrt(max(0.0, 1 - 1 / eta**2)), moments(ExactFresnel(), jnp.asarray([eta]))
    for power in (1, 2):
        rest, _ = quad(
            lambda mu, power=power: mu**power * reflectance(mu, eta),
            critical,
            1,
            epsabs=1e-13,
            epsrel=1e-12,
            limit=400,
        )
        expected = critical ** (power + 1) + (power + 1) * rest
        np.testing.assert_allclose(found[power - 1], expected, rtol=EXACT)


def test_moments_are_those_published(float64):
    index, *expected = np.transpose(TABLE)
    exact, egan = (
        moments(model, jnp.asarray(index))[:2] for model in (ExactFresnel(), EganFresnel())
    )
    np.testing.assert_allclose([exact[0], egan[0], exact[1], egan[1]], expected, atol=PRINTED)
    np.testing.assert_allclose(exact, egan, atol=POLYNOMIAL)


def test_reciprocity_ties_inside_to_outside(float64):
    """What passes outward per unit of diffuse radiance is 1 / eta^2 of what passes inward."""
    eta = jnp.asarray([1.1, 1.3, 1.5, 2.0])
    inward, outward = (1 - ExactFresnel().first_moment(index) for index in (1 / eta, eta))
    np.testing.assert_allclose(outward * eta * eta, inward, rtol=EXACT)


@pytest.mark.once
@pytest.mark.parametrize("model", [ExactFresnel(), EganFresnel()])
def test_equal_indices_reflect_nothing(dtype, model):
    one = jnp.ones(1, dtype)
    first, second, boundary = moments(model, one)
    np.testing.assert_array_equal([first, boundary], [[0], [1]])
    np.testing.assert_allclose(second, 0, atol=1e-12)
    assert np.all(np.isfinite(jax.jacobian(lambda eta: moments(model, eta))(one)))


@pytest.mark.parametrize("model", [ExactFresnel(), EganFresnel()])
def test_moments_have_their_derivatives(float64, model):
    given = (jnp.asarray([0.7, 1.05, 1.3, 1.5]),)
    function = jax.jit(lambda eta: moments(model, eta))
    check_grads(function, given, order=1, modes=["rev"], rtol=1e-6, eps=1e-5)
