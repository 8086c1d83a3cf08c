"""Least squares with a handful of unknowns, in plain array operations.

The fit solves thousands of tiny systems at once inside a loop. Batched LAPACK calls there were seen
to wait for each other for good on a machine of two cores; elimination in six columns needs none.
Columns are scaled to unit length, so that the normal equations are benign (their condition number
stays below 2000 for eight Gaussians), and one step of refinement makes up for having squared it.
"""

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float
from lineax.internal import (
    pack_structures,
    ravel_vector,
    transpose_packed_structures,
    unravel_solution,
)


@jax.custom_jvp
def invert(matrix: Float[Array, "columns columns"]) -> Float[Array, "columns columns"]:
    """Invert a positive definite matrix by Gauss and Jordan's elimination, without pivoting."""

    def eliminate(column, matrix):
        here = jnp.arange(matrix.shape[0]) == column
        # The unit vector takes the place of the column, and turns into that of the inverse.
        replaced = jnp.where(here[None], here[:, None].astype(matrix.dtype), matrix)
        row = replaced[column] / matrix[column, column]
        reduced = replaced - matrix[:, column][:, None] * row[None]
        return jnp.where(here[:, None], row[None], reduced)

    return jax.lax.fori_loop(0, matrix.shape[0], eliminate, matrix)


@invert.defjvp
def _invert_jvp(primals, tangents):
    inverse = invert(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


def invert_moving(
    hessian: Float[Array, "gaussians gaussians"],
) -> Float[Array, "gaussians gaussians"]:
    """Invert a Hessian; a Gaussian of weight zero in all channels stays where it
    is.
    """
    still = jnp.diagonal(hessian) == 0
    return invert(hessian + jnp.diag(still.astype(hessian.dtype)))


def least_squares(
    matrix: Float[Array, "rows columns"],
    right: Float[Array, " rows"],
    inverse: Float[Array, "columns columns"],
) -> Float[Array, " columns"]:
    """Find the `x` of the least `|matrix x - right|`; `inverse` is that of the normal equations."""
    solution = inverse @ (matrix.T @ right)
    return solution + inverse @ (matrix.T @ (right - matrix @ solution))


class NormalEquations(lx.AbstractLinearSolver):
    """A lineax solver for tall systems of full column rank, and for their transposes."""

    def init(self, operator, options):
        del options
        matrix = operator.as_matrix()
        return matrix, invert(matrix.T @ matrix), False, pack_structures(operator)

    def compute(self, state, vector, options):
        del options
        matrix, inverse, transposed, structures = state
        right = ravel_vector(vector, structures)
        # The transposed system is wide: its shortest solution.
        solution = (
            matrix @ (inverse @ right) if transposed else least_squares(matrix, right, inverse)
        )
        return unravel_solution(solution, structures), lx.RESULTS.successful, {}

    def transpose(self, state, options):
        matrix, inverse, transposed, structures = state
        return (matrix, inverse, not transposed, transpose_packed_structures(structures)), options

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True
