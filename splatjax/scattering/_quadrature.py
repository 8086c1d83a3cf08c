"""Radial quadrature of profiles, and the inverse Hankel transform by a digital filter."""

import abc
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # submodules load on first use, which takes a third of a second
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax.gaussians import AbstractProfile


class AbstractRadialRule(eqx.Module):
    """Nodes and weights for integrals over r."""

    @abc.abstractmethod
    def radii(
        self, profile: AbstractProfile
    ) -> tuple[Float[Array, "nodes channels"], Float[Array, "nodes channels"]]:
        """Compute the radii and weights `dr` for each channel, mm."""

    @property
    @abc.abstractmethod
    def reaches_origin(self) -> bool:
        """Whether the integral starts at r = 0, where some profiles are infinite."""


class RadialRule(AbstractRadialRule):
    r"""Nodes and weights for integrals over r in [0, inf), in units of a profile's
    `length_scale()`.

    The rule has one Gauss-Legendre panel in log r from `smallest` to `largest`, and a linear one
    from 0 to `smallest`. Equally spaced radii are unsuitable, because a profile varies over five
    decades of r.

    **Attributes:**

    - `smallest`, `largest`: ends of the logarithmic panel, in length scales.
    - `count`: number of nodes of the logarithmic panel.
    - `near`: number of nodes of the linear panel; 0 omits it.
    - `tail`: exponent of an additional power of r in the weights, for a better fit at large
      distances; 0 is Eq. 3.
    """

    smallest: float = eqx.field(static=True)
    largest: float = eqx.field(static=True)
    count: int = eqx.field(static=True)
    near: int = eqx.field(static=True, default=8)
    tail: float = eqx.field(static=True, default=0.0)

    def beyond(self, cut: float, tail: float = 0.0) -> "RadialRule":
        """Return the rule that starts at `cut` length scales. Use it for profiles that are infinite
        or unknown at the origin, and to leave out radii that splats do not resolve.

        **Raises:** `ValueError` unless `cut` is between 0 and the largest radius.
        """
        if not 0 < cut < self.largest:
            raise ValueError(f"cut must be between 0 and {self.largest} length scales; got {cut}")
        return RadialRule(float(cut), self.largest, self.count, near=0, tail=float(tail))

    @property
    def reaches_origin(self) -> bool:
        return self.near > 0

    @jit_unless_traced
    def radii(
        self, profile: AbstractProfile
    ) -> tuple[Float[Array, "nodes channels"], Float[Array, "nodes channels"]]:
        """Compute the radii and weights for each channel, mm. Differentiable. A measured profile
        has its own radii; radii outside the range of the rule have weight 0.
        """
        scale = profile.length_scale()
        measured = jax.lax.stop_gradient(profile.known_radii())
        nodes = measured or _nodes(self.smallest, self.largest, self.count, self.near)
        shape = (*nodes[0].shape, *scale.shape)
        radii, weights = (
            jnp.broadcast_to(jnp.asarray(values, scale.dtype)[:, None], shape) for values in nodes
        )
        scale = jnp.broadcast_to(scale, shape)
        if measured is None:
            return radii * scale, weights * scale * radii**self.tail
        first = 0.0 if self.near else self.smallest
        inside = (radii >= first * scale) & (radii <= self.largest * scale)
        return radii, jnp.where(inside, weights * (radii / scale) ** self.tail, 0.0)


L2_QUADRATURE = RadialRule(smallest=1e-3, largest=1e4, count=192)
"""The rule for integrals of `r R^2` (Eq. 3 and Eq. 4). For a medium without absorption, the
neglected tail is 1e-16 of the integral.

An accurate squared error of a fit needs many nodes: at an error of 1e-5, 128 nodes are wrong by a
tenth, 192 nodes by 1e-7.
"""

L1_QUADRATURE = RadialRule(smallest=1e-3, largest=1e7, count=256)
"""The rule for integrals of `r R`, which have long tails. Without absorption the tail falls like
1/r, and 1e-7 of the integral is neglected.
"""


