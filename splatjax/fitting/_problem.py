"""The errors that a fit minimizes (Eq. 3) and reports (Eq. 4), and Eq. 3 as a function of the log
variances, with the weights eliminated by a linear solve (variable projection).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import require
from splatjax.gaussians import AbstractProfile, SumOfGaussians, gaussian
from splatjax.scattering import L2_QUADRATURE, AbstractRadialRule, at_own_radii

from ._weights import AbstractWeights, invert_moving


def nonzero(norm: Float[Array, "*channels"]) -> Float[Array, "*channels"]:
    """Replace a norm of 0, that of a black channel, by 1, so that its errors are 0."""
    return jnp.where(norm > 0, norm, 1.0)


def norm_radii(
    profile: AbstractProfile, rule: AbstractRadialRule
) -> tuple[Float[Array, "nodes channels"], Float[Array, "nodes channels"]]:
    """Compute radii and weights for integrals of `r R^2`; raise `ValueError` if the integral
    diverges.
    """
    require(
        not (profile.singular and rule.reaches_origin),
        f"{type(profile).__name__} diverges like 1/r, so the integral of r R^2 from 0 (Eq. 3) "
        "does not exist; give the rule of a model (TransportModel.rule), or the radius where it "
        "starts, in length scales: rule=scattering.L2_QUADRATURE.beyond(1.0)",
    )
    return rule.radii(profile)


@jit_unless_traced
def squared_error(
    profile: AbstractProfile, gaussians: SumOfGaussians, rule: AbstractRadialRule = L2_QUADRATURE
) -> Float[Array, " channels"]:
    r"""Compute the error that a fit minimizes, the integral over r of `r (R(r) - sum_i w_i G(v_i,
    r))^2` (Eq. 3).

    **Arguments:**

    - `profile`: the reference, 1/mm^2. Differentiable.
    - `gaussians`: a sum of Gaussians with the same number of channels. Differentiable.
    - `rule`: radii of the integral, in length scales of `profile`.

    **Returns:** [channels], 1/mm^2, at least 0.

    **Raises:** `ValueError` for a profile that is infinite at the origin, unless the rule starts
    beyond it.

    **Source:** Kim et al. 2010, Eq. 3 (d'Eon, Luebke and Enderton 2007).
    """
    r, dr = norm_radii(profile, rule)
    difference = at_own_radii(profile, r) - at_own_radii(gaussians, r)
    return jnp.sum(dr * r * difference * difference, axis=0)


@jit_unless_traced
def relative_error(
    profile: AbstractProfile, gaussians: SumOfGaussians, rule: AbstractRadialRule = L2_QUADRATURE
) -> Float[Array, " channels"]:
    r"""Compute the relative error of a fit: the root of Eq. 3 divided by the root of the integral
    of `r R^2` (Eq. 4).

    The error depends mainly on the core of a profile and little on its tail. For the energy, see
    `FitResult.energy_error`.

    **Arguments:** as for `squared_error`. Differentiable where the fit is not perfect.

    **Returns:** [channels], at least 0; independent of the unit of length and the scale of the
    profile.

    **Source:** Kim et al. 2010, Eq. 4.
    """
    r, dr = norm_radii(profile, rule)
    values = at_own_radii(profile, r)
    norm = nonzero(jnp.sum(dr * r * values * values, axis=0))
    return jnp.sqrt(squared_error(profile, gaussians, rule) / norm)


class Expansion(eqx.Module):
    r"""The expansion of the sum of squared residuals about a point, with the best weights at every
    point (after Golub and Pereyra).

    **Attributes:**

    - `cost`: the sum of squares.
    - `gradient`, `hessian`: full gradient and Hessian of the cost.
    - `residuals`, `jacobian`: residuals of each channel at the nodes, and their Jacobian.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, " gaussians"]
    hessian: Float[Array, "gaussians gaussians"]
    residuals: Float[Array, "channels nodes"]
    jacobian: Float[Array, "channels nodes gaussians"]


