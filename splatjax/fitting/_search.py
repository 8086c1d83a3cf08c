"""The search for the best variances: starts, descent, the last steps by Newton's method, and the
derivative of the optimum.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Bool, Float, Int

from splatjax._records import check_values, numbers, record, require
from splatjax.scattering import Medium

from ._problem import Expansion, FitProblem, nonzero
from ._weights import NormalEquations, invert_moving

# Range of log variances (in squared length scales) from which a single Gaussian starts.
_FIRST = (-3.0, 4.0)

# Distance in log variance at which a Gaussian starts beyond the others; neighbors are 1.4 to 2.2
# apart.
_OUTWARD = 1.5

_TOLERANCE = 1e-3
# Accurate enough to compare starts, and for Newton's method to converge from the best end.
_STEPS = 64

# A fit has converged if a Gauss-Newton step would lower the sum of squares by less than this
# fraction of it,
_GAIN = 1e-6

# or by less than the square of this many rounding units of the profile's norm, the limit of the
# precision.
_FLOOR = 100.0

_NEWTON_STEPS = 32
# A step in log variance below this many rounding units counts as zero.
_STEP = 10.0


@record
class GivenVariances(eqx.Module):
    r"""The start of a search: the variances of a fit to a similar profile.

    The search is one descent, to the nearest optimum.

    **Attributes:**

    - `variances`: mm^2, positive, one per Gaussian; with `VariancesPerChannel`, one row per
      channel.
    """

    variances: Float[Array, "*channels gaussians"] = eqx.field(converter=numbers)

    def search(self, problem: FitProblem, count: int) -> Float[Array, " gaussians"]:
        """Find nearly optimal log variances, ascending. The problem is in JAX's default
        precision.
        """
        require(
            self.variances.shape == (count,),
            f"GivenVariances.variances must have {count} entries, one for each Gaussian; "
            f"got shape {list(self.variances.shape)}",
        )
        return jnp.sort(_descend(problem, problem.log_variances(self.variances), None)[0])


class DipoleStarts(eqx.Module):
    r"""A table of the variances of the best fits to single channels of dipoles, by reduced albedo
    and index of refraction.

    In units of squared mean free paths the variances depend only on these two quantities. They are
    smooth functions of `sqrt(1 - alpha')`, so they are tabulated at equal steps of it, and their
    logarithms are interpolated linearly. Outside the table the nearest entry is used.

    **Attributes:**

    - `roots`: values of `sqrt(1 - alpha')`, equally spaced.
    - `etas`: indices of refraction, equally spaced.
    - `log_variances`: one array per number of Gaussians, starting from 1.
    """

    roots: Float[Array, " roots"]
    etas: Float[Array, " etas"]
    log_variances: tuple[Float[Array, "roots etas _"], ...]

    def __call__(self, medium: Medium, count: int) -> GivenVariances:
        r"""Compute the start of a fit of `count` Gaussians to `Dipole(medium)` with
        `VariancesPerChannel()`.

        **Raises:** `ValueError` for more Gaussians than the table has.
        """
        check_values(
            "count",
            count,
            f"from 1 to {len(self.log_variances)}, the numbers of Gaussians in the table",
            lambda x: (x >= 1) & (x <= len(self.log_variances)),
        )
        root = jnp.sqrt(medium.sigma_a / medium.sigma_t_prime)
        table, roots, etas = (
            values.astype(medium.eta.dtype)
            for values in (self.log_variances[count - 1], self.roots, self.etas)
        )
        place = [
            (values - nodes[0]) / (nodes[1] - nodes[0])
            for nodes, values in ((roots, root), (etas, medium.eta))
        ]
        columns = [
            map_coordinates(table[..., i], place, order=1, mode="nearest") for i in range(count)
        ]
        length = 1 / medium.sigma_t_prime
        return GivenVariances(jnp.exp(jnp.stack(columns, axis=-1)) * (length * length)[:, None])


def constant(problem: FitProblem) -> FitProblem:
    """Make a problem constant for derivatives, and convert it to JAX's default precision, in which
    optimistix computes the damping.
    """
    return jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf).astype(jnp.result_type(float)), problem
    )


def greedy_path(problem: FitProblem, max_count: int) -> Float[Array, "counts gaussians"]:
    """Find nearly optimal log variances of 1, 2, ... Gaussians, each ascending and padded with
    zeros. Each search adds a Gaussian to the previous best result, in every gap and at both ends,
    and keeps the best result.
    """

    def step(best, active_count):
        active = jnp.arange(max_count) < active_count
        starts = jax.vmap(lambda place: _insert(best, active_count, place))(jnp.arange(max_count))
        points, costs = jax.vmap(lambda start: _descend(problem, start, active))(starts)
        ordered = jnp.sort(jnp.where(active, points[jnp.argmin(costs)], jnp.inf))
        best = jnp.where(active, ordered, 0.0)
        return best, best

    start = jnp.zeros(max_count, problem.target.dtype)
    return jax.lax.scan(step, start, jnp.arange(1, max_count + 1))[1]


def _insert(
    best: Float[Array, " gaussians"], active_count: Int[Array, ""], place: Int[Array, ""]
) -> Float[Array, " gaussians"]:
    """Append a log variance that lies between two of the first `active_count - 1` ascending ones,
    or beyond either end.
    """
    last = active_count - 1
    half = (_FIRST[1] - _FIRST[0]) / (2 * best.shape[0])
    alone = jnp.linspace(_FIRST[0] + half, _FIRST[1] - half, best.shape[0], dtype=best.dtype)[place]
    place = jnp.minimum(place, last)
    below = jnp.where(place > 0, best[place - 1], best[0] - 2 * _OUTWARD)
    above = jnp.where(place < last, best[place], best[last - 1] + 2 * _OUTWARD)
    return best.at[last].set(jnp.where(last == 0, alone, 0.5 * (below + above)))


def _descend(
    problem: FitProblem, start: Float[Array, " gaussians"], active: Bool[Array, " gaussians"] | None
) -> tuple[Float[Array, " gaussians"], Float[Array, ""]]:
    """Descend from a start, and return the end and its sum of squares."""
    # Divide by the norm of the first residuals, so that damping and tolerances have the same effect
    # for good and poor fits.
    unit = jnp.sqrt(nonzero(_cost(problem.residuals(start, active))))

    def residuals(point, _):
        return _projected(problem, active, point) / unit

    solver = optx.LevenbergMarquardt(
        rtol=_TOLERANCE, atol=_TOLERANCE, linear_solver=NormalEquations()
    )
    end = optx.least_squares(residuals, solver, start, max_steps=_STEPS, throw=False).value
    return end, _cost(problem.residuals(end, active))


@jax.custom_jvp
def _projected(
    problem: FitProblem, active: Bool[Array, " gaussians"] | None, point: Float[Array, " gaussians"]
) -> Float[Array, "channels nodes"]:
    return problem.residuals(point, active)


@_projected.defjvp
def _projected_jvp(primals, tangents):
    """Differentiate in closed form; the problem is constant during a search."""
    problem, active, point = primals
    expansion = problem.expand(point, active)
    return expansion.residuals, jnp.einsum("cnk,k->cn", expansion.jacobian, tangents[2])


def _cost(residuals: Float[Array, "channels nodes"]) -> Float[Array, ""]:
    cost = jnp.sum(residuals**2)
    return jnp.where(jnp.isfinite(cost), cost, jnp.inf)


class AbstractSpread(eqx.Module):
    """The choice of which channels share their variances and so form one problem."""

    @abc.abstractmethod
    def over(
        self,
        function: Callable[[FitProblem, GivenVariances | None], Any],
        problem: FitProblem,
        start: GivenVariances | None,
    ) -> Any:
        """Apply a function to each problem and its start. Several problems add a leading axis."""


class SharedVariances(AbstractSpread):
    r"""One set of variances for all channels, as the renderer requires, which computes one layer
    per variance.

    The fit minimizes the square of Eq. 4, summed over the channels.
    """

    def over(self, function, problem, start):
        return function(problem, start)


class VariancesPerChannel(AbstractSpread):
    """Separate variances for each channel.

    The result has a leading axis of channels: variances `[channels, gaussians]`, weights
    `[channels, gaussians, 1]`.
    """

    def over(self, function, problem, start):
        channels = jax.tree.map(lambda values: values[:, None], problem)
        starts = jax.tree.map(
            lambda values: jnp.broadcast_to(values, (*problem.norm.shape, values.shape[-1])), start
        )
        return jax.vmap(function)(channels, starts)


def stationary(
    problem: FitProblem, optimum: Float[Array, " gaussians"]
) -> Float[Array, " gaussians"]:
    r"""Return an optimum unchanged, and differentiate it by the implicit function theorem.

    `g(log_variances, profile) = 0` at the optimum, so `d log_variances = -H^-1 dg`, where `H`, the
    derivative of `g`, is the full Hessian of Eq. 3 after the weights are eliminated (not the
    Gauss-Newton approximation). Both forward and reverse mode work.
    """

    def tangent_solve(linear, tangent):
        hessian = jax.vmap(linear, out_axes=1)(jnp.eye(tangent.shape[0], dtype=tangent.dtype))
        return invert_moving(hessian) @ tangent

    return jax.lax.custom_root(
        lambda point: problem.expand(point).gradient,
        jax.lax.stop_gradient(optimum),
        lambda _, guess: guess,
        tangent_solve,
    )


def refine(
    problem: FitProblem, start: Float[Array, " gaussians"]
) -> tuple[Float[Array, " gaussians"], Bool[Array, ""]]:
    """Finish a fit by Newton's method with the full Hessian, and return whether it has
    converged.
    """
    problem, start = jax.lax.stop_gradient((problem, start))

    def step(state):
        best, newton, _, steps = state
        trial = best[0] - newton
        expansion = problem.expand(trial)
        # Steps as small as rounding do not change the cost significantly. They are rejected and end
        # the search.
        moved = (steps == 0) | (
            jnp.max(jnp.abs(newton)) > _STEP * float(jnp.finfo(trial.dtype).eps)
        )
        better = moved & (expansion.cost < best[1])
        reached = trial, expansion.cost, _gain(expansion)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), reached, best)
        return best, invert_moving(expansion.hessian) @ expansion.gradient, better, steps + 1

    unknown = jnp.full((), jnp.inf, start.dtype)
    # The best point with its cost and gain, the next step, whether to continue, and the step count.
    state = (start, unknown, unknown), jnp.zeros_like(start), jnp.asarray(True), jnp.asarray(0)
    (point, cost, gain), *_ = jax.lax.while_loop(
        lambda state: state[2] & (state[3] <= _NEWTON_STEPS), step, state
    )
    floor = (_FLOOR * float(jnp.finfo(start.dtype).eps)) ** 2
    return point, jnp.isfinite(cost) & (gain <= _GAIN * cost + floor)


def _gain(expansion: Expansion) -> Float[Array, ""]:
    """Compute the predicted decrease of the sum of squares for linear residuals. Unlike the
    Hessian, it is accurate in float32.
    """
    normal = jnp.einsum("cni,cnj->ij", expansion.jacobian, expansion.jacobian)
    squared = jnp.diagonal(normal)
    lengths = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    # This is half the gradient. The Jacobian is orthogonal to the basis, so rounding of the weights
    # has no effect.
    along = jnp.einsum("cnk,cn->k", expansion.jacobian, expansion.residuals) / lengths
    return along @ invert_moving(normal / (lengths[:, None] * lengths[None])) @ along
