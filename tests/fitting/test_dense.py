"""The solver of the normal equations, against NumPy's least squares."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np

from splatjax.fitting._dense import NormalEquations


def test_tall_systems_and_their_transposes_are_solved(float64):
    rng = np.random.default_rng(0)
    matrix, right = rng.normal(size=(9, 4)), rng.normal(size=9)
    operator, solver = lx.MatrixLinearOperator(jnp.asarray(matrix)), NormalEquations()
    found = lx.linear_solve(operator, jnp.asarray(right), solver).value
    np.testing.assert_allclose(np.asarray(found), np.linalg.lstsq(matrix, right)[0], rtol=1e-12)
    state, options = solver.transpose(solver.init(operator, {}), {})
    found, _, _ = solver.compute(state, jnp.asarray(right[:4]), options)
    np.testing.assert_allclose(np.asarray(found), np.linalg.lstsq(matrix.T, right[:4])[0], rtol=1e-12)


def test_solutions_have_derivatives(float64):
    rng = np.random.default_rng(1)
    operator, along = lx.MatrixLinearOperator(jnp.asarray(rng.normal(size=(9, 4)))), rng.normal(size=9)
    inverse = np.linalg.pinv(np.asarray(operator.as_matrix()))
    jacobian = jax.jacrev(lambda b: lx.linear_solve(operator, b, NormalEquations()).value)(jnp.asarray(along))
    np.testing.assert_allclose(np.asarray(jacobian), inverse, rtol=1e-10, atol=1e-12)