class InverseVariance(AbstractRadialRule):
    r"""The radii of a table, weighted by their standard errors: an integral of `r f(r)^2` becomes
    the sum of `f^2 / deviation^2`.

    A fit with this rule minimizes chi-squared, and its `error` is `sqrt(chi_squared / sum((R /
    deviation)^2))`. Radii with a standard error of 0, where no photon arrived, are omitted.

    **Attributes:**

    - `among`: a rule whose range selects radii: all by default; `L2_QUADRATURE.beyond(1.0)` omits
      radii below one length scale.

    **Raises:** `ValueError` from `radii` for a profile without `deviation`.
    """

    among: RadialRule = L2_QUADRATURE

    @property
    def reaches_origin(self) -> bool:
        return self.among.reaches_origin

    def radii(self, profile):
        deviation = getattr(profile, "deviation", None)
        if deviation is None:
            raise ValueError(
                f"{type(profile).__name__} has no standard errors to weight by; use "
                "Tabulated(radii, values, deviation) or monte_carlo(...).profile()"
            )
        r, dr = self.among.radii(profile)
        usable = (dr > 0) & (deviation > 0) & (r > 0)
        return r, jnp.where(usable, 1 / jnp.where(usable, deviation * deviation * r, 1.0), 0.0)


@functools.cache
def _nodes(smallest: float, largest: float, count: int, near: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute radii and weights `dr`, in length scales, ascending."""
    near_nodes, near_weights = unit_legendre(near) if near else np.zeros((2, 0))
    log_nodes, log_weights = unit_legendre(count)
    length = np.log(largest / smallest)
    radii = smallest * np.exp(length * log_nodes)
    nodes = np.concatenate([smallest * near_nodes, radii])
    return nodes, np.concatenate([smallest * near_weights, length * radii * log_weights])


@functools.cache
def unit_interval() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute nodes x of the interval (0, 1), `1 - x` without cancellation, and weights, for
    integrands that are not smooth at the ends.

    This is Takahasi and Mori's double exponential formula; for analytic integrands the error is
    about 1e-15.
    """
    t, step = np.linspace(-3.1, 3.1, 81, retstep=True)
    u = 0.5 * np.pi * np.sinh(t)
    x, beyond = 1 / (1 + np.exp(-2 * u)), 1 / (1 + np.exp(2 * u))
    return x, beyond, step * np.pi * np.cosh(t) * x * beyond


def at_own_radii(
    profile: AbstractProfile, r: Float[Array, "nodes channels"]
) -> Float[Array, "nodes channels"]:
    """Compute each channel of a profile at its own radii (mm), in 1/mm^2."""
    if not profile.has_separate_channels:
        return jnp.diagonal(profile(r), axis1=1, axis2=2)

    def channel(profile: AbstractProfile, r: Float[Array, " nodes"]):
        return jax.tree.map(lambda leaf: leaf[None], profile)(r)[:, 0]

    return jax.vmap(channel, in_axes=(0, 1), out_axes=1)(profile, r)


@jit_unless_traced
def integrated_reflectance(
    profile: AbstractProfile, rule: RadialRule = L1_QUADRATURE
) -> Float[Array, " channels"]:
    r"""Integrate `2 pi r R(r)` numerically, without the closed form of
    `profile.total_reflectance()`.

    **Arguments:**

    - `profile`: Differentiable.
    - `rule`: the nodes; the integral ends at the largest radius of the rule.

    **Returns:** the fraction of the entering power that leaves, [channels].
    """
    r, dr = rule.radii(profile)
    return 2 * jnp.pi * jnp.sum(dr * r * at_own_radii(profile, r), axis=0)


@functools.cache
def unit_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the Gauss-Legendre nodes of the interval (0, 1) and weights that sum to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (nodes + 1), 0.5 * weights


def along_first_axis(values: np.ndarray, shape: tuple[int, ...], dtype) -> Float[Array, "..."]:
    """Broadcast constants along the first axis of a shape."""
    return jnp.broadcast_to(jnp.asarray(values, dtype).reshape(-1, *[1] * (len(shape) - 1)), shape)


# The filter of the inverse Hankel transform.
_STEP = 0.06  # of the logarithm: the Nyquist frequency is 52
_PASSED = (
    22.0  # frequency up to which nothing is damped: exp(-pi/2 * 22) = 1e-15 bounds what lies above
)
_FIRST, _LAST = -20.0, 8.0  # logarithms of the abscissas
_NEAR = 0.05  # radius, in units of `decay`, below which a series about the origin is used
_TERMS = 8  # of that series; the ratio of successive terms is below 0.0025
_NEAR_NODES = 120


def inverse_hankel_transform(
    transform: Callable[[Float[Array, "..."]], Float[Array, "..."]],
    r: Float[Array, "*radii"],
    decay: Float[Array, " channels"],
) -> Float[Array, "*radii channels"]:
    r"""Compute `1 / 2 pi` times the integral of `k J0(k r) F(k)`, without an oscillating integral
    or a Bessel function.

    In the logarithm of the radius the transform is a convolution. The Mellin transform of the
    kernel has modulus 1 and `F` is analytic in a strip, so sampling both at equal steps of the
    logarithm causes only rounding errors. The result is a plain, differentiable sum over samples of
    `F`.

    **Arguments:**

    - `transform`: computes `F` from `k` (1/mm), in the same shape; the last axis holds the
      channels. `F` must fall at least like `exp(-decay k)`.
    - `r`: mm, at least 0. Differentiable, at 0 too.
    - `decay`: mm, positive; it places the nodes near the origin. Not differentiated.

    **Returns:** 1/mm^2. The error is about 1e-15 of the value at `r = 0` or, farther out, of `1 /
    (decay r)`; a tail below that is rounding.

    **Source:** Johansen and Soerensen 1979, "Fast Hankel transforms"; the filter is our own.
    """
    decay = jax.lax.stop_gradient(decay)
    shape = (*r.shape, *decay.shape)
    radius, scale = jnp.broadcast_to(r[..., None], shape), jnp.broadcast_to(decay, shape)
    near = radius < _NEAR * scale
    # Far from the axis: the integral of x J0(x) F(x / r), over r^2.
    at = jnp.where(near, scale, radius)
    abscissas, weights = (
        along_first_axis(values, (len(values), *shape), at.dtype) for values in _filter()
    )
    x = abscissas / at[None]
    far = jnp.sum(weights * x * transform(x), axis=0) / at
    # Near the axis: a series in (r / 2 decay)^2, whose coefficients are moments of F.
    nodes, moments = (jnp.asarray(values, decay.dtype) for values in _half_line())
    terms = transform(nodes[:, None] / decay[None]) / (decay * decay)[None]
    coefficients = jnp.sum(moments[..., None] * terms[None], axis=1)
    squared = jnp.where(near, 0.25 * radius * radius / (scale * scale), 0.0)
    about_origin = jnp.polyval(
        coefficients.reshape(_TERMS, *[1] * r.ndim, *decay.shape), squared, unroll=_TERMS
    )
    return jnp.where(near, about_origin, far) / (2 * jnp.pi)


@functools.cache
def _filter() -> tuple[np.ndarray, np.ndarray]:
    """Compute abscissas `x` and weights `w` such that the sum of `w x f(x)` is the integral of `x
    J0(x) f(x)`.

    With `u = log x` the kernel `exp(u) J0(exp(u))` has the Fourier transform `2^(i w) Gamma((1 + i
    w)/2) / Gamma((1 - i w)/2)`.
    """
    nyquist = np.pi / _STEP
    frequency = np.linspace(-nyquist, nyquist, 8001)
    width = (nyquist - _PASSED) / 12
    taper = 0.5 * scipy.special.erfc((np.abs(frequency) - 0.5 * (nyquist + _PASSED)) / width)
    half = 0.5 + 0.5j * frequency
    response = np.exp(
        1j * frequency * np.log(2)
        + scipy.special.loggamma(half)
        - scipy.special.loggamma(half.conj())
    )
    logarithms = np.arange(round(_FIRST / _STEP), round(_LAST / _STEP) + 1) * _STEP
    waves = np.exp(-1j * logarithms[:, None] * frequency)
    weights = np.trapezoid(taper * response * waves, frequency, axis=1).real * _STEP / (2 * np.pi)
    return np.exp(logarithms), weights


@functools.cache
def _half_line() -> tuple[np.ndarray, np.ndarray]:
    """Compute nodes for integrals over k > 0 of functions like `exp(-k)`, with `log k = t -
    exp(-t)` at equal steps of t; and weights of `k J0(2 k x)` in powers of `x^2`, the highest
    first: [powers, nodes].
    """
    t, step = np.linspace(-2.6, 3.65, _NEAR_NODES, retstep=True)
    nodes = np.exp(t - np.exp(-t))
    power = np.arange(_TERMS)[::-1, None]
    bessel = (-1.0) ** power * nodes ** (2 * power) / scipy.special.factorial(power) ** 2
    return nodes, bessel * step * nodes * nodes * (1 + np.exp(-t))
