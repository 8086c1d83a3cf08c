"""A half space by adding and doubling, and the law of angles: published values, limits, Monte
Carlo, energy, reciprocity, derivatives, and what a picture makes of them. Skin from its pigments.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import PLAIN, assert_refused, sheet
from jax.test_util import check_grads

import splatjax as sj
from splatjax.scattering import (
    AngularLaw,
    HalfSpace,
    PhotonBeam,
    Projected,
    SingleScattering,
    Skin,
)

COSINES = HalfSpace.cosines()


def half_space(albedo, eta=1.0, g=0.0) -> HalfSpace:
    albedo = jnp.atleast_1d(jnp.asarray(albedo, float))
    return HalfSpace(sj.Medium(2 * (1 - albedo), 2 * albedo, eta), g)


@pytest.mark.once
def test_published_totals():
    """Indices matched: Chandrasekhar, 1 - H(1) sqrt(1 - albedo). Index 1.5: Giovanelli 1955, with
    what the surface itself reflects.
    """
    matched = half_space([0.2, 0.5, 0.9, 0.95]).total_reflectance()
    np.testing.assert_allclose(matched, [0.03523052, 0.11522588, 0.41494748, 0.53554099], atol=3e-5)
    glass = half_space(0.9, 1.5).total_reflectance()
    np.testing.assert_allclose(0.04 + 0.96 * glass, 0.2600, atol=2e-4)


def test_a_color_comes_back(dtype):
    color = np.tile([0.001, 0.05, 0.3, 0.8, 0.98, 1.0], 5)
    eta, g = np.repeat([[1.0, 1.0, 1.3, 1.6, 1.6], [-0.5, 0.9, 0.0, -0.5, 0.9]], 6, axis=1)
    found, white = (HalfSpace.of_color(each, 0.5, eta, g) for each in (color, 0 * color + 1))
    np.testing.assert_allclose(found.color() / white.color(), color, atol=1e-5)
    np.testing.assert_allclose(white.color(), 1, atol=3e-4)
    sigma_t = found.medium.sigma_a + found.medium.sigma_s_prime / (1 - g)
    np.testing.assert_allclose(sigma_t, 2.0, rtol=1e-9 if dtype == np.float64 else 1e-5)


@pytest.mark.once
def test_white_absorbs_nothing_in_single_precision():
    found = HalfSpace.of_color(np.ones(64), 1.0, np.linspace(1, 2, 64), np.linspace(-0.9, 0.9, 64))
    assert np.all(found.medium.sigma_a < 1e-4)


@pytest.mark.parametrize("g", [0.0, 0.5])
def test_colors_are_those_of_openpbr(float64, g):
    """Where indices match, up to the error of its formula (OpenPBR 1.1, "Subsurface")."""
    color = np.asarray([0.05, 0.2, 0.5, 0.8, 0.98])
    s = 4.09712 + 4.20863 * color - np.sqrt(9.59217 + 41.6808 * color + 17.7126 * color**2)
    albedo = (1 - s**2) / (1 - g * s**2)
    medium = sj.Medium(1 - albedo, (1 - g) * albedo, 1.0)
    np.testing.assert_allclose(HalfSpace(medium, g).color(), color, atol=6e-3)


def test_the_coefficients_of_a_color_have_its_derivative(float64):
    given = jnp.asarray([[0.3, 0.6, 0.98], [1.0, 2.0, 3.0], [1.2, 1.4, 1.6], [0.3, -0.5, 0.8]])
    coefficients = jax.jit(lambda given: HalfSpace.of_color(*given).medium)
    check_grads(coefficients, (given,), order=1, modes=["rev"], eps=1e-3, rtol=1e-2)


@pytest.mark.once
@pytest.mark.long
def test_monte_carlo_with_forward_scattering(float32):
    medium = sj.Medium([0.1, 0.02], [0.9, 0.98], 1.4)
    walk = sj.transport.monte_carlo(
        [sj.Layer(medium, jnp.inf)],
        200_000,
        jax.random.key(1),
        edges=jnp.asarray([0.0, 1.0]),
        g=0.8,
    )
    found, by_similarity = (HalfSpace(medium, g).total_reflectance() for g in (0.8, 0.0))
    off = np.asarray(found - walk.total_reflectance.value) / walk.total_reflectance.deviation
    assert np.all(np.abs(off) < 4), off
    assert np.all(np.asarray(by_similarity) > np.asarray(found) * [1.03, 1.005])


@pytest.mark.once
@pytest.mark.parametrize("g", [0.0, 0.8, 0.9])
@pytest.mark.parametrize("eta", [1.0, 1.6])
def test_white_sends_all_light_back(eta, g):
    fraction = HalfSpace(sj.Medium([0.0], [1.0], eta), g).directional_albedo()
    np.testing.assert_allclose(fraction, 1, atol=3e-4)


@pytest.mark.once
@pytest.mark.parametrize("eta", [1.0, 1.4])
def test_limits(eta):
    """The little that leaves of a dark medium has scattered once. Grazing light leaves most; where
    indices match, `1 - sqrt(1 - albedo)` of it (Chandrasekhar).
    """
    fraction = np.asarray(half_space([0.01, 0.9], eta, 0.0).directional_albedo())
    dark = SingleScattering(sj.Medium([0.99], [0.01], eta)).directional_albedo(jnp.asarray(COSINES))
    np.testing.assert_allclose(fraction[1:, 0], np.asarray(dark)[1:, 0], rtol=0.03)
    assert np.all(np.diff(fraction[:, 1]) < 1e-6)
    if eta == 1:
        np.testing.assert_allclose(fraction[0, 1], 1 - 0.1**0.5, atol=2e-4)


@pytest.mark.once
@pytest.mark.parametrize("eta", [1.0, 1.3])
def test_energy_of_a_material_under_every_angle(eta):
    """Gaussians by their law and single scattering by its own are together what leaves by
    transport, and never more than came.
    """
    space, mu = half_space([0.9, 0.99], eta), jnp.asarray(COSINES, float)
    single = SingleScattering(space.medium)
    separate = single.directional_albedo(mu)
    rest = (space.total_reflectance() - separate[-1])[None]
    given = {"single_scattering": single, "angles": space.angular_law(separate)}
    material = sj.Material(sj.SumOfGaussians([1.0], rest), **given)
    leaving = separate + rest * material.diffuse_fraction(mu)
    allowed = 2e-3 if eta > 1 else 0.02  # with matched indices no polynomial is right at grazing
    np.testing.assert_allclose(leaving[4:], space.directional_albedo()[4:], atol=allowed)
    assert np.all(np.asarray(leaving) <= 1)


def test_light_leaves_whole_and_reciprocally(dtype):
    x, weights = np.polynomial.legendre.leggauss(64)
    law = AngularLaw([[0.7, 1.3], [0.2, -0.4], [0.1, 0.1]])
    mu, *surface = (jnp.asarray(each, dtype) for each in ((1 + x) / 2, 0.028, [0.2] * 64))
    leaves = jax.jit(sj.shading.diffuse_transmission)(mu, *surface, law)
    np.testing.assert_allclose(leaves @ (weights * mu), 1, atol=1e-4)
    enters = law(mu).T * (1 - jax.jit(sj.shading.directional_albedo)(mu, *surface))[None]
    ratio = np.asarray(leaves / enters)
    np.testing.assert_allclose(ratio, np.repeat(ratio[:, :1], 64, axis=1), rtol=1e-5)


def test_a_color_that_almost_cancels_has_the_law_of_all_light():
    """As blue of dark skin in lamplight: its own law would reach hundreds, or be negative."""
    law, total = AngularLaw([[0.7, 1.3], [0.3, -0.3]]), jnp.asarray([0.2, 0.6])
    colors = law.projected(total, jnp.asarray([[1.0, 1.0, 1.0], [0.5, -0.3333, -0.34]]))
    shares = np.asarray([[0.2, 0.3], [0.2, 0.6], [0.2, 0.6]])
    expected = np.asarray(law.coefficients) @ (shares.T / shares.sum(axis=1))
    np.testing.assert_allclose(colors.coefficients, expected, rtol=1e-5)


@pytest.mark.once
def test_a_photon_beam_takes_the_total_of_transport():
    space, r = half_space([0.9, 0.99], 1.3), jnp.asarray([0.5, 2.0])
    beam, single, total = (
        PhotonBeam(space.medium),
        SingleScattering(space.medium)(r),
        space.total_reflectance(),
    )
    held = beam.with_total(total)
    np.testing.assert_allclose(held.total_reflectance(), total, rtol=1e-5)
    assert np.all(np.abs(beam.total_reflectance() / total - 1) > 0.01)
    ratio = (held(r) - single) / (beam(r) - single)
    np.testing.assert_allclose(ratio[0], ratio[1], rtol=1e-4)


@pytest.mark.parametrize("g", [-0.95, -0.5, 0.3, 0.8, 0.95])
def test_multiple_scattering_is_positive_whatever_the_phase_function(g):
    """In half spaces from almost black to white."""
    for eta in (1.0, 1.4, 2.5):
        space = half_space([1e-3, 0.03, 0.2, 0.5, 0.9, 1.0], eta, g)
        beam = sj.fitting.TransportModel(g).profile(space.medium)
        assert np.all(np.asarray(beam.strength) > 0.1)
        assert np.all(np.asarray(beam.single) > 0)
        np.testing.assert_allclose(beam.total_reflectance(), space.total_reflectance(), rtol=2e-5)


@pytest.mark.once
@pytest.mark.parametrize("g", [0.0, 0.8])
def test_single_scattering_can_be_separated_whatever_is_absorbed(g):
    """The medium of the second channel returns less than isotropic single scattering would."""
    medium = sj.Medium([0.1, 2.0], [1.0, 1.0], 1.4)
    beam = sj.fitting.TransportModel(g).profile(medium)
    single, rest = beam.single_scattered(), beam.multiply_scattered()
    np.testing.assert_allclose(single(0.7) + rest(0.7), beam(0.7), rtol=1e-6)
    parts = [part.total_reflectance() for part in (single, rest)]
    assert np.all(np.asarray(parts) > 0)
    np.testing.assert_allclose(sum(parts), HalfSpace(medium, g).total_reflectance(), rtol=2e-5)


def test_its_derivative_at_matched_indices_is_that_from_above(float64):
    space = jax.jit(lambda eta: half_space([0.5, 0.99], eta, 0.6))
    for fraction in (HalfSpace.total_reflectance, HalfSpace.color):
        found = jax.jacfwd(lambda eta, of=fraction: of(space(eta)))(1.0)
        expected = (fraction(space(1.001)) - fraction(space(1.0))) / 1e-3
        np.testing.assert_allclose(found, expected, rtol=0.15)


def test_an_infinite_cover_is_a_half_space(float64):
    black = half_space(1e-6, 1.0, 0.5).medium

    @jax.jit
    @jax.value_and_grad
    def total(sigma_a, thickness):
        cover = sj.Medium(sigma_a, 1.0, 1.0)
        space = HalfSpace(cover, 0.5)
        if thickness is not None:
            space = HalfSpace(black, 0.5, sj.Layer(cover, thickness))
        return space.total_reflectance()[0]

    for thickness in (jnp.inf, 1e6):
        np.testing.assert_allclose(total(0.1, thickness), total(0.1, None), rtol=1e-4)


def test_a_color_in_float32_is_found_in_double_precision_too(float64):
    space = HalfSpace.of_color(np.float32([0.5]), 1.0)
    white = HalfSpace(sj.Medium([0.0], [1.0], 1.4)).color()
    np.testing.assert_allclose(space.color(), 0.5 * white, rtol=1e-4)


@pytest.mark.long
@pytest.mark.once
def test_a_flat_piece_sends_back_what_the_law_says():
    """Under light and eye at an angle it is `e(mu_i) e(mu_o) / average` times as bright as a
    diffuser.
    """
    gaussians, law = sj.SumOfGaussians([1.0], [[0.6]]), AngularLaw([[1.4], [0.1], [-0.5]])
    light = sj.DirectionalLight((-1, 0, -0.75), [1.0])  # cosine 0.6
    camera = sj.Camera.look_at((0, 60, 80), (0, 0, 0), fov=2, width=8, height=8)  # cosine 0.8
    material = sj.Material(gaussians, eta=1.0, specular=0, angles=law)
    frame = sj.render(sj.Scene(sheet(20.0, 1.0), light, material), camera, PLAIN)
    e_i, e_o = (1.4 + 0.1 * mu - 0.5 * mu**2 for mu in (0.6, 0.8))
    average = 1.4 + 0.1 * 2 / 3 - 0.5 / 2
    plain = 0.6 * 0.6 / np.pi  # total reflectance, cosine
    np.testing.assert_allclose(frame.diffuse[4, 4, 0], plain * e_i * e_o / average, rtol=1e-3)


@pytest.mark.once
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: AngularLaw([[0.5], [0.4]]), "1: the factor of light along the normal"),
        (lambda: AngularLaw([[-0.5], [1.5]]), "positive"),
        (lambda: half_space(0.9, 0.8), "at least 1"),
        (lambda: half_space(0.9, 1.3, 0.99), "between -0.95 and 0.95"),
        (lambda: HalfSpace.of_color(1.2, 1.0), "color must be between"),
        (lambda: HalfSpace.of_color(0.5, 0.0), "mean_free_path"),
        (lambda: HalfSpace.of_color(0.5, 1.0, 0.9), r"eta must be at least 1; .* 0\.9"),
        (lambda: HalfSpace.of_color(0.5, 1.0, 1.3, 1.0), "g must be between -0.95 and 0.95"),
        (lambda: HalfSpace.of_color([0.5] * 3, [1.0, 2.0]), r"mean_free_path.* \[3, 2, 1, 1\]"),
        (lambda: Skin(melanin=1.2), "Skin.melanin must be between"),
        (lambda: Skin(oxygenation=-0.1), "Skin.oxygenation must be between"),
        (lambda: Skin(wavelengths=[350, 500]), "Skin.wavelengths must be between"),
        (lambda: Skin(wavelengths=[]), "Skin.wavelengths is empty"),
        (lambda: Skin(water=0.9, blood=0.5), r"water and blood .* 1; got 1\.4"),
        (lambda: Projected(PhotonBeam(half_space([0.5, 0.6]).medium), np.eye(3)), "3 rows.* 2 ch"),
        (
            lambda: sj.Material(sj.SumOfGaussians([1.0], [[0.5] * 3]), angles=AngularLaw([[1.0]])),
            "Material.angles has 1 channels",
        ),
    ],
)
def test_what_is_wrong_is_said(make, words):
    assert_refused(make, words)


# Percent reflected at 450, 500, 540, 580, 600, 650 and 700 nm, with the surface: 5th and 95th
# percentile of the International Skin Spectra Archive (Lu et al. 2025, Scientific Data,
# doi 10.1038/s41597-025-04857-5): foreheads of 353 Caucasians and 143 Africans.
MEASURED_AT = [450, 500, 540, 580, 600, 650, 700]
MEASURED = {
    "light": (
        [12.3, 17.0, 16.7, 18.4, 27.4, 35.7, 39.7],
        [27.2, 33.7, 33.2, 35.7, 47.5, 55.9, 57.9],
    ),
    "dark": ([4.8, 5.1, 5.5, 6.3, 7.1, 9.9, 14.2], [11.0, 15.1, 16.5, 19.5, 25.9, 33.3, 40.2]),
}
SKINS = {
    "light": {"melanin": 0.04, "blood": 0.015},
    "dark": {"melanin": 0.13, "blood": 0.01},
}
SURFACE = (0.5 / 2.5) ** 2  # what an index of 1.5 reflects along the normal


@pytest.mark.once
@pytest.mark.parametrize(
    ("name", "melanin"), [("light", 0.02), ("light", 0.03), ("dark", 0.1), ("dark", 0.22)]
)
def test_reflectance_lies_in_the_measured_range(name, melanin):
    """That of the skins of the library, and of the lightest on docs/howto/fit.md."""
    skin = Skin(melanin, wavelengths=MEASURED_AT)
    reflected = SURFACE + (1 - SURFACE) * skin.half_space().total_reflectance()
    low, high = MEASURED[name]
    np.testing.assert_array_less(low, 100 * reflected)
    np.testing.assert_array_less(100 * reflected, high)


@pytest.mark.once
def test_hemoglobin_has_two_bands_with_oxygen_and_one_without():
    skins = (Skin(0.02, 0.02, each, wavelengths=[530, 545, 560, 575, 590]) for each in (1.0, 0.0))
    full, empty = (skin.half_space().total_reflectance() for skin in skins)
    np.testing.assert_array_equal(np.sign(np.diff(full)), [-1, 1, -1, 1])
    assert np.argmin(empty) in (1, 2)


@pytest.mark.once
@pytest.mark.parametrize("name", ["light", pytest.param("dark", marks=pytest.mark.long)])
def test_reflectance_and_profile_are_those_of_monte_carlo(name):
    """With an epidermis thinner than a mean free path."""
    skin = Skin(**SKINS[name], g=0.0, wavelengths=[450, 620])
    edges = np.asarray([0.0, 0.2, 0.5, 1.0, 2.0])
    walk = sj.transport.monte_carlo(skin.layers(), 20_000, jax.random.key(3), edges=edges)
    total = skin.half_space().total_reflectance()
    noise = 4 * walk.total_reflectance.deviation
    np.testing.assert_array_less(abs(total - walk.total_reflectance.value), 1e-3 + noise)
    radii = np.linspace(0, 2, 401)
    middle = jnp.asarray(0.5 * (radii[1:] + radii[:-1]), total.dtype)
    light = skin.profile()(middle) * (2 * np.pi * 0.005 * middle[:, None])
    rings = jnp.stack([jnp.sum(part, axis=0) for part in jnp.split(light, [40, 100, 200])])
    areas = np.pi * np.diff(edges**2)[:, None]
    counted, error = (areas * each for each in (walk.reflected.value, walk.reflected.deviation))
    allowed = 0.05 if name == "light" else 0.2
    np.testing.assert_array_less(
        abs(rings - counted), allowed * counted + 4 * error + 0.02 * total[None]
    )


def test_derivatives_are_differences(float64):
    skin = {
        "melanin": 0.05,
        "blood": 0.03,
        "oxygenation": 0.7,
        "eumelanin": 0.6,
        "bilirubin": 0.1,
        "thickness": 0.07,
        "scattering": 4.0,
        "carotene": 1e-3,
        "water": 0.6,
        "g": 0.7,
        "vessel_radius": 0.015,
        "scattering_power": 1.3,
        "eta": 1.4,
    }

    def reflectance(values):
        fields = dict(zip(skin, values, strict=True))
        profile = Skin(**fields, wavelengths=[450, 575]).profile()
        return jnp.sum(profile.total_reflectance() + profile(jnp.asarray([0.4]))[0])

    value_and_slope = jax.jit(lambda at, way: jax.jvp(reflectance, (at,), (way,)))
    at = np.asarray(list(skin.values()))
    for name, way in zip(skin, np.diag(at), strict=True):
        (there, _), (_, slope), (back, _) = (
            value_and_slope(at + step * way, way) for step in (1e-4, 0.0, -1e-4)
        )
        np.testing.assert_allclose(slope, (there - back) / 2e-4, rtol=1e-4, err_msg=name)
