"""Tables of factors: exact at nodes, close between them, smooth, and of the right energy."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import assert_gradient, assert_refused
from scipy.interpolate import CubicSpline

import splatjax as sj
from splatjax.fitting import weight_table

pytestmark = pytest.mark.once

VARIANCES, WEIGHTS = [0.3, 2.0], [[0.4, 0.3], [0.5, 0.6]]
FALLS = np.asarray([[[2.0, 1.0], [3.0, 2.0]], [[0.5, 1.5], [1.0, 4.0]]])  # of each parameter
NODES = {"dye": np.geomspace(0.1, 1.0, 8), "dirt": np.linspace(0.0, 0.5, 5)}
BETWEEN = 2e-3  # relative: errors of splines over these nodes
ROUNDING = 1e-12
BASE = VARIANCES, WEIGHTS


def dyed(dye, dirt) -> sj.SumOfGaussians:
    return sj.SumOfGaussians(VARIANCES, WEIGHTS * np.exp(-FALLS[0] * dye - FALLS[1] * dirt))


def test_a_table_is_that_of_the_material_and_has_its_derivatives(double):
    """At nodes and between; values and fractions are inverse."""
    table, rng = weight_table(dyed, NODES, sj.SumOfGaussians(*BASE)), np.random.default_rng(1)
    at_nodes = dict(zip(NODES, map(np.ravel, np.meshgrid(*NODES.values())), strict=True))
    between = {"dye": rng.uniform(0.1, 1, 40), "dirt": rng.uniform(0, 0.5, 40)}
    interpolate = eqx.filter_jit(table.interpolate)
    for values, tolerance in ((at_nodes, ROUNDING), (between, BETWEEN)):
        columns = (values[name][:, None, None] for name in NODES)
        expected = np.exp(-sum(falls * x for falls, x in zip(FALLS, columns, strict=True)))
        fractions = table.fractions(values)
        np.testing.assert_allclose(interpolate(fractions), expected, rtol=tolerance)
        for name, found in table.values(fractions).items():
            np.testing.assert_allclose(found, values[name], atol=ROUNDING)
    ends = table.fractions({"dye": [0.1, 0.3, 1.0], "dirt": [0.5, 0.2, 0.0]})
    expected = [[0, 1], [np.log(3) / np.log(10), 0.4], [1, 0]]
    np.testing.assert_allclose(ends, expected, atol=ROUNDING)
    share, at = rng.normal(size=(40, 2, 2)), jnp.asarray(rng.uniform(0.1, 0.9, (40, 2)))
    assert_gradient(lambda at: jnp.vdot(share, table.interpolate(at)), (at,), 1e-6, rtol=1e-8)


def test_an_interpolation_that_meets_zero_keeps_the_total(double):
    """A spline through 1, 0, 0 would go below zero."""

    def fading(x):
        return sj.SumOfGaussians([0.3, 2.0], [[max(0.5 - x, 0.0)] * 2, [1.0] * 2])

    base = sj.SumOfGaussians([0.3, 2.0], np.ones((2, 2)))
    table = weight_table(fading, {"x": [-0.5, 0.5, 1.5, 2.5]}, base)
    fractions = jnp.linspace(0, 1, 61)[:, None]
    total = eqx.filter_jit(table.reflectance)(fractions)
    assert float(jnp.min(eqx.filter_jit(table.interpolate)(fractions))) == 0
    spline = CubicSpline(np.linspace(0, 1, 4), np.sqrt([2.0, 1.0, 1.0, 1.0]))
    expected = np.repeat(spline(fractions) ** 2, 2, axis=1)
    np.testing.assert_allclose(total, expected, rtol=1e-10)


def test_a_gaussian_that_the_base_lacks_keeps_no_weight_and_the_total_is_right(double):
    base = sj.SumOfGaussians([0.3, 2.0], [[0.4, 0.3], [0.5, 0.0]])
    other = sj.SumOfGaussians([0.3, 2.0], [[0.2, 0.1], [0.1, 0.1]])
    weights = base.weights * sj.fitting.weight_factors(base, other)
    np.testing.assert_allclose(weights[:, 0], [0.2, 0.1], rtol=1e-4)
    np.testing.assert_allclose(weights[:, 1], [0.2, 0.0], rtol=1e-5)


def test_a_black_channel_keeps_the_factor_1():
    base = sj.SumOfGaussians([0.3, 2.0], [[0.4, 0.0], [0.5, 0.0]])
    factors = sj.fitting.weight_factors(base, sj.SumOfGaussians(*BASE))
    np.testing.assert_allclose(factors[:, 1], 1)


@pytest.mark.parametrize(
    ("weights", "message"),
    [([0.4, -0.1], "gaussians.weights must be .* -0.1"), ([0.4], "other has 2 channels, .* 1")],
)
def test_gaussians_that_take_no_factors_are_refused(weights, message):
    base = sj.SumOfGaussians([0.3], [weights])
    assert_refused(lambda: sj.fitting.weight_factors(base, sj.SumOfGaussians(*BASE)), message)


def test_the_ends_of_a_table_are_inside_of_it_in_float32(float32):
    nodes = {"dye": np.geomspace(0.002, 0.1, 3), "dirt": np.linspace(-0.3, 0.7, 2)}
    table = weight_table(dyed, nodes, sj.SumOfGaussians(*BASE))
    ends = jnp.asarray([[0.0, 0.0], [1.0, 1.0]])
    np.testing.assert_allclose(table.fractions(table.values(ends)), ends, atol=1e-6)


@pytest.mark.parametrize(
    ("nodes", "message"),
    [
        ({}, "nodes has 0 parameters"),
        ({name: [0, 1] for name in "abcd"}, "nodes has 4 parameters"),
        ({"dye": [0.1]}, r"nodes\['dye'\].*two or more.*0\.1"),
        ({"dye": [0.1, 0.3, 0.2]}, r"nodes\['dye'\].*ascending"),
    ],
)
def test_nodes_that_make_no_table_are_refused(nodes, message):
    assert_refused(lambda: weight_table(dyed, nodes, sj.SumOfGaussians(*BASE)), message)


def test_values_outside_of_the_table_are_refused():
    base = sj.SumOfGaussians(*BASE)
    table = weight_table(lambda dye: dyed(dye, 0.0), {"dye": [0.1, 1.0]}, base)
    assert table.factors({"dye": 0.5}).shape == (1, 2, 2)
    assert_refused(lambda: table.factors({"dye": [0.5, 1.5]}), "dye must be between 0.1 and 1.*1.5")
    assert_refused(lambda: table.factors({"dirt": 0.5}), "given for dirt; give dye")
