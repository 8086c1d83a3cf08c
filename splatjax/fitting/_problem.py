"""The fit as a function of the logarithms of the variances alone: the weights are solved inside (variable projection)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax.gaussians import AbstractProfile, gaussian
from splatjax.scattering import RadialRule, at_own_radii

from ._errors import norm_radii
from ._weights import AbstractWeights, without_idle


class Problem(eqx.Module):
    r"""Eq. 3 of all channels that share their variances, each divided by its norm, at the nodes of a radial rule.

    Variances are counted in the square of one length, `unit`, so that nothing depends on the unit of length.
    Differentiable in `target` and `total`; nodes and units are constants.
    """

    squared_radii: Float[Array, "channels nodes"]
    root_weights: Float[Array, "channels nodes"]
    target: Float[Array, "channels nodes"]
    norm: Float[Array, " channels"]
    total: Float[Array, " channels"]
    unit: Float[Array, ""]
    weights: AbstractWeights

    def variances(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Give the variances, mm^2."""
        return jnp.exp(log_variances) * self.unit * self.unit

    def basis(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, "channels nodes gaussians"]:
        """Give the Gaussians at the nodes, each scaled to a unit norm (in closed form)."""
        variances = self.variances(log_variances)
        shape = (*self.squared_radii.shape, *variances.shape)
        values = gaussian(jnp.broadcast_to(variances, shape), jnp.broadcast_to(self.squared_radii[..., None], shape))
        return values * jnp.broadcast_to(self._energies(variances), shape) * self.root_weights[..., None]

    def coefficients(
        self, log_variances: Float[Array, " gaussians"], active: Bool[Array, " gaussians"] | None = None
    ) -> tuple[Float[Array, "channels nodes gaussians"], Float[Array, "channels gaussians"]]:
        """Give the basis and each channel's best coefficients. Gaussians that are not active count for nothing."""
        basis = self.basis(log_variances)
        energies = self._energies(self.variances(log_variances))
        everything = jnp.ones(energies.shape, bool) if active is None else active

        def solve(rows, target, total):
            problem = (rows, target, energies) if active is None else without_idle(rows, target, energies, everything)
            return self.weights.solve(*problem, total)

        basis = jnp.where(jnp.broadcast_to(everything, basis.shape), basis, jnp.zeros_like(basis))
        return basis, jax.vmap(solve)(basis, self.target, self.total / self.norm)

    def residuals(
        self, log_variances: Float[Array, " gaussians"], active: Bool[Array, " gaussians"] | None = None
    ) -> Float[Array, "channels nodes"]:
        """Give what the best weights leave; the sum of squares of a channel is the square of its Eq. 4."""
        basis, coefficients = self.coefficients(log_variances, active)
        return self.target - jnp.einsum("cnk,ck->cn", basis, coefficients)

    def gradient(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """Give the gradient of the sum of squared residuals: the best weights count as constants in it (envelope theorem)."""
        _, coefficients = self.coefficients(log_variances)
        energies = self._energies(self.variances(log_variances))

        def squared(moved):
            # The weights stay; the coefficients of the scaled Gaussians do not.
            ratio = jnp.broadcast_to(energies / self._energies(self.variances(moved)), coefficients.shape)
            residuals = self.target - jnp.einsum("cnk,ck->cn", self.basis(moved), coefficients * ratio)
            return jnp.sum(residuals * residuals)

        return jax.grad(squared)(log_variances)

    def energies(self, log_variances: Float[Array, " gaussians"]) -> Float[Array, "gaussians channels"]:
        """Give the best weights."""
        _, coefficients = self.coefficients(log_variances)
        scale = jnp.broadcast_to(self._energies(self.variances(log_variances)), coefficients.shape)
        return (coefficients * scale * jnp.broadcast_to(self.norm[:, None], scale.shape)).T

    def _energies(self, variances: Float[Array, " gaussians"]) -> Float[Array, " gaussians"]:
        """The weight of a Gaussian of unit norm: the integral of r G(v, r)^2 is 1 / (8 pi^2 v)."""
        return jnp.sqrt(8 * jnp.pi**2 * variances)


def make_problem(profile: AbstractProfile, weights: AbstractWeights, rule: RadialRule) -> Problem:
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
