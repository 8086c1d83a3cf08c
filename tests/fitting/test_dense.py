"""The solver of the normal equations, against NumPy's least squares."""

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np

from splatjax.fitting._dense import NormalEquations, invert


def test_tall_systems_and_their_transposes_are_solved(float64):
    rng = np.random.default_rng(0)
    matrix, right = rng.normal(size=(9, 4)), rng.normal(size=9)
    operator, solver = lx.MatrixLinearOperator(jnp.asarray(matrix)), NormalEquations()
    found = lx.linear_solve(operator, jnp.asarray(right), solver).value
    np.testing.assert_allclose(np.asarray(found), np.linalg.lstsq(matrix, right)[0], rtol=1e-12)
    state, options = solver.transpose(solver.init(operator, {}), {})
    found, _, _ = solver.compute(state, jnp.asarray(right[:4]), options)
    np.testing.assert_allclose(
        np.asarray(found), np.linalg.lstsq(matrix.T, right[:4])[0], rtol=1e-12
    )


def test_solutions_have_derivatives(float64):
    rng = np.random.default_rng(1)
    operator, along = (
        lx.MatrixLinearOperator(jnp.asarray(rng.normal(size=(9, 4)))),
        rng.normal(size=9),
    )
    inverse = np.linalg.pinv(np.asarray(operator.as_matrix()))
    jacobian = jax.jacrev(lambda b: lx.linear_solve(operator, b, NormalEquations()).value)(
        jnp.asarray(along)
    )
    np.testing.assert_allclose(np.asarray(jacobian), inverse, rtol=1e-10, atol=1e-12)


def test_the_inverse_has_the_derivative_of_its_definition(float64):
    """`d(A^-1) = -A^-1 dA A^-1`, of a matrix that is not symmetric, and the second derivative along
    a line.
    """
    rng = np.random.default_rng(2)
    matrix, way = (jnp.asarray(each) for each in rng.normal(size=(2, 4, 4)))

    @jax.jit
    def moved(step):
        return invert(matrix + step * way)

    once = jax.jacfwd(moved)
    inverse = np.linalg.inv(np.asarray(matrix))
    np.testing.assert_allclose(moved(0.0), inverse, rtol=1e-9)
    turn = inverse @ np.asarray(way)
    np.testing.assert_allclose(once(0.0), -turn @ inverse, rtol=1e-9)
    np.testing.assert_allclose(jax.jacfwd(once)(0.0), 2 * turn @ turn @ inverse, rtol=1e-9)
