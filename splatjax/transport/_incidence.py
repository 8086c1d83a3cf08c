"""How light arrives at the surface."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scattering import moment_outside

from ._interface import fresnel
from ._phase import Direction, on_circle


class AbstractIncidence(eqx.Module):
    """A narrow beam's directions, as they are inside the surface. Powers count what enters."""

    @abc.abstractmethod
    def enter(
        self,
        xi_cosine: Float[Array, " photons"],
        xi_angle: Float[Array, " photons"],
        eta: Float[Array, " two"],
    ) -> tuple[Direction, Float[Array, " photons"]]:
        """Draw directions inside and weights, of mean 1, by uniform numbers and the indices outside
        and inside.
        """

    @abc.abstractmethod
    def reflected(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute the fraction of the arriving power that does not enter, by the index inside over
        outside.
        """


class NormalIncidence(AbstractIncidence):
    """Along the normal."""

    def enter(self, xi_cosine, xi_angle, eta):
        zero, one = jnp.zeros_like(xi_cosine), jnp.ones_like(xi_cosine)
        return (zero, zero, one), one

    def reflected(self, eta):
        return ((eta - 1) / (eta + 1)) ** 2


class DiffuseIncidence(AbstractIncidence):
    """From all directions above, equally bright: a white sky."""

    def enter(self, xi_cosine, xi_angle, eta):
        outside, inside = (jnp.broadcast_to(each, xi_cosine.shape) for each in eta)
        reflectance, cosine = fresnel(jnp.sqrt(xi_cosine), outside, inside)
        sine = jnp.sqrt(jnp.maximum(1 - cosine * cosine, 0.0))
        weight = (1 - reflectance) / jnp.broadcast_to(
            1 - self.reflected(eta[1:] / eta[:1])[0], xi_cosine.shape
        )
        x, y = on_circle(xi_angle)
        return (sine * x, sine * y, cosine), weight

    def reflected(self, eta):
        """Compute twice the integral of `mu F(mu)` over the cosine outside."""
        return jnp.where(eta < 1, 1 - (1 - moment_outside(eta)) * eta * eta, moment_outside(eta))
