"""The fit as a function of the logarithms of the variances alone: the weights are solved inside
(variable projection).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax.gaussians import AbstractProfile, SumOfGaussians, gaussian
from splatjax.scattering import AbstractRadialRule, at_own_radii

from ._dense import invert_moving
from ._errors import norm_radii
from ._weights import AbstractWeights, without_idle


class Expansion(eqx.Module):
    r"""The sum of squared residuals around a point, with the best weights everywhere (after Golub
    and Pereyra).

    **Attributes:**

    - `cost`: the sum of squares.
    - `gradient`, `hessian`: of the cost, the full ones.
    - `residuals`, `jacobian`: of each channel at the nodes.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, " gaussians"]
    hessian: Float[Array, "gaussians gaussians"]
    residuals: Float[Array, "channels nodes"]
    jacobian: Float[Array, "channels nodes gaussians"]


class FitProblem(eqx.Module):
    r"""Eq. 3 of all channels that share their variances, each divided by its norm, at the nodes of
    a radial rule.

    Variances are counted in the square of one length, the geometric mean of the `scales` of the
    channels, so that nothing depends on the unit of length. Differentiable in `target` and `total`;
    nodes and scales are constants.
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
        """The unit of variances, mm^2."""
        return jnp.exp(2 * jnp.mean(jnp.log(self.scales)))

    def variances(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Compute the variances, mm^2."""
        return jnp.exp(log_variances) * self.squared_unit

    def log_variances(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Take the logarithms of given variances, mm^2, which are constants of every derivative."""
        variances = jax.lax.stop_gradient(variances).astype(self.target.dtype)
        return jnp.log(variances / self.squared_unit)

    def basis(
        self, log_variances: Float[Array, " gaussians"]
    ) -> Float[Array, "channels nodes gaussians"]:
        """Compute the Gaussians at the nodes, each scaled to a unit norm (in closed form)."""
        variances = self.variances(log_variances)
        shape = (*self.squared_radii.shape, *variances.shape)
        squared_radii = jnp.broadcast_to(self.squared_radii[..., None], shape)
        values = gaussian(jnp.broadcast_to(variances, shape), squared_radii)
        energies = jnp.broadcast_to(self._energies(variances), shape)
        return values * energies * self.root_weights[..., None]

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
        """Find the best coefficients of each channel: the basis, the coefficients, their response
        and the residuals. Gaussians that are not active have the coefficient 0.
        """
        basis = self.basis(log_variances)
        energies = self._energies(self.variances(log_variances))

        def solve(rows, target, total):
            if active is None:
                return self.weights.solve(rows, target, energies, total)
            coefficients, response = self.weights.solve(
                *without_idle(rows, target, energies, active), total
            )
            return coefficients, jnp.where(active[:, None] & active[None], response, 0.0)

        if active is not None:
            basis = jnp.where(jnp.broadcast_to(active, basis.shape), basis, 0.0)
        coefficients, response = jax.vmap(solve)(basis, self.target, self.total / self.norm)
        residuals = self.target - jnp.einsum("cnk,ck->cn", basis, coefficients)
        return basis, coefficients, response, residuals

    def best_weights(
        self, log_variances: Float[Array, " gaussians"]
    ) -> Float[Array, "gaussians channels"]:
        """Compute the weights with the least error."""
        _, coefficients, _, _ = self.solve(log_variances)
        energies = self._energies(self.variances(log_variances))
        return (coefficients * self.norm[:, None] * energies[None]).T

    def residuals(
        self,
        log_variances: Float[Array, " gaussians"],
        active: Bool[Array, " gaussians"] | None = None,
    ) -> Float[Array, "channels nodes"]:
        """Compute the residuals of the best weights; the sum of squares of a channel is the square
        of its Eq. 4.
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
        # How the best coefficients follow: the first term is that of a basis without residuals.
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
        """Compute the Gaussians of an optimum, Eq. 4 of its channels, and the covariance that
        `FitResult` describes.
        """
        basis, coefficients, response, residuals = self.solve(log_variances)
        squared = jnp.sum(residuals * residuals, axis=1)
        slopes, _, moved = self._slopes(log_variances, basis, coefficients, response)
        steep = slopes * coefficients[:, None, :] + jnp.einsum("cni,cij->cnj", basis, moved)
        normal = jnp.einsum("cni,cnj->ij", steep, steep)
        # From logarithms to variances, and from coefficients to weights.
        variances, (channels, count) = self.variances(log_variances), coefficients.shape
        scale = self.norm[:, None] * self._energies(variances)[None]
        follow = jnp.concatenate(
            [jnp.diag(variances), (moved * scale[..., None]).reshape(channels * count, count)]
        )
        own = jax.scipy.linalg.block_diag(
            jnp.zeros_like(normal), *(response * scale[..., None] * scale[:, None, :])
        )
        covariance = jnp.sum(squared) * (follow @ invert_moving(normal) @ follow.T + own)
        # The variance of a Gaussian without weight in any channel is unknown.
        idle = jnp.append(jnp.diagonal(normal) == 0, jnp.zeros(channels * count, bool))
        unknown = jnp.diag(jnp.where(idle, jnp.inf, 0.0).astype(covariance.dtype))
        covariance = jnp.where(idle[:, None] | idle[None], unknown, covariance)
        gaussians = SumOfGaussians(variances, (coefficients * scale).T)
        return gaussians, jnp.sqrt(squared), covariance

    def _slopes(self, log_variances, basis, coefficients, response):
        """Compute the first and second derivative of the basis at fixed weights, and how the
        coefficients follow if there are no residuals.
        """
        reach = self._reach(log_variances) - 1
        slopes = basis * reach
        curved = basis * (reach * reach - reach - 1)
        moved = -jnp.einsum(
            "cij,cjk->cik",
            response,
            jnp.einsum("cni,cnj->cij", basis, slopes) * coefficients[:, None, :],
        )
        return slopes, curved, moved

    def _reach(
        self, log_variances: Float[Array, " gaussians"]
    ) -> Float[Array, "channels nodes gaussians"]:
        """Compute `r^2 / 2v`."""
        shape = (*self.squared_radii.shape, *log_variances.shape)
        variances = jnp.broadcast_to(self.variances(log_variances), shape)
        return 0.5 * jnp.broadcast_to(self.squared_radii[..., None], shape) / variances

    def _energies(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """The weight of a Gaussian of unit norm: the integral of r G(v, r)^2 is 1 / (8 pi^2 v)."""
        return jnp.sqrt(8 * jnp.pi**2 * variances)


def make_problem(
    profile: AbstractProfile, weights: AbstractWeights, rule: AbstractRadialRule
) -> FitProblem:
    """Set up the fit of all channels of a profile."""
    r, dr = norm_radii(profile, rule)
    values = at_own_radii(profile, r)
    norm = jnp.sqrt(jnp.sum(dr * r * values * values, axis=0))
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
