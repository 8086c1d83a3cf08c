"""The weights of a fit for given variances: linear least squares with few unknowns, in plain array
operations.

The fit solves thousands of tiny systems at once inside a loop, where batched LAPACK calls can
deadlock on two cores; elimination of a few columns avoids them. Columns have unit length, so the
condition number of the normal equations stays below 2000 for eight Gaussians, and one step of
refinement restores the precision.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Bool, Float
from lineax.internal import (
    pack_structures,
    ravel_vector,
    transpose_packed_structures,
    unravel_solution,
)

_UNSEEN = 1e-12  # ridge for Gaussians that vanish at the nodes; all others have norm 1
_ROUNDING = 100.0
_EXCHANGES = 64


@jax.custom_jvp
def invert(matrix: Float[Array, "columns columns"]) -> Float[Array, "columns columns"]:
    """Invert a positive definite matrix by Gauss-Jordan elimination without pivoting."""

    def eliminate(column, matrix):
        is_column = jnp.arange(matrix.shape[0]) == column
        # The unit vector replaces the column and becomes the column of the inverse.
        replaced = jnp.where(is_column[None], is_column[:, None].astype(matrix.dtype), matrix)
        row = replaced[column] / matrix[column, column]
        reduced = replaced - matrix[:, column][:, None] * row[None]
        return jnp.where(is_column[:, None], row[None], reduced)

    return jax.lax.fori_loop(0, matrix.shape[0], eliminate, matrix)


@invert.defjvp
def _invert_jvp(primals, tangents):
    inverse = invert(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


def invert_moving(
    hessian: Float[Array, "gaussians gaussians"],
) -> Float[Array, "gaussians gaussians"]:
    """Invert a Hessian so that a Gaussian with weight 0 in all channels does not move."""
    is_fixed = jnp.diagonal(hessian) == 0
    return invert(hessian + jnp.diag(is_fixed.astype(hessian.dtype)))


def least_squares(
    matrix: Float[Array, "rows columns"],
    right: Float[Array, " rows"],
    inverse: Float[Array, "columns columns"],
) -> Float[Array, " columns"]:
    """Find the `x` that minimizes `|matrix x - right|`, given the `inverse` of the normal
    equations.
    """
    solution = inverse @ (matrix.T @ right)
    return solution + inverse @ (matrix.T @ (right - matrix @ solution))


class NormalEquations(lx.AbstractLinearSolver):
    """A lineax solver for tall systems of full column rank, and for their transposes."""

    def init(self, operator, options):
        matrix = operator.as_matrix()
        return matrix, invert(matrix.T @ matrix), False, pack_structures(operator)

    def compute(self, state, vector, options):
        matrix, inverse, transposed, structures = state
        right = ravel_vector(vector, structures)
        # The transposed system is wide: compute its shortest solution.
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


class AbstractWeights(eqx.Module):
    """The set of weights that a fit allows. It does not depend on the variances."""

    @abc.abstractmethod
    def solve(
        self,
        basis: Float[Array, "rows gaussians"],
        target: Float[Array, " rows"],
        energies: Float[Array, " gaussians"],
        total: Float[Array, ""],
    ) -> tuple[Float[Array, " gaussians"], Float[Array, "gaussians gaussians"]]:
        """Find the allowed coefficients that minimize `|target - basis @ coefficients|`, and their
        response.

        **Arguments:** (all differentiable)

        - `basis`: scaled Gaussians at the nodes, times the square roots of the quadrature weights;
          of full column rank.
        - `target`: the profile at the nodes, times the same roots.
        - `energies`: weight per unit coefficient; `energies @ coefficients` is the energy of the
          sum.
        - `total`: the energy of the profile.

        **Returns:** the coefficients, and their response: the derivative with respect to
        `basis^T target`, which is symmetric.
        """

    def solve_active(
        self,
        basis: Float[Array, "rows gaussians"],
        target: Float[Array, " rows"],
        energies: Float[Array, " gaussians"],
        total: Float[Array, ""],
        active: Bool[Array, " gaussians"],
    ) -> tuple[Float[Array, " gaussians"], Float[Array, "gaussians gaussians"]]:
        """Solve with the coefficients of idle Gaussians fixed at 0. One extra row for each idle
        column keeps the rank full.
        """
        idle = jnp.diag((~active).astype(energies.dtype))
        columns = jnp.where(jnp.broadcast_to(active, basis.shape), basis, 0.0)
        coefficients, response = self.solve(
            jnp.concatenate([columns, idle]),
            jnp.concatenate([target, jnp.zeros_like(energies)]),
            jnp.where(active, energies, 0.0),
            total,
        )
        return coefficients, jnp.where(active[:, None] & active[None], response, 0.0)


class FreeWeights(AbstractWeights):
    """Unconstrained weights, which minimize the error (Eq. 3). Their sum may differ from the
    profile's total reflectance by a few percent.
    """

    def solve(self, basis, target, energies, total):
        # Gaussians narrower than the first radius vanish at the nodes: take the shortest solution.
        ridge = _UNSEEN * jnp.eye(basis.shape[1], dtype=basis.dtype)
        inverse = invert(basis.T @ basis + ridge)
        return least_squares(basis, target, inverse), inverse


class FixedTotalReflectance(AbstractWeights):
    """Weights whose sum is the total reflectance of the profile. The picture keeps its energy, and
    the error is slightly larger.
    """

    def solve(self, basis, target, energies, total):
        free, inverse = FreeWeights().solve(basis, target, energies, total)
        # The direction from the free optimum to the constraint that increases the error least.
        direction = inverse @ energies
        length = energies @ direction
        held = free + direction * ((total - energies @ free) / length)
        return held, inverse - direction[:, None] * direction[None, :] / length


class NonNegativeWeights(AbstractWeights):
    """Non-negative weights that also satisfy the constraint of `among`.

    Fits to single channels of a dipole have no negative weights anyway. With shared variances, some
    weights may become 0.

    **Attributes:**

    - `among`: `FreeWeights()` (default) or `FixedTotalReflectance()`.

    **Source:** the Kuhn-Tucker conditions, solved by exchanging one index at a time, the last first
    (Murty 1974), which terminates for every positive definite problem.
    """

    among: AbstractWeights = FreeWeights()

    def solve(self, basis, target, energies, total):
        count = basis.shape[1]
        tolerance = _ROUNDING * float(jnp.finfo(basis.dtype).eps)

        def wrong(positive):
            coefficients, _ = self.among.solve_active(basis, target, energies, total, positive)
            slope = basis.T @ (basis @ coefficients - target)
            # A fixed sum adds the same slope to all nonzero coefficients.
            share = jnp.where(positive, energies, 0.0)
            slope = slope - energies * (slope @ share) / jnp.maximum(share @ share, tolerance)
            return jnp.where(positive, coefficients < 0, slope < -tolerance)

        def exchange(state):
            positive, is_wrong, steps = state
            last = jnp.max(jnp.where(is_wrong, jnp.arange(count), -1))
            positive = positive ^ (jnp.arange(count) == last)
            return positive, wrong(positive), steps + 1

        start = jnp.ones(count, bool), wrong(jnp.ones(count, bool)), jnp.asarray(0)
        positive, *_ = jax.lax.while_loop(
            lambda state: jnp.any(state[1]) & (state[2] < _EXCHANGES), exchange, start
        )
        positive = jax.lax.stop_gradient(positive)
        return self.among.solve_active(basis, target, energies, total, positive)
