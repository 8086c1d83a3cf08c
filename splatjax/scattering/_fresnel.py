"""The Fresnel reflectance, its diffuse moments from inside, and the boundary of diffusion."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced

from ._quadrature import unit_interval


class AbstractFresnel(eqx.Module):
    r"""The reflectance of a smooth interface for diffuse light from inside.

    With `F(mu)` the internal reflectance, total internal reflection included, and `eta` the index
    inside over outside.
    """

    @abc.abstractmethod
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute `2 C1`, twice the integral of `mu F(mu)` over [0, 1]: the diffuse reflectance
        Fdr, in [0, 1).
        """

    @abc.abstractmethod
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute `3 C2`, three times the integral of `mu^2 F(mu)` over [0, 1], in [0, 1)."""

    def boundary(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        r"""Compute the boundary parameter `A = (1 + Fdr) / (1 - Fdr)` of the diffusion
        approximation; 1 at `eta = 1`.

        **Source:** Jensen et al. 2001, section 2.1.
        """
        reflectance = self.first_moment(eta)
        return (1 + reflectance) / (1 - reflectance)


class ExactFresnel(AbstractFresnel):
    r"""The moments as exact integrals, split at the critical angle.

    Differentiable in `eta`. At `eta = 1` the moments are 0 and have a kink; the derivative there is
    the limit from above (7/3 for the first moment; from below it is -1/3).

    The integral over the cosine outside, `mu_o`, is computed in `s = r_s`, the reflection
    coefficient of the wave polarized across the plane of incidence: then `mu_o^2 = (eta^2 - 1)(1 -
    s)^2 / 4s` and `r_p = (s - b) / (1 - b s)` with `b = (eta^2 - 1) / (eta^2 + 1)`, so that a power
    of `eta^2 - 1` multiplies an integral that is finite at `eta = 1`.
    """

    @jit_unless_traced
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        ratio, outside = _denser_over_rarer(eta), moment_outside(eta)
        return jnp.where(eta < 1, outside, 1 + (outside - 1) / (ratio * ratio))

    @jit_unless_traced
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        ratio = _denser_over_rarer(eta)
        beyond_critical = (ratio * ratio - 1) ** 1.5
        # The cosine inside is sqrt(eta^2 - 1)(1 + s) / (2 eta sqrt(s)).
        sign = jnp.where(eta < 1, -1.0, 1.0)[None]
        integral = _over_reflections(ratio, lambda s: (1 + sign * s) / jnp.sqrt(s))
        transmitting = 3 / 32 * beyond_critical * integral
        return jnp.where(
            eta < 1, transmitting, (beyond_critical + transmitting) / (ratio * ratio * ratio)
        )


class EganFresnel(AbstractFresnel):
    r"""The polynomial fits with which published profiles were computed.

    The first moment is that of Egan and Hilgeman as Donner and Jensen print it, the second that of
    d'Eon and Irving. They are valid for `eta` between about 0.5 and 2. Differentiable except at
    `eta = 1`, where the fits step by 0.0017; there the moments are set to 0, so that A = 1.

    **Source:** Egan and Hilgeman 1979; Donner and Jensen 2005; d'Eon and Irving 2011.
    """

    @jit_unless_traced
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        inverse = 1 / eta
        above = _polynomial(inverse, -1.4399, 0.7099, 0.6681) + 0.0636 * eta
        below = _polynomial(inverse, 0.0636, -0.3319, 0.7099, -0.4399)
        return jnp.where(eta == 1, jnp.zeros_like(eta), jnp.where(eta < 1, below, above))

    @jit_unless_traced
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        above = _polynomial(1 / eta, 135.926, -656.175, 1376.53, -1641.1)
        above = above + eta * _polynomial(eta, 1.91826, -27.0181, 164.798, -568.556, 1213.67)
        below = _polynomial(eta, 0.145787, 0.236494, -1.95284, 3.36231, -2.62051, 0.828421)
        return jnp.where(eta == 1, jnp.zeros_like(eta), jnp.where(eta < 1, below, above))


def reflectance(
    inside: Float[Array, "*shape"], outside: Float[Array, "*shape"], eta: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Compute the reflectance for unpolarized light from its cosines on either side of a smooth
    interface, from either side.
    """
    across = (eta * inside - outside) / (eta * inside + outside)
    along = (inside - eta * outside) / (inside + eta * outside)
    return 0.5 * (across * across + along * along)


def _polynomial(x: Float[Array, " channels"], *coefficients: float) -> Float[Array, " channels"]:
    return jnp.polyval(jnp.asarray(coefficients, x.dtype), x)


def moment_outside(eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Compute twice the integral of `mu F(mu)` over the cosine on the rarer side of the interface,
    where there is no total reflection.
    """
    ratio = _denser_over_rarer(eta)
    return (ratio * ratio - 1) / 8 * _over_reflections(ratio, jnp.ones_like)


def _denser_over_rarer(eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Return the index of the denser over the rarer side; at 1 the derivative is from above."""
    rarer_inside = eta < 1
    return jnp.where(rarer_inside, 1 / jnp.where(rarer_inside, eta, jnp.ones_like(eta)), eta)


def _over_reflections(ratio: Float[Array, " channels"], factor) -> Float[Array, " channels"]:
    """Integrate `(1 - s^2)(1 + (r_p / s)^2) factor(s)` from `s = (ratio - 1) / (ratio + 1)`, light
    along the normal, to 1: the reflectance, `factor` and `16 mu_o dmu_o / (ratio^2 - 1)`.
    """
    normal = ((ratio - 1) / (ratio + 1))[None]
    b = 2 * normal / (1 + normal * normal)
    x, _, weights = (jnp.asarray(each, ratio.dtype)[:, None] for each in unit_interval())
    s = normal + (1 - normal) * x
    along = (s - b) / (s * (1 - b * s))
    integrand = (1 - normal) * (1 - s * s) * (1 + along * along) * factor(s)
    return jnp.sum(weights * integrand, axis=0)
