"""The dipole: energy, units, limits, published totals, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from splatjax.io import load_medium
from splatjax.scattering import (
    TOTAL_RULE,
    Dipole,
    EganFresnel,
    ExactFresnel,
    Medium,
    at_own_radii,
    integrated_reflectance,
)

CLOSED_FORM = 1e-9
"""The closed-form total against quadrature: what is asked; 1e-15 is reached."""

PRINTED = 0.012
"""Jensen's table prints two digits of coefficients and totals."""

UNITS = 1e-12
"""A change of unit is exact up to rounding."""

LIMIT = 1e-5
"""One-sided differences of second order with steps of 1e-4."""

PRINTED_TOTALS = {
    "apple": (0.85, 0.84, 0.53),
    "chicken1": (0.31, 0.15, 0.10),
    "chicken2": (0.32, 0.16, 0.10),
    "cream": (0.98, 0.90, 0.73),
    "ketchup": (0.16, 0.01, 0.00),
    "marble": (0.83, 0.79, 0.75),
    "potato": (0.77, 0.62, 0.21),
    "skimmilk": (0.81, 0.81, 0.69),
    "skin1": (0.44, 0.22, 0.13),
    "skin2": (0.63, 0.44, 0.34),
    "spectralon": (1.00, 1.00, 1.00),
    "wholemilk": (0.91, 0.88, 0.76),
}
"""Jensen et al. 2001, Table 1, diffuse reflectance."""

JENSEN = tuple(PRINTED_TOTALS)


def marble(dtype=None) -> Medium:
    coefficients = ([0.0021, 0.0041, 0.0071], [2.19, 2.62, 3.0], [1.5, 1.5, 1.5])
    return Medium(*(jnp.asarray(x, dtype or jnp.result_type(float)) for x in coefficients))


def scaled(medium: Medium, factor: float) -> Medium:
    return Medium(medium.sigma_a * factor, medium.sigma_s_prime * factor, medium.eta)


@pytest.mark.parametrize("fresnel", [ExactFresnel(), EganFresnel()])
@pytest.mark.parametrize("name", JENSEN)
def test_closed_form_total_is_the_integral(float64, name, fresnel):
    profile = Dipole(load_medium(name), fresnel)
    total = integrated_reflectance(profile)
    if name == "spectralon":
        # Without absorption R falls as r^-3 beyond the last node: the rest of the integral of 2 pi
        # r R is 2 pi r^2 R.
        end = TOTAL_RULE.largest * profile.length_scale()
        total = total + 2 * jnp.pi * end**2 * at_own_radii(profile, end[None])[0]
    np.testing.assert_allclose(total, profile.total_reflectance(), rtol=CLOSED_FORM)


@pytest.mark.parametrize("name", JENSEN)
def test_totals_are_those_printed(name):
    difference = np.asarray(Dipole(load_medium(name)).total_reflectance()) - np.asarray(
        PRINTED_TOTALS[name]
    )
    if name == "chicken1":
        difference = difference[:2]  # blue is printed as 0.10; its printed coefficients give 0.126
    assert np.max(np.abs(difference)) < PRINTED


def test_total_is_one_without_absorption_and_less_with_it(dtype):
    medium = Medium(
        jnp.asarray([0.0, 1e-3, 1.0], dtype), jnp.ones(3, dtype), jnp.full(3, 1.4, dtype)
    )
    totals = np.asarray(Dipole(medium).total_reflectance())
    assert totals[0] == 1
    assert np.all(np.diff(totals) < 0)
    assert np.all(totals > 0)


def test_profile_is_positive_and_falls(dtype):
    r = jnp.geomspace(1e-3, 50, 200, dtype=dtype)
    values = np.asarray(Dipole(marble(dtype))(r))
    assert values.shape == (200, 3)
    assert np.all(values > 0)
    assert np.all(np.diff(values, axis=0) < 0)


def test_nothing_depends_on_the_unit_of_length(float64):
    r = jnp.geomspace(1e-2, 50, 20)
    in_mm, in_cm = Dipole(marble()), Dipole(scaled(marble(), 10.0))
    np.testing.assert_allclose(in_cm(r / 10) / 100, in_mm(r), rtol=UNITS)
    np.testing.assert_allclose(in_cm.total_reflectance(), in_mm.total_reflectance(), rtol=UNITS)
    np.testing.assert_allclose(
        integrated_reflectance(in_cm), integrated_reflectance(in_mm), rtol=UNITS
    )


def test_profile_has_its_derivatives(float64):
    def values(sigma_a, sigma_s_prime, eta, r):
        return Dipole(Medium(sigma_a, sigma_s_prime, eta))(r)

    medium = marble()
    r = jnp.asarray([0.1, 1.0, 5.0])
    check_grads(
        jax.jit(values),
        (medium.sigma_a, medium.sigma_s_prime, medium.eta, r),
        order=1,
        rtol=1e-5,
        eps=1e-6,
    )


def test_derivative_without_absorption_is_the_one_sided_limit(float64):
    def value(sigma_a):
        medium = Medium(sigma_a[None], jnp.asarray([2.62]), jnp.asarray([1.5]))
        return Dipole(medium)(jnp.asarray(1.5))[0]

    zero, h = jnp.asarray(0.0), 1e-7
    # In sigma_a the profile goes as sigma_a and sigma_a^(3/2): two one-sided quotients,
    # extrapolated in the root of the step.
    quotients = [(value(jnp.asarray(step)) - value(zero)) / step for step in (h, 4 * h)]
    np.testing.assert_allclose(jax.grad(value)(zero), 2 * quotients[0] - quotients[1], rtol=LIMIT)
    assert jax.grad(value)(zero) != 0


def test_derivative_at_the_origin_is_zero_and_finite(dtype):
    slope = jax.jacfwd(Dipole(marble(dtype)))(jnp.asarray(0.0, dtype))
    np.testing.assert_array_equal(slope, 0)


def test_total_reflectance_refuses_a_derivative_without_absorption(dtype):
    """It diverges; a finite number would be wrong."""

    def total(sigma_a):
        return Dipole(
            Medium(sigma_a, jnp.ones(1, dtype), jnp.full(1, 1.3, dtype))
        ).total_reflectance()[0]

    assert not np.isfinite(jax.grad(total)(jnp.zeros(1, dtype))[0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sigma_a", -0.1),
        ("sigma_a", np.nan),
        ("sigma_s_prime", 0.0),
        ("sigma_s_prime", np.inf),
        ("eta", 0.0),
    ],
)
def test_a_medium_that_cannot_be_is_refused_by_name(dtype, name, value):
    good = {"sigma_a": 0.1, "sigma_s_prime": 1.0, "eta": 1.3}
    with pytest.raises(ValueError, match=rf"{name} must be finite and .*got \[{value}"):
        Medium(
            **{key: jnp.asarray([number], dtype) for key, number in (good | {name: value}).items()}
        )