class FitProblem(eqx.Module):
    r"""Eq. 3 for the channels that share their variances, divided by the norm of each channel and
    discretized by a radial rule.

    Variances are in units of a squared length, the geometric mean of the `scales` of the channels,
    so results do not depend on the unit of length. Differentiable in `target` and `total`; nodes
    and scales are constants.
    """

    squared_radii: Float[Array, "*batch channels nodes"]
    root_weights: Float[Array, "*batch channels nodes"]
    target: Float[Array, "*batch channels nodes"]
    norm: Float[Array, "*batch channels"]
    total: Float[Array, "*batch channels"]
    scales: Float[Array, "*batch channels"]
    weights: AbstractWeights

    @property
    def squared_unit(self) -> Float[Array, ""]:
        """Return the unit of the variances, mm^2."""
        return jnp.exp(2 * jnp.mean(jnp.log(self.scales)))

    def variances(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        return jnp.exp(log_variances) * self.squared_unit

    def log_variances(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Compute the log variances of variances in mm^2; they are constants for
        differentiation.
        """
        variances = jax.lax.stop_gradient(variances).astype(self.target.dtype)
        return jnp.log(variances / self.squared_unit)

    def solve(
        self,
        log_variances: Float[Array, " gaussians"],
        active: Bool[Array, " gaussians"] | None = None,
    ) -> tuple[
        Float[Array, "channels nodes gaussians"],
        Float[Array, "channels gaussians"],
        Float[Array, "channels gaussians gaussians"],
        Float[Array, "channels nodes"],
    ]:
        """Find the best coefficients of each channel, and return the basis, the coefficients, their
        response and the residuals. Inactive Gaussians have coefficient 0.
        """
        variances = self.variances(log_variances)
        energies = self.energies(variances)
        # The Gaussians at the nodes, scaled to unit norm in closed form.
        basis = gaussian(variances[None, None], self.squared_radii[..., None])
        basis = basis * energies[None, None] * self.root_weights[..., None]

        def solve(rows, target, total):
            if active is None:
                return self.weights.solve(rows, target, energies, total)
            return self.weights.solve_active(rows, target, energies, total, active)

        coefficients, response = jax.vmap(solve)(basis, self.target, self.total / self.norm)
        residuals = self.target - jnp.einsum("cnk,ck->cn", basis, coefficients)
        return basis, coefficients, response, residuals

    def residuals(
        self,
        log_variances: Float[Array, " gaussians"],
        active: Bool[Array, " gaussians"] | None = None,
    ) -> Float[Array, "channels nodes"]:
        """Compute the residuals of the best weights. The sum of their squares over a channel is its
        squared error (Eq. 4).
        """
        return self.solve(log_variances, active)[-1]

    def expand(
        self,
        log_variances: Float[Array, " gaussians"],
        active: Bool[Array, " gaussians"] | None = None,
    ) -> Expansion:
        """Compute the sum of squared residuals and its derivatives in closed form."""
        basis, coefficients, response, residuals = self.solve(log_variances, active)
        slopes, curved, moved = self._slopes(log_variances, basis, coefficients, response)
        # The derivative of the best coefficients; the first term alone is that for zero residuals.
        along = jnp.einsum("cnk,cn->ck", slopes, residuals)
        follow = moved + response * along[:, None, :]
        steep = slopes * coefficients[:, None, :]
        jacobian = -steep - jnp.einsum("cni,cij->cnj", basis, follow)
        second = jnp.einsum("cni,cnj->ij", steep, jacobian)
        second = second + jnp.einsum("ci,cij->ij", along, follow)
        bend = jnp.sum(coefficients * jnp.einsum("cnk,cn->ck", curved, residuals), axis=0)
        return Expansion(
            cost=jnp.sum(residuals * residuals),
            gradient=-2 * jnp.sum(coefficients * along, axis=0),
            hessian=-2 * (second + jnp.diag(bend)),
            residuals=residuals,
            jacobian=jacobian,
        )

    def outcome(
        self, log_variances: Float[Array, " gaussians"]
    ) -> tuple[SumOfGaussians, Float[Array, " channels"], Float[Array, "parameters parameters"]]:
        """Compute the Gaussians of an optimum, the error (Eq. 4) of each channel, and the
        covariance (see `FitResult`).
        """
        basis, coefficients, response, residuals = self.solve(log_variances)
        squared = jnp.sum(residuals * residuals, axis=1)
        slopes, _, moved = self._slopes(log_variances, basis, coefficients, response)
        steep = slopes * coefficients[:, None, :] + jnp.einsum("cni,cij->cnj", basis, moved)
        normal = jnp.einsum("cni,cnj->ij", steep, steep)
        # From logarithms to variances, and from coefficients to weights.
        variances, (channels, count) = self.variances(log_variances), coefficients.shape
        scale = self.norm[:, None] * self.energies(variances)[None]
        follow = jnp.concatenate(
            [jnp.diag(variances), (moved * scale[..., None]).reshape(channels * count, count)]
        )
        linear = jax.scipy.linalg.block_diag(
            jnp.zeros_like(normal), *(response * scale[..., None] * scale[:, None, :])
        )
        covariance = jnp.sum(squared) * (follow @ invert_moving(normal) @ follow.T + linear)
        # The variance of a Gaussian without weight in any channel is unknown.
        idle = jnp.append(jnp.diagonal(normal) == 0, jnp.zeros(channels * count, bool))
        unknown = jnp.diag(jnp.where(idle, jnp.inf, 0.0).astype(covariance.dtype))
        covariance = jnp.where(idle[:, None] | idle[None], unknown, covariance)
        return SumOfGaussians(variances, (coefficients * scale).T), jnp.sqrt(squared), covariance

    def _slopes(self, log_variances, basis, coefficients, response):
        """Compute the first and second derivatives of the basis at fixed weights, and the
        derivative of the coefficients for zero residuals.
        """
        variances = self.variances(log_variances)[None, None]
        growth = 0.5 * self.squared_radii[..., None] / variances - 1
        slopes = basis * growth
        moved = -jnp.einsum(
            "cij,cjk->cik",
            response,
            jnp.einsum("cni,cnj->cij", basis, slopes) * coefficients[:, None, :],
        )
        return slopes, basis * (growth * growth - growth - 1), moved

    def energies(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Compute the weight that gives a Gaussian unit norm: the integral of r G(v, r)^2 is 1 / (8
        pi^2 v).
        """
        return jnp.sqrt(8 * jnp.pi**2 * variances)


def make_problem(
    profile: AbstractProfile, weights: AbstractWeights, rule: AbstractRadialRule
) -> FitProblem:
    """Set up the fit of all channels of a profile."""
    require(
        isinstance(profile, AbstractProfile),
        f"profile must be a profile, such as Dipole(medium); got {type(profile).__name__}",
    )
    r, dr = norm_radii(profile, rule)
    values = at_own_radii(profile, r)
    norm = jnp.sqrt(nonzero(jnp.sum(dr * r * values * values, axis=0)))
    root_weights = jnp.sqrt(dr * r)
    return FitProblem(
        squared_radii=(r * r).T,
        root_weights=root_weights.T,
        target=(root_weights * values / jnp.broadcast_to(norm, values.shape)).T,
        norm=norm,
        total=profile.total_reflectance(),
        scales=jax.lax.stop_gradient(profile.length_scale()),
        weights=weights,
    )
