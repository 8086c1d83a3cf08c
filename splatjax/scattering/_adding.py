"""How layers reflect and transmit, frequency by frequency, and how two become one."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._fresnel import AbstractFresnel
from ._medium import Film, Layer
from ._quadrature import unit_interval


class Response(eqx.Module):
    """Reflectance and transmittance of a stack of layers in the Hankel domain, for light from above
    and from below.
    """

    reflectance_above: Float[Array, "*shape"]
    transmittance_down: Float[Array, "*shape"]
    reflectance_below: Float[Array, "*shape"]
    transmittance_up: Float[Array, "*shape"]

    def over(self, lower: "Response") -> "Response":
        """Lay this on another: the geometric series of reflections between them is summed.

        **Source:** Donner and Jensen 2005 (adding, after Kubelka).
        """
        between = 1 / (1 - self.reflectance_below * lower.reflectance_above)
        reflected_once = self.transmittance_down * lower.reflectance_above * self.transmittance_up
        returned_once = lower.transmittance_up * self.reflectance_below * lower.transmittance_down
        return Response(
            self.reflectance_above + reflected_once * between,
            self.transmittance_down * lower.transmittance_down * between,
            lower.reflectance_below + returned_once * between,
            lower.transmittance_up * self.transmittance_up * between,
        )


def film_response(film: Film, lit_by_beam: bool, shape: tuple[int, ...]) -> Response:
    """Compute the response of a film; `lit_by_beam` where no layer above has scattered the light
    that comes down.
    """
    depth = jnp.broadcast_to(film.optical_depth, shape)
    diffuse = diffuse_transmittance(depth)
    none = jnp.zeros(shape, depth.dtype)
    return Response(none, jnp.exp(-depth) if lit_by_beam else diffuse, none, diffuse)


def diffuse_transmittance(optical_depth: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Compute `2 E3(t)`, the integral of `2 mu exp(-t / mu)` over the cosine: 1 at t = 0, with the
    derivative -2.
    """
    mu, _, weights = (
        jnp.asarray(each, optical_depth.dtype).reshape(-1, *[1] * optical_depth.ndim)
        for each in unit_interval()
    )
    return jnp.sum(2 * weights * mu * jnp.exp(-optical_depth[None] / mu), axis=0)


def slab_response(
    layer: Layer,
    eta_above: Float[Array, " channels"],
    eta_below: Float[Array, " channels"],
    fresnel: AbstractFresnel,
    k: Float[Array, "*shape"],
) -> Response:
    r"""Compute the response of a slab: the infinite series of Donner and Jensen's multipole,
    summed.

    With `s^2 = sigma_tr^2 + k^2`, `l = 1 / sigma_t'`, extrapolated boundaries `z_a` above and `z_b`
    below, and `H = d + z_a + z_b`,

        R(k) = alpha' sinh(s (d - l + z_b)) cosh(s z_a) / sinh(s H),
        T(k) = alpha' sinh(s (l + z_a)) cosh(s z_b) / sinh(s H),

    and the same with z_a and z_b exchanged from below. NaN for a slab thinner than l.

    **Arguments:**

    - `eta_above`, `eta_below`: indices of the neighbors relative to air.
    - `fresnel`: the diffuse Fresnel moments of either side.
    - `k`: 1/mm, at least 0; the last axis is the channels.

    **Source:** image positions: Donner and Jensen 2005; the sum is our own.
    """
    medium = layer.medium
    depth = 1 / medium.sigma_t_prime
    thickness = jnp.where(layer.thickness >= (1 - 1e-6) * depth, layer.thickness, jnp.nan)
    above, below = (
        2 / 3 * fresnel.boundary(medium.eta / eta) * depth for eta in (eta_above, eta_below)
    )
    lengths = depth, above, below, thickness - depth, thickness + above + below
    albedo, squared_sigma_tr, depth, above, below, beneath, height = (
        jnp.broadcast_to(each, k.shape)
        for each in (medium.albedo_prime, medium.squared_sigma_tr, *lengths)
    )
    u = squared_sigma_tr + k * k

    def part(wave, across, fall):
        return albedo * hyperbolic_ratio(u, wave, across, fall, height)

    return Response(
        part(beneath + below, above, depth),
        part(depth + above, below, beneath),
        part(beneath + above, below, depth),
        part(depth + below, above, beneath),
    )


_SMALL = 0.05**2  # of (s H)^2: below, a series in it leaves 1e-16


def hyperbolic_ratio(
    u: Float[Array, "..."],
    a: Float[Array, "..."],
    b: Float[Array, "..."],
    fall: Float[Array, "..."],
    height: Float[Array, "..."],
) -> Float[Array, "..."]:
    r"""Compute `sinh(s a) cosh(s b) / sinh(s height)` with `s = sqrt(u)`, where `height = a + b +
    fall` and nothing is negative.

    An even function of s, hence smooth in u for a finite height: a series about `u = 0` keeps its
    derivatives. `a` and `height` may be infinite together; then it is `exp(-s fall) (1 + exp(-2 s
    b)) / 2`. So may `fall` and `height`; then it is 0.
    """
    finite = ~jnp.isinf(height)  # NaN is to stay
    reach = jnp.where(finite, height, 1.0)
    small = finite & (u * reach * reach < _SMALL)
    width = jnp.where(finite, a, 1.0)
    # Near 0, as a sum of logarithms of sinh(x) / x and of cosh(x).
    v = jnp.where(small, u, 0.0)
    y = v * b * b
    log_cosh = y * (1 / 2 - y * (1 / 12 - y * (1 / 45 - y * (17 / 2520))))
    log_sinhs = _log_sinhc(v * width * width) - _log_sinhc(v * reach * reach)
    series = width / reach * jnp.exp(log_sinhs + log_cosh)
    s = jnp.sqrt(jnp.where(small, 1 / (reach * reach), u))
    upper = jnp.where(finite, -jnp.expm1(-2 * s * width), 1.0)
    lower = jnp.where(finite, -jnp.expm1(-2 * s * reach), 1.0)
    endless = jnp.isinf(fall)
    fallen = jnp.where(endless, 0.0, jnp.exp(-s * jnp.where(endless, 0.0, fall)))
    direct = 0.5 * (1 + jnp.exp(-2 * s * b)) * fallen * upper / lower
    return jnp.where(small, series, direct)


def _log_sinhc(y):
    """`log(sinh(x) / x)` for small `y = x^2`."""
    return y * (1 / 6 - y * (1 / 180 - y * (1 / 2835 - y / 37800)))
