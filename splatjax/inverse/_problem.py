"""Coefficients in, residuals out: what the least squares solver sees."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from splatjax.fitting import (
    AbstractWeights,
    FixedTotalReflectance,
    GivenVariances,
    NonNegativeWeights,
    fit_gaussians,
    fit_weights,
)
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.scattering import Medium

from ._flat import FlatPictures
from ._losses import AbstractLoss

_STEPS = 64


def default_weights() -> AbstractWeights:
    """Return the weights with which the materials of the package are fitted: not negative, with a
    fixed sum.
    """
    return NonNegativeWeights(FixedTotalReflectance())


class Unknowns(eqx.Module):
    """The layout of the unknowns: log sigma_a, log sigma_s' per channel, then log factors of the
    lights.
    """

    eta: Float[Array, " channels"]
    factors: Int[Array, "pictures channels"]
    """The factor of each channel of each picture; the number of factors where it is known."""

    def medium(self, point: Float[Array, " unknowns"]) -> Medium:
        channels = self.eta.shape[0]
        return Medium(jnp.exp(point[:channels]), jnp.exp(point[channels : 2 * channels]), self.eta)

    def intensities(self, point: Float[Array, " unknowns"]) -> Float[Array, "pictures channels"]:
        factors = jnp.append(point[2 * self.eta.shape[0] :], jnp.zeros((), point.dtype))
        return jnp.exp(factors[self.factors])

    def start(self, medium: Medium, count: int) -> Float[Array, " unknowns"]:
        return jnp.concatenate(
            [
                jnp.log(medium.sigma_a),
                jnp.log(medium.sigma_s_prime),
                jnp.zeros(count, self.eta.dtype),
            ]
        )


class AbstractVariances(eqx.Module):
    """How the variances of Gaussians follow from a medium."""

    @abc.abstractmethod
    def gaussians(self, profile: AbstractProfile, weights: AbstractWeights) -> SumOfGaussians:
        """Fit the Gaussians of a profile. Differentiable."""


class FixedVariances(AbstractVariances):
    """The same for all media."""

    variances: Float[Array, " gaussians"]

    def gaussians(self, profile: AbstractProfile, weights: AbstractWeights) -> SumOfGaussians:
        return fit_weights(profile, self.variances, weights=weights)


class FittedVariances(AbstractVariances):
    """Those of the best fit to each medium: variances and weights move together."""

    near: Float[Array, " gaussians"]

    def gaussians(self, profile: AbstractProfile, weights: AbstractWeights) -> SumOfGaussians:
        start = GivenVariances(self.near)
        return fit_gaussians(
            profile, len(self.near), weights=weights, start=start, throw=False
        ).gaussians


class RecoveryProblem(eqx.Module):
    """Observed pictures, and how pictures are made from coefficients."""

    pictures: FlatPictures
    observed: Float[Array, "channels pixels"]
    deviation: Float[Array, "channels pixels"]
    unknowns: Unknowns
    variances: AbstractVariances
    loss: AbstractLoss
    weights: AbstractWeights
    model: Callable[[Medium], AbstractProfile] = eqx.field(static=True)

    def gaussians(self, point: Float[Array, " unknowns"]) -> SumOfGaussians:
        return self.variances.gaussians(self.model(self.unknowns.medium(point)), self.weights)

    def radiance(self, point: Float[Array, " unknowns"]) -> Float[Array, "channels pixels"]:
        return self.pictures.radiance(self.gaussians(point), self.unknowns.intensities(point))

    def residuals(self, point: Float[Array, " unknowns"]) -> Float[Array, "channels pixels"]:
        """Compute residuals whose squares are the losses."""
        return self.loss.root((self.radiance(point) - self.observed) / self.deviation)

    def resolution_slopes(
        self, point: Float[Array, " unknowns"]
    ) -> Float[Array, "channels pixels"]:
        """Differentiate the residuals in the logarithm of the widths below which layers are
        unresolved.
        """

        def moved(by: Float[Array, ""]) -> Float[Array, "channels pixels"]:
            return eqx.tree_at(
                lambda problem: problem.pictures.light.interval,
                self,
                replace_fn=lambda at: at * jnp.exp(by),
            ).residuals(point)

        zero = jnp.zeros((), point.dtype)
        return jax.jvp(moved, (zero,), (zero + 1,))[1]


class SearchEnd(eqx.Module):
    """The end of a search."""

    point: Float[Array, " unknowns"]
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


@eqx.filter_jit
def search(problem: RecoveryProblem, start: Float[Array, " unknowns"]) -> SearchEnd:
    """Minimize the loss from a start by the Levenberg-Marquardt method."""
    tolerance = 1e-4 if start.dtype == jnp.float32 else 1e-7
    # In units of the start's own residual, so that damping and tolerances mean the same for any
    # noise and number of pixels.
    unit = jnp.sqrt(jnp.sum(problem.residuals(start) ** 2)) + jnp.finfo(start.dtype).tiny

    def residuals(point, problem):
        return problem.residuals(point) / unit

    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
    end = optx.least_squares(residuals, solver, start, problem, max_steps=_STEPS, throw=False)
    cost = jnp.sum(problem.residuals(end.value) ** 2)
    converged = (end.result == optx.RESULTS.successful) & jnp.isfinite(cost)
    return SearchEnd(end.value, cost, jnp.asarray(end.stats["num_steps"]), converged)


class Solution(eqx.Module):
    """The solution at a point, and how well it is known.

    **Attributes:**

    - `information`: the inverse of the covariance that noise of the given deviations leaves
      (Laplace, by Gauss and Newton); after the unknowns come, channel by channel, the logarithms of
      the widths below which layers are unresolved.
    - `gaussians`, `radiance`: of the point.
    - `unresolved`: the fraction of the light of each channel in unresolved layers.
    """

    information: Float[Array, "all all"]
    gaussians: SumOfGaussians
    radiance: Float[Array, "channels pixels"]
    unresolved: Float[Array, " channels"]


@eqx.filter_jit
def solution(problem: RecoveryProblem, point: Float[Array, " unknowns"]) -> Solution:
    """Compute the picture at a point, and the information about each unknown and the transition to
    unresolved layers.
    """

    def residuals(point):
        gaussians, radiance = problem.gaussians(point), problem.radiance(point)
        return problem.residuals(point), (gaussians, radiance)

    slopes, (gaussians, radiance) = jax.jacfwd(residuals, has_aux=True)(point)
    channels = jnp.eye(slopes.shape[0], dtype=slopes.dtype)[:, None]
    resolution = problem.resolution_slopes(point)[..., None] * channels
    slopes = jnp.concatenate([slopes, resolution], axis=-1)
    unresolved = (
        (1 - problem.pictures.light.resolved()) @ gaussians.weights / gaussians.total_reflectance()
    )
    return Solution(jnp.einsum("cpi,cpj->ij", slopes, slopes), gaussians, radiance, unresolved)
