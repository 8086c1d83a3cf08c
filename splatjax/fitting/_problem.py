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

    def normal(self) -> Float[Array, "gaussians gaussians"]:
        """Give half the Hessian of Gauss and Newton."""
        return jnp.einsum("cni,cnj->ij", self.jacobian, self.jacobian)


class Outcome(eqx.Module):
    """The Gaussians of a problem's optimum, Eq. 4 of its channels, and the covariance that
    `FitResult` has.
    """

    gaussians: SumOfGaussians
    error: Float[Array, " channels"]
    covariance: Float[Array, "parameters parameters"]


class Problem(eqx.Module):
    r"""Eq. 3 of all channels that share their variances, each divided by its norm, at the nodes of
    a radial rule.

    Variances are counted in the square of one length, `unit`, so that nothing depends on the unit
    of length. Differentiable in `target` and `total`; nodes and units are constants.
    """

    squared_radii: Float[Array, "*batch channels nodes"]
    root_weights: Float[Array, "*batch channels nodes"]
    target: Float[Array, "*batch channels nodes"]
    norm: Float[Array, "*batch channels"]
    total: Float[Array, "*batch channels"]
    unit: Float[Array, "*batch"]
    weights: AbstractWeights

    def variances(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Give the variances, mm^2."""
        return jnp.exp(log_variances) * self.unit * self.unit

    def basis(
        self, log_variances: Float[Array, " gaussians"]
    ) -> Float[Array, "channels nodes gaussians"]:
        """Give the Gaussians at the nodes, each scaled to a unit norm (in closed form)."""
        variances = self.variances(log_variances)
        shape = (*self.squared_radii.shape, *variances.shape)
        values = gaussian(
            jnp.broadcast_to(variances, shape),
            jnp.broadcast_to(self.squared_radii[..., None], shape),
        )
        return (
            values
            * jnp.broadcast_to(self._energies(variances), shape)
            * self.root_weights[..., None]
        )

    def solve(
        self,
        log_variances: Float[Array, " gaussians"],
        active: Bool[Array, " gaussians"] | None = None,
    ) -> tuple[
        Float[Array, "channels nodes gaussians"],
        Float[Array, "channels gaussians"],
        Float[Array, "channels gaussians gaussians"],
    ]:
        """Give the basis, and each channel's best coefficients and their response. Gaussians that
        are not active count for nothing."""
        basis = self.basis(log_variances)
        energies = self._energies(self.variances(log_variances))

        def solve(rows, target, total):
            if active is None:
                return self.weights.solve(rows, target, energies, total)
            coefficients, response = self.weights.solve(
                *without_idle(rows, target, energies, active), total
            )
            return coefficients, jnp.where(
                active[:, None] & active[None], response, jnp.zeros_like(response)
            )

        if active is not None:
            basis = jnp.where(jnp.broadcast_to(active, basis.shape), basis, jnp.zeros_like(basis))
        return basis, *jax.vmap(solve)(basis, self.target, self.total / self.norm)

    def weighed(
        self, log_variances: Float[Array, " gaussians"]
    ) -> Float[Array, "gaussians channels"]:
        """Give the best weights."""
        _, coefficients, _ = self.solve(log_variances)
        return (
            coefficients * self.norm[:, None] * self._energies(self.variances(log_variances))[None]
        ).T

    def residuals(
        self,
        log_variances: Float[Array, " gaussians"],
        active: Bool[Array, " gaussians"] | None = None,
    ) -> Float[Array, "channels nodes"]:
        """Give what the best weights leave; the sum of squares of a channel is the square of its
        Eq. 4.
        """
        basis, coefficients, _ = self.solve(log_variances, active)
        return self.target - jnp.einsum("cnk,ck->cn", basis, coefficients)

    def expand(
        self,
        log_variances: Float[Array, " gaussians"],
        active: Bool[Array, " gaussians"] | None = None,
    ) -> Expansion:
        """Give the sum of squared residuals with its derivatives, in closed form."""
        basis, coefficients, response = self.solve(log_variances, active)
        residuals = self.target - jnp.einsum("cnk,ck->cn", basis, coefficients)
        slopes, curved, moved = self._slopes(log_variances, basis, coefficients, response)
        # How the best coefficients follow: the first term is that of a basis that leaves no
        # residual.
        along = jnp.einsum("cnk,cn->ck", slopes, residuals)
        follow = moved + response * along[:, None, :]
        steep = slopes * coefficients[:, None, :]
        jacobian = -steep - jnp.einsum("cni,cij->cnj", basis, follow)
        second = jnp.einsum("cni,cnj->ij", steep, jacobian) + jnp.einsum(
            "ci,cij->ij", along, follow
        )
        bend = jnp.sum(coefficients * jnp.einsum("cnk,cn->ck", curved, residuals), axis=0)
        return Expansion(
            cost=jnp.sum(residuals * residuals),
            gradient=-2 * jnp.sum(coefficients * along, axis=0),
            hessian=-2 * (second + jnp.diag(bend)),
            residuals=residuals,
            jacobian=jacobian,
        )

    def gradient(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Give the gradient of the sum of squared residuals: the best weights count as constants in
        it (envelope theorem).
        """
        basis, coefficients, _ = self.solve(log_variances)
        residuals = self.target - jnp.einsum("cnk,ck->cn", basis, coefficients)
        slopes = basis * (self._reach(log_variances) - 1)
        return -2 * jnp.einsum("ck,cnk,cn->k", coefficients, slopes, residuals)

    def outcome(self, log_variances: Float[Array, " gaussians"]) -> "Outcome":
        """Give what a fit reports of an optimum."""
        basis, coefficients, response = self.solve(log_variances)
        residuals = self.target - jnp.einsum("cnk,ck->cn", basis, coefficients)
        squared = jnp.sum(residuals * residuals, axis=1)
        slopes, _, moved = self._slopes(log_variances, basis, coefficients, response)
        steep = slopes * coefficients[:, None, :] + jnp.einsum("cni,cij->cnj", basis, moved)
        normal = jnp.einsum("cni,cnj->ij", steep, steep)
        ours = invert_moving(normal)
        # To the variances themselves, and from coefficients to weights.
        variances, (channels, count) = self.variances(log_variances), coefficients.shape
        scale = self.norm[:, None] * self._energies(variances)[None]
        follow = jnp.concatenate(
            [jnp.diag(variances), (moved * scale[..., None]).reshape(channels * count, count)]
        )
        own = jax.scipy.linalg.block_diag(
            jnp.zeros_like(ours), *(response * scale[..., None] * scale[:, None, :])
        )
        covariance = jnp.sum(squared) * (follow @ ours @ follow.T + own)
        # The variance of a Gaussian without weight in any channel is anything.
        idle = jnp.append(jnp.diagonal(normal) == 0, jnp.zeros(channels * count, bool))
        anything = jnp.diag(jnp.where(idle, jnp.inf, 0.0).astype(covariance.dtype))
        return Outcome(
            gaussians=SumOfGaussians(variances, (coefficients * scale).T),
            error=jnp.sqrt(squared),
            covariance=jnp.where(idle[:, None] | idle[None], anything, covariance),
        )

    def _slopes(self, log_variances, basis, coefficients, response):
        """Give the first and second derivative of the basis at fixed weights, and how the
        coefficients follow if nothing is left."""
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
        """Give `r^2 / 2v`."""
        shape = (*self.squared_radii.shape, *log_variances.shape)
        variances = jnp.broadcast_to(self.variances(log_variances), shape)
        return 0.5 * jnp.broadcast_to(self.squared_radii[..., None], shape) / variances

    def _energies(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """The weight of a Gaussian of unit norm: the integral of r G(v, r)^2 is 1 / (8 pi^2 v)."""
        return jnp.sqrt(8 * jnp.pi**2 * variances)


def make_problem(
    profile: AbstractProfile, weights: AbstractWeights, rule: AbstractRadialRule
) -> Problem:
    """State the fit of all channels of a profile."""
    r, dr = norm_radii(profile, rule)
    values = at_own_radii(profile, r)
    norm = jnp.sqrt(jnp.sum(dr * r * values * values, axis=0))
    root_weights = jnp.sqrt(dr * r)
    scale = jax.lax.stop_gradient(profile.length_scale())
    return Problem(
        squared_radii=(r * r).T,
        root_weights=root_weights.T,
        target=(root_weights * values / jnp.broadcast_to(norm, values.shape)).T,
        norm=norm,
        total=profile.total_reflectance(),
        unit=jnp.exp(jnp.mean(jnp.log(scale))),
        weights=weights,
    )
