"""The Fresnel reflectance, its diffuse moments met from inside, and what diffusion makes of
them.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced

from ._quadrature import along_first_axis, unit_legendre

_POINTS = 48
"""Gauss-Legendre points: the integrands are smooth on the whole interval, and 48 reach float64
rounding up to eta = 4.
"""


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

    The integral over the cosine outside, `mu_o`, is taken in `s = r_s`, the reflection coefficient
    of the wave polarized across the plane of incidence: then `mu_o^2 = (eta^2 - 1)(1 - s)^2 / 4s`
    and `r_p = (s - b) / (1 - b s)` with `b = (eta^2 - 1) / (eta^2 + 1)`, so that the layer that
    grows infinitely thin as `eta` goes to 1 is integrated in closed form.
    """

    @jit_unless_traced
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        ratio = _denser_over_rarer(eta)
        outside = _first_outside(ratio)
        return jnp.where(eta < 1, outside, 1 + (outside - 1) / (ratio * ratio))

    @jit_unless_traced
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        ratio = _denser_over_rarer(eta)
        cube = ratio * ratio * ratio
        beyond_critical, inside = _second(ratio, sign=1.0)
        _, outside = _second(ratio, sign=-1.0)
        return jnp.where(eta < 1, outside, (beyond_critical + inside) / cube)


class EganFresnel(AbstractFresnel):
    r"""The polynomial fits that published profiles were computed with.

    The first moment is that of Egan and Hilgeman as Donner and Jensen print it, the second that of
    d'Eon and Irving. Made for `eta` between about 0.5 and 2. Differentiable except at `eta = 1`,
    where the fits step by 0.0017; there the moments are set to 0, so that A = 1.

    **Source:** Egan and Hilgeman 1979; Donner and Jensen 2005; d'Eon and Irving 2011.
    """

    @jit_unless_traced
    def first_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        inverse = 1 / eta
        above = _polynomial(inverse, (0.6681, 0.7099, -1.4399)) + 0.0636 * eta
        below = _polynomial(inverse, (-0.4399, 0.7099, -0.3319, 0.0636))
        return jnp.where(eta == 1, jnp.zeros_like(eta), jnp.where(eta < 1, below, above))

    @jit_unless_traced
    def second_moment(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        above = _polynomial(1 / eta, (-1641.1, 1376.53, -656.175, 135.926))
        above = above + eta * _polynomial(eta, (1213.67, -568.556, 164.798, -27.0181, 1.91826))
        below = _polynomial(eta, (0.828421, -2.62051, 3.36231, -1.95284, 0.236494, 0.145787))
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


def _polynomial(
    x: Float[Array, " channels"], coefficients: tuple[float, ...]
) -> Float[Array, " channels"]:
    total = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = total * x + coefficient
    return total


def _denser_over_rarer(eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """The index of the denser side over that of the rarer; its derivative at 1 is the one from
    above.
    """
    rarer_inside = eta < 1
    return jnp.where(rarer_inside, 1 / jnp.where(rarer_inside, eta, jnp.ones_like(eta)), eta)


def _integral(integrand, lower: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Integrate `integrand(t)` from `lower` to 1; it is given [points, channels]."""
    nodes, weights = (
        along_first_axis(each, (_POINTS, *lower.shape), lower.dtype)
        for each in unit_legendre(_POINTS)
    )
    length = jnp.broadcast_to((1 - lower)[None], nodes.shape)
    return jnp.sum(weights * length * integrand(1 - length * (1 - nodes)), axis=0)


def moment_outside(eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Compute twice the integral of `mu F(mu)` over the cosine on the rarer side of the interface;
    nothing is reflected totally.
    """
    return _first_outside(_denser_over_rarer(eta))


def _first_outside(ratio: Float[Array, " channels"]) -> Float[Array, " channels"]:
    """Twice the integral of `mu_o F` over the cosine on the rarer side, for `ratio >= 1`."""
    s0 = (ratio - 1) / (ratio + 1)
    b = 2 * s0 / (1 + s0 * s0)
    # b log(s0), of which value times (ratio^2 - 1) and its derivative vanish at s0 = 0, as does
    # what stands here.
    b_log = b * jnp.log(jnp.where(s0 > 0, s0, jnp.ones_like(s0)))
    across = (1 - s0) - (1 - s0 * s0 * s0) / 3

    def smooth(s):
        b_ = jnp.broadcast_to(b[None], s.shape)
        squared = b_ * b_
        numerator = (
            (1 - s * s)
            - 2 * b_ * (2 * b_ - s * (1 + squared))
            + squared * (3 * squared - 1 - 2 * b_ * squared * s)
        )
        return numerator / ((1 - b_ * s) * (1 - b_ * s))

    # b^2 / s0 written without its quotient.
    along = _integral(smooth, s0) + 2 * b_log * (1 - b * b) + b * (2 / (1 + s0 * s0) - b)
    return s0 / (2 * (1 - s0) * (1 - s0)) * (across + along)


def _second(
    ratio: Float[Array, " channels"], *, sign: float
) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
    """Three times the integral of `F q mu_o` over `mu_o`, for `ratio >= 1`, where `q^2 = mu_o^2 +
    (ratio^2 - 1)(1 + sign) / 2`.

    Beside it, `(ratio^2 - 1)^(3/2)`: what total internal reflection adds. Both and their
    derivatives vanish at `ratio = 1`.
    """
    s0 = (ratio - 1) / (ratio + 1)
    tiny = jnp.full_like(s0, jnp.finfo(s0.dtype).tiny)
    s0 = jnp.where(s0 > tiny, s0, tiny)
    t0 = jnp.sqrt(s0)
    b = 2 * s0 / (1 + s0 * s0)
    b_over_s0 = 2 / (1 + s0 * s0)
    c = 2 * t0 / (1 - s0)
    cube = c * c * c
    # h(p) = (1 - p^2)(1 + sign p) / (1 - b p)^2 with p = t^2, and its first two terms, 1 + h1 p.
    h1 = sign + 2 * b

    def across(t):
        p = t * t
        return (1 - p * p) * (1 + sign * p)

    def along(t):
        p = t * t
        b_ = jnp.broadcast_to(b[None], t.shape)
        squared = b_ * b_
        below = (1 - b_ * p) * (1 - b_ * p)
        # (h - 1) / p and (h - 1 - h1 p) / p^2, expanded so that nothing cancels.
        first = (sign + 2 * b_ - p * (1 + squared) - sign * p * p) / below
        second = (
            -1 - squared + 2 * b_ * (sign + 2 * b_) - p * (sign + squared * (sign + 2 * b_))
        ) / below
        return across(t) / below - 2 * b_ * first + squared * second

    # The integrals of 1/t^2 and 1/t^4 from t0 to 1, times 2b and b^2: b / t0 = (b / s0) t0.
    thin = -2 * (b_over_s0 * t0 - b)
    thin = thin + (b_over_s0 * b_over_s0 * t0 - b * b) / 3 + h1 * b * (b_over_s0 * t0 - b)
    return cube, 3 / 8 * cube * 0.5 * (_integral(across, t0) + _integral(along, t0) + thin)
