"""The search for the best variances, and where it starts."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from splatjax._records import numbers, record

from ._dense import NormalEquations
from ._problem import Problem

_FIRST = (-3.0, 4.0)
"""Log variances, in squared length scales, between which a single Gaussian starts."""

_OUTWARD = 1.5
"""How far, in log variance, a Gaussian starts outside the previous ones: neighbors lie 1.4 to 2.2
apart.
"""

_TOLERANCE = 1e-3
_STEPS = 64
"""Enough to tell the starts apart, and for Newton's method to finish from the best of them."""


class AbstractStart(eqx.Module):
    """Where the search for the variances starts."""

    @abc.abstractmethod
    def search(self, problem: Problem, count: int) -> Float[Array, " gaussians"]:
        """Give nearly the best log variances, ascending, of a problem in JAX's default
        precision.
        """

    def of_channels(self, channels: int) -> "AbstractStart":
        """Give the starts of so many channels that have variances of their own, along a leading
        axis.
        """
        del channels
        return self


class InsertedGaussians(AbstractStart):
    """From the best fit with one Gaussian fewer, and so on down to one: one is inserted at every
    place, and the best is kept.
    """

    def search(self, problem: Problem, count: int) -> Float[Array, " gaussians"]:
        return ladder(problem, count)[-1]


@record
class GivenVariances(AbstractStart):
    r"""From variances that are known to lie near, of a fit of nearly the same profile.

    One descent, hence fast; it finds the optimum that it starts next to.

    **Attributes:**

    - `variances`: mm^2, positive: one for each Gaussian, or, for channels with variances of their
      own, a row for each channel.
    """

    variances: Float[Array, "*channels gaussians"] = eqx.field(converter=numbers)

    def of_channels(self, channels: int) -> "GivenVariances":
        count = self.variances.shape[-1]
        return GivenVariances(jnp.broadcast_to(self.variances, (channels, count)))

    def search(self, problem: Problem, count: int) -> Float[Array, " gaussians"]:
        if self.variances.shape != (count,):
            shape = list(self.variances.shape)
            raise ValueError(
                f"a fit of {count} Gaussians starts from as many variances, shared by the "
                f"channels; got {shape}"
            )
        variances = jax.lax.stop_gradient(self.variances).astype(problem.target.dtype)
        start = jnp.log(variances / (problem.unit * problem.unit))
        return jnp.sort(_descend(problem, start, None)[0])


def search(problem: Problem, count: int, start: AbstractStart) -> Float[Array, " gaussians"]:
    """Give nearly the best log variances, ascending. No derivative goes through it."""
    return start.search(constant(problem), count).astype(problem.target.dtype)


def constant(problem: Problem) -> Problem:
    """Give a problem through which no derivative goes, in JAX's default precision: optimistix damps
    in it, whatever it is given."""
    return jax.tree.map(
        lambda leaf: jax.lax.stop_gradient(leaf).astype(jnp.result_type(float)), problem
    )


def ladder(problem: Problem, largest: int) -> Float[Array, "counts gaussians"]:
    """Give nearly the best log variances of 1 to so many Gaussians, each ascending, with zeros
    behind.
    """
    dtype = problem.target.dtype

    def rung(best, active_count):
        active = jnp.arange(largest) < active_count
        starts = jax.vmap(lambda place: _insert(best, active_count, place))(jnp.arange(largest))
        found, costs = jax.vmap(lambda start: _descend(problem, start, active))(starts)
        best = _sorted(found[jnp.argmin(costs)], active)
        return best, best

    return jax.lax.scan(rung, jnp.zeros(largest, dtype), jnp.arange(1, largest + 1))[1]


def _insert(
    best: Float[Array, " gaussians"], active_count: Int[Array, ""], place: Int[Array, ""]
) -> Float[Array, " gaussians"]:
    """Insert one log variance at a place among the first `active_count - 1`, which ascend."""
    count = best.shape[0]
    last = active_count - 1
    place = jnp.minimum(place, last)
    below = best[jnp.maximum(place - 1, 0)]
    above = best[jnp.minimum(place, count - 1)]
    between = 0.5 * (below + above)
    value = jnp.where(
        place == 0, above - _OUTWARD, jnp.where(place == last, below + _OUTWARD, between)
    )
    index = jnp.arange(count)
    shifted = jnp.roll(best, 1)
    inserted = jnp.where(index < place, best, jnp.where(index == place, value, shifted))
    spread = jnp.linspace(*_FIRST, count, dtype=best.dtype)
    return jnp.where(active_count == 1, jnp.full_like(best, 1) * spread[place], inserted)


def _descend(
    problem: Problem, start: Float[Array, " gaussians"], active: Bool[Array, " gaussians"] | None
) -> tuple[Float[Array, " gaussians"], Float[Array, ""]]:
    """Give where a descent ends, and the sum of squares there."""
    # In units of the start's own residual, so that damping and tolerances mean the same for a good
    # fit as for a poor one.
    unit = jnp.sqrt(_cost(problem.residuals(start, active)))

    def residuals(point, _):
        return _projected(problem, active, point) / unit

    solver = optx.LevenbergMarquardt(
        rtol=_TOLERANCE, atol=_TOLERANCE, linear_solver=NormalEquations()
    )
    found = optx.least_squares(residuals, solver, start, max_steps=_STEPS, throw=False).value
    return found, _cost(problem.residuals(found, active))


@jax.custom_jvp
def _projected(
    problem: Problem, active: Bool[Array, " gaussians"] | None, point: Float[Array, " gaussians"]
) -> Float[Array, "channels nodes"]:
    return problem.residuals(point, active)


@_projected.defjvp
def _projected_jvp(primals, tangents):
    """The closed form; the problem is a constant of a search."""
    problem, active, point = primals
    expansion = problem.expand(point, active)
    return expansion.residuals, jnp.einsum("cnk,k->cn", expansion.jacobian, tangents[2])


def _cost(residuals: Float[Array, "channels nodes"]) -> Float[Array, ""]:
    cost = jnp.sum(residuals**2)
    return jnp.where(jnp.isfinite(cost), cost, jnp.full_like(cost, jnp.inf))


def _sorted(
    point: Float[Array, " gaussians"], active: Bool[Array, " gaussians"]
) -> Float[Array, " gaussians"]:
    ordered = jnp.sort(jnp.where(active, point, jnp.full_like(point, jnp.inf)))
    return jnp.where(active, ordered, jnp.zeros_like(point))
