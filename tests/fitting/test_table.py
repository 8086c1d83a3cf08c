"""Tables of factors: exact at nodes, close between them, smooth, and of the right energy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bodies import assert_refused
from scipy.interpolate import CubicSpline

import splatjax as sj
from splatjax.fitting import weight_table

VARIANCES, WEIGHTS = [0.3, 2.0], [[0.4, 0.3], [0.5, 0.6]]
FALLS = np.asarray([[[2.0, 1.0], [3.0, 2.0]], [[0.5, 1.5], [1.0, 4.0]]])  # of each parameter
NODES = {"dye": np.geomspace(0.1, 1.0, 8), "dirt": np.linspace(0.0, 0.5, 5)}
BETWEEN = 2e-3  # relative: errors of splines over these nodes
ROUNDING = 1e-12


def dyed(dye, dirt) -> sj.SumOfGaussians:
    return sj.SumOfGaussians(VARIANCES, WEIGHTS * np.exp(-FALLS[0] * dye - FALLS[1] * dirt))


@pytest.mark.usefixtures("double")
@pytest.mark.once
class TestWeightTable:
    def table(self) -> sj.fitting.WeightTable:
        return weight_table(dyed, NODES, sj.SumOfGaussians(VARIANCES, WEIGHTS))

    def test_factors_are_those_of_the_material(self):
        table, rng = self.table(), np.random.default_rng(1)
        between = {"dye": rng.uniform(0.1, 1, 50), "dirt": rng.uniform(0, 0.5, 50)}
        at_nodes = dict(zip(NODES, map(np.ravel, np.meshgrid(*NODES.values())), strict=True))
        for values, tolerance in ((at_nodes, ROUNDING), (between, BETWEEN)):
            columns = (values[name][:, None, None] for name in NODES)
            expected = np.exp(-sum(falls * x for falls, x in zip(FALLS, columns, strict=True)))
            np.testing.assert_allclose(table.factors(values), expected, rtol=tolerance)

    def test_values_are_the_inverse_of_fractions(self):
        table = self.table()
        values = {"dye": np.asarray([0.1, 0.3, 1.0]), "dirt": np.asarray([0.5, 0.2, 0.0])}
        fractions = table.fractions(values)
        np.testing.assert_allclose(fractions[0], [0, 1], atol=ROUNDING)
        np.testing.assert_allclose(fractions[1, 0], np.log(3) / np.log(10))
        for name, found in table.values(fractions).items():
            np.testing.assert_allclose(found, values[name], atol=ROUNDING)

    def test_gradients_are_those_of_finite_differences(self):
        table, step = self.table(), 1e-6
        rng = np.random.default_rng(2)
        share = rng.normal(size=(6, 2, 2))
        at, way = jnp.asarray(rng.uniform(0.1, 0.9, (6, 2))), jnp.asarray(rng.normal(size=(6, 2)))

        @jax.jit
        def mean(by):
            return jnp.sum(table.interpolate(at + by * way) * share)

        expected = (mean(step) - mean(-step)) / (2 * step)
        np.testing.assert_allclose(jax.grad(mean)(0.0), expected, rtol=1e-8)

    def test_an_interpolation_that_meets_zero_keeps_the_total(self):
        """A spline through 1, 0, 0 would go below zero."""

        def fading(x):
            narrow = np.asarray([[max(0.5 - x, 0.0)], [1.0]])
            return sj.SumOfGaussians([0.3, 2.0], narrow)

        base = sj.SumOfGaussians([0.3, 2.0], [[1.0], [1.0]])
        table = weight_table(fading, {"x": [-0.5, 0.5, 1.5, 2.5]}, base)
        fractions = jnp.linspace(0, 1, 61)[:, None]
        assert float(jnp.min(table.interpolate(fractions))) == 0
        knots = np.linspace(0, 1, 4)
        spline = CubicSpline(knots, np.sqrt([2.0, 1.0, 1.0, 1.0]))
        np.testing.assert_allclose(table.reflectance(fractions), spline(fractions) ** 2, rtol=1e-10)


def test_a_gaussian_that_the_base_lacks_keeps_no_weight_and_the_total_is_right():
    base = sj.SumOfGaussians([0.3, 2.0], [[0.4, 0.3], [0.5, 0.0]])
    other = sj.SumOfGaussians([0.3, 2.0], [[0.2, 0.1], [0.1, 0.1]])
    weights = base.weights * sj.fitting.weight_factors(base, other)
    np.testing.assert_allclose(weights[:, 0], [0.2, 0.1], rtol=1e-4)
    np.testing.assert_allclose(weights[:, 1], [0.2, 0.0], rtol=1e-5)


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
    assert_refused(
        lambda: weight_table(dyed, nodes, sj.SumOfGaussians(VARIANCES, WEIGHTS)), message
    )


def test_values_outside_of_the_table_are_refused():
    base = sj.SumOfGaussians(VARIANCES, WEIGHTS)
    table = weight_table(lambda dye: dyed(dye, 0.0), {"dye": [0.1, 1.0]}, base)
    assert table.factors({"dye": 0.5}).shape == (1, 2, 2)
    assert_refused(lambda: table.factors({"dye": [0.5, 1.5]}), "dye must be between 0.1 and 1.*1.5")
    assert_refused(lambda: table.factors({"dirt": 0.5}), "given for dirt; give dye")
