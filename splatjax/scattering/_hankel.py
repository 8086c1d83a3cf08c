r"""The inverse Hankel transform of order 0 by a digital filter: no oscillating integral, no Bessel
function.

In the logarithm of the radius the transform is a convolution. The Mellin transform of the kernel
has modulus 1, and the transformed function is analytic in a strip, so that sampling both at equal
steps of the logarithm leaves errors of rounding only: about 1e-15 of the largest value, whatever
the shape. The result is a plain sum over samples of the function, which differentiates.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Array, Float

from ._quadrature import along_first_axis

_STEP = 0.06  # of the logarithm: the Nyquist frequency is 52
_PASSED = (
    22.0  # frequency up to which nothing is damped: exp(-pi/2 * 22) = 1e-15 bounds what lies above
)
_FIRST, _LAST = -20.0, 8.0  # logarithms of the abscissas
_NEAR = 0.05  # in units of the decay: below this radius a series about the origin takes over
_TERMS = 8  # of that series; the ratio of two is below 0.0025
_NEAR_NODES = 120


def inverse_hankel_transform(
    transform: Callable[[Float[Array, "..."]], Float[Array, "..."]],
    r: Float[Array, "*radii"],
    decay: Float[Array, " channels"],
) -> Float[Array, "*radii channels"]:
    r"""Compute `1 / 2 pi` times the integral of `k J0(k r) F(k)`.

    **Arguments:**

    - `transform`: computes `F` from `k` (1/mm) whose last axis is the channels, in the same shape;
      it falls at least like `exp(-decay k)`.
    - `r`: mm, at least 0. Differentiable, at 0 too.
    - `decay`: mm, positive: places the nodes near the origin. Not differentiated.

    **Returns:** 1/mm^2. Its error is about 1e-15 of the value at `r = 0` or, farther out, of `1 /
    (decay r)`: a tail that has fallen below that is rounding.

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
    # Near it: a series in (r / 2 decay)^2, whose coefficients are moments of F.
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
    """Abscissas `x` and weights, such that the sum of `w x f(x)` is the integral of `x J0(x) f(x)`.

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
    """Nodes for integrals over k > 0 of functions like `exp(-k)`, `log k = t - exp(-t)` at equal
    steps of t; and weights of `k J0(2 k x)` in powers of `x^2`, the highest first: [powers, nodes].
    """
    t, step = np.linspace(-2.6, 3.65, _NEAR_NODES, retstep=True)
    nodes = np.exp(t - np.exp(-t))
    power = np.arange(_TERMS)[::-1, None]
    bessel = (-1.0) ** power * nodes ** (2 * power) / scipy.special.factorial(power) ** 2
    return nodes, bessel * step * nodes * nodes * (1 + np.exp(-t))
