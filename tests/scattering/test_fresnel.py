"""Fresnel moments: integrals by an independent rule, published fits, and the limits at equal
indices.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy.integrate import quad

from splatjax.scattering import EganFresnel, ExactFresnel

# Two accurate quadratures of one integral differ by rounding.
EXACT = 1e-12

# The published table has six digits.
PRINTED = 6e-7

# How far the published polynomials may be from the integrals they fit, between 1/1.5 and 1.5.
POLYNOMIAL = 6e-3

# Extrapolated from 1e-5 and 2e-5 away, where the slopes differ from the limit by e log e.
ONE_SIDED = 1e-3

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


def reflectance(mu: float, eta: float) -> float:
    """Fresnel's equations for unpolarized light from inside, with total internal reflection."""
    squared_sine = eta * eta * (1 - mu * mu)
    if squared_sine >= 1:
        return 1.0
    outside = np.sqrt(1 - squared_sine)
    across = (eta * mu - outside) / (eta * mu + outside)
    along = (mu - eta * outside) / (mu + eta * outside)
    return 0.5 * (across**2 + along**2)


def moment(eta: float, power: int) -> float:
    """(power + 1) times the integral of mu^power F(mu), split at the critical angle."""
    critical = np.sqrt(max(0.0, 1 - 1 / eta**2))
    rest, _ = quad(
        lambda mu: mu**power * reflectance(mu, eta),
        critical,
        1,
        epsabs=1e-13,
        epsrel=1e-12,
        limit=400,
    )
    return critical ** (power + 1) + (power + 1) * rest


@pytest.mark.parametrize("eta", INDICES)
def test_exact_moments_are_the_integrals(float64, eta):
    exact, index = ExactFresnel(), jnp.asarray([eta])
    np.testing.assert_allclose(exact.first_moment(index)[0], moment(eta, 1), rtol=EXACT)
    np.testing.assert_allclose(exact.second_moment(index)[0], moment(eta, 2), rtol=EXACT)


@pytest.mark.parametrize("row", TABLE)
def test_moments_are_those_published(float64, row):
    eta, *expected = row
    index = jnp.asarray([eta])
    found = [model.first_moment(index)[0] for model in (ExactFresnel(), EganFresnel())]
    found += [model.second_moment(index)[0] for model in (ExactFresnel(), EganFresnel())]
    np.testing.assert_allclose(found, expected, atol=PRINTED)
    np.testing.assert_allclose(found[::2], found[1::2], atol=POLYNOMIAL)


def test_reciprocity_ties_inside_to_outside(float64):
    """What passes outward per unit of diffuse radiance is 1 / eta^2 of what passes inward."""
    eta = jnp.asarray([1.1, 1.3, 1.5, 2.0])
    inward, outward = (1 - ExactFresnel().first_moment(index) for index in (1 / eta, eta))
    np.testing.assert_allclose(outward * eta * eta, inward, rtol=EXACT)


@pytest.mark.parametrize("model", [ExactFresnel(), EganFresnel()])
def test_equal_indices_reflect_nothing(dtype, model):
    one = jnp.ones(1, dtype)
    assert model.first_moment(one)[0] == 0
    assert model.boundary(one)[0] == 1
    assert abs(float(model.second_moment(one)[0])) < 1e-12
    for moment_of in (model.first_moment, model.second_moment):
        assert np.isfinite(jax.grad(lambda eta, f=moment_of: f(eta)[0])(one)[0])


@pytest.mark.parametrize("name", ["first_moment", "second_moment", "boundary"])
def test_derivative_at_equal_indices_is_the_limit_from_above(float64, name):
    slope = jax.grad(lambda eta: getattr(ExactFresnel(), name)(eta[None])[0])
    steps = np.asarray([1e-5, 2e-5])
    near = [float(slope(jnp.asarray(1 + step))) for step in steps]
    # The second moment leaves 1 as the power 3/2: extrapolate in the root of the step.
    roots = np.sqrt(steps) if name == "second_moment" else steps
    limit = near[0] - (near[1] - near[0]) * roots[0] / (roots[1] - roots[0])
    np.testing.assert_allclose(slope(jnp.asarray(1.0)), limit, atol=ONE_SIDED)


@pytest.mark.parametrize("model", [ExactFresnel(), EganFresnel()])
def test_moments_have_their_derivatives(float64, model):
    eta = jnp.asarray([0.7, 1.05, 1.3, 1.5])
    for moment_of in (model.first_moment, model.second_moment, model.boundary):
        check_grads(jax.jit(moment_of), (eta,), order=1, rtol=1e-6, eps=1e-5)
