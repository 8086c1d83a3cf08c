"""Which channels share their variances."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import RadialRule

from ._problem import Problem, make_problem
from ._search import AbstractStart, search
from ._stationary import refine, stationary
from ._weights import AbstractWeights


class AbstractSpread(eqx.Module):
    """Which channels of a fit share their variances."""

    @abc.abstractmethod
    def fit(
        self, profile: AbstractProfile, count: int, weights: AbstractWeights, rule: RadialRule, start: AbstractStart
    ) -> tuple[SumOfGaussians, Float[Array, " channels"], Float[Array, " channels"], Bool[Array, ""]]:
        """Give the Gaussians, Eq. 4 and the energy of each channel, and whether the search has converged."""


class SharedVariances(AbstractSpread):
    r"""One set of variances for all channels, as the renderer needs it: it draws one layer for each.

    The fit minimizes the sum over the channels of the square of Eq. 4.
    """

    def fit(
        self, profile: AbstractProfile, count: int, weights: AbstractWeights, rule: RadialRule, start: AbstractStart
    ) -> tuple[SumOfGaussians, Float[Array, " channels"], Float[Array, " channels"], Bool[Array, ""]]:
        problem = make_problem(profile, weights, rule)
        gaussians, error, converged = _fit(problem, count, start)
        return gaussians, error, gaussians.total_reflectance(), converged


class VariancesPerChannel(AbstractSpread):
    """Variances of its own for each channel: one `SumOfGaussians` of one channel for each, batched along a leading axis."""

    def fit(
        self, profile: AbstractProfile, count: int, weights: AbstractWeights, rule: RadialRule, start: AbstractStart
    ) -> tuple[SumOfGaussians, Float[Array, " channels"], Float[Array, " channels"], Bool[Array, ""]]:
        shared = make_problem(profile, weights, rule)
        scale = jax.lax.stop_gradient(profile.length_scale())

        def fit_channel(squared_radii, root_weights, target, norm, total, unit, start):
            one = (leaf[None] for leaf in (squared_radii, root_weights, target, norm, total))
            gaussians, error, converged = _fit(Problem(*one, unit=unit, weights=weights), count, start)
            return gaussians, error[0], gaussians.total_reflectance()[0], converged

        fitted = jax.vmap(fit_channel)(
            shared.squared_radii,
            shared.root_weights,
            shared.target,
            shared.norm,
            shared.total,
            scale,
            start.of_channels(len(scale)),
        )
        gaussians, error, energy, converged = fitted
        return gaussians, error, energy, jnp.all(converged)


def _fit(problem: Problem, count: int, start: AbstractStart) -> tuple[SumOfGaussians, Float[Array, " channels"], Bool[Array, ""]]:
    found, converged = refine(problem, search(problem, count, start))
    log_variances = stationary(problem, found)
    gaussians = SumOfGaussians(problem.variances(log_variances), problem.energies(log_variances))
    residuals = problem.residuals(log_variances)
    error = jnp.sqrt(jnp.sum(residuals * residuals, axis=1))
    return gaussians, error, converged
