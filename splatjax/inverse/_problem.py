"""Coefficients in, residuals out: what the least squares solver sees."""

import abc
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from splatjax.diffusion import resolved_fraction
from splatjax.fitting import AbstractWeights, GivenVariances, fit_gaussians, fit_weights
from splatjax.gaussians import AbstractProfile, SumOfGaussians
from splatjax.render import DiffusionBasis
from splatjax.scattering import Medium

from ._flat import FlatPictures, flatten, in_a_row
from ._losses import AbstractLoss
from ._observation import AbstractIntensity, Evidence

_STEPS = 64


class Unknowns(eqx.Module):
    """The layout of the unknowns: log sigma_a, log sigma_s' per channel, then log factors of the
    lights.
    """

    eta: Float[Array, " channels"]
    factors: Int[Array, "pictures channels"]
    """The factor of each channel of each picture; the number of factors where it is known."""
    count: int = eqx.field(static=True)
    """Number of factors."""

    @classmethod
    def of(
        cls, eta: Float[Array, " channels"], intensities: Sequence[AbstractIntensity]
    ) -> "Unknowns":
        factors, count = [], 0
        for intensity in intensities:
            groups = intensity.groups(len(eta))
            factors.append(np.where(groups < 0, -1, groups + count))
            count += int(np.max(groups)) + 1
        factors = np.stack(factors)
        return cls(eta, jnp.asarray(np.where(factors < 0, count, factors), jnp.int32), count)

    def medium(self, point: Float[Array, " unknowns"]) -> Medium:
        channels = len(self.eta)
        return Medium(jnp.exp(point[:channels]), jnp.exp(point[channels : 2 * channels]), self.eta)

    def intensities(self, point: Float[Array, " unknowns"]) -> Float[Array, "pictures channels"]:
        factors = jnp.append(point[2 * len(self.eta) :], jnp.zeros((), point.dtype))
        return jnp.exp(factors[self.factors])

    def start(self, medium: Medium) -> Float[Array, " unknowns"]:
        coefficients = jnp.log(jnp.concatenate([medium.sigma_a, medium.sigma_s_prime]))
        return jnp.pad(coefficients, (0, self.count))


class AbstractGaussianFit(eqx.Module):
    """How the Gaussians follow from a profile."""

    @abc.abstractmethod
    def gaussians(self, profile: AbstractProfile) -> SumOfGaussians:
        """Fit the Gaussians of a profile. Differentiable."""


class FixedVariances(AbstractGaussianFit):
    """The variances are the same for all media."""

    variances: Float[Array, " gaussians"]
    weights: AbstractWeights

    def gaussians(self, profile: AbstractProfile) -> SumOfGaussians:
        return fit_weights(profile, self.variances, weights=self.weights)


class FittedVariances(AbstractGaussianFit):
    """The variances are those of the best fit to each medium, and move with the weights."""

    near: Float[Array, " gaussians"]
    weights: AbstractWeights

    def gaussians(self, profile: AbstractProfile) -> SumOfGaussians:
        start, count = GivenVariances(self.near), len(self.near)
        fit = fit_gaussians(profile, count, weights=self.weights, start=start, throw=False)
        return fit.gaussians


class RecoveryProblem(eqx.Module):
    """Observed pictures, and how pictures are made from coefficients."""

    pictures: FlatPictures
    observed: Float[Array, "channels pixels"]
    deviation: Float[Array, "channels pixels"]
    unknowns: Unknowns
    fit: AbstractGaussianFit
    loss: AbstractLoss
    model: Callable[[Medium], AbstractProfile] = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        pictures: Sequence[DiffusionBasis],
        evidence: Sequence[Evidence],
        counted: Sequence[np.ndarray],
        unknowns: Unknowns,
        fit: AbstractGaussianFit,
        loss: AbstractLoss,
        model: Callable[[Medium], AbstractProfile],
    ) -> "RecoveryProblem":
        """Compare rendered pictures with the observed ones, at the pixels that count."""
        dtype = unknowns.eta.dtype
        observed, deviation = (
            jnp.asarray(in_a_row(images, counted), dtype)
            for images in ([one.picture for one in evidence], [one.deviation for one in evidence])
        )
        flat = flatten(pictures, counted, dtype)
        return cls(flat, observed, deviation, unknowns, fit, loss, model)

    def gaussians(self, point: Float[Array, " unknowns"]) -> SumOfGaussians:
        return self.fit.gaussians(self.model(self.unknowns.medium(point)))

    def radiance(self, point: Float[Array, " unknowns"]) -> Float[Array, "channels pixels"]:
        return self.pictures.radiance(self.gaussians(point), self.unknowns.intensities(point))

    def residuals(self, point: Float[Array, " unknowns"]) -> Float[Array, "channels pixels"]:
        """Compute residuals whose squares are the losses."""
        return self.loss.root((self.radiance(point) - self.observed) / self.deviation)


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

    def residuals(point, log_width):
        moved = eqx.tree_at(
            lambda one: one.pictures.light.interval,
            problem,
            replace_fn=lambda interval: interval * jnp.exp(log_width),
        )
        return moved.residuals(point), (problem.gaussians(point), problem.radiance(point))

    (slopes, of_width), (gaussians, radiance) = jax.jacfwd(residuals, (0, 1), has_aux=True)(
        point, jnp.zeros((), point.dtype)
    )
    # Every channel has a width of its own.
    of_widths = of_width[..., None] * jnp.eye(len(of_width), dtype=of_width.dtype)[:, None]
    slopes = jnp.concatenate([slopes, of_widths], axis=-1)
    light = problem.pictures.light
    resolved = resolved_fraction(light.variances[:, None], light.area[None], light.interval)
    unresolved = 1 - jnp.mean(jnp.where(light.mass > 0, resolved, 0.0), axis=1)
    unresolved = unresolved @ gaussians.weights / gaussians.total_reflectance()
    return Solution(jnp.einsum("cpi,cpj->ij", slopes, slopes), gaussians, radiance, unresolved)
