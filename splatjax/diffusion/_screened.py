"""The Green's function of the diffusion equation, softened within the spacing of splats."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_TERMS, _SMALL = 8, 0.1  # of the series of the softening near 0
_NODES, _REACH = 12, 4.0  # of the integral of what is left out, and its end in softening lengths
_SCALE = 2 / math.sqrt(math.pi)
SOFTENED = 3.0  # softening lengths, beyond which the kernel is as without


class ScreenedKernel(eqx.Module):
    r"""`G = exp(-kappa r) / (4 pi r)`, with the distance softened:

        r_s = r / erf(r / length)

    It is smooth, points of a surface at most `length` apart resolve it, and it is `G` beyond three
    lengths. The part that softening removes is integrated over a plane through each point.

    **Attributes:** (differentiable)

    - `kappa`: 1/mm.
    - `length`: mm.
    """

    kappa: Float[Array, "channels"]
    length: Float[Array, ""]

    def near(self, squared_distances: Float[Array, "*pairs"]) -> list[tuple]:
        """Compute the softened kernel of every channel, 1/mm, and `-1/r` times its derivative in
        `r`, 1/mm^3.
        """
        inverse, fall = self._softening(squared_distances)
        distance, inverse, fall = 1 / inverse, inverse / (4 * math.pi), fall / (4 * math.pi)

        def of_channel(kappa):
            exponent = kappa * distance
            screened = jnp.exp(-exponent)
            return inverse * screened, fall * (1 + exponent) * screened

        return [of_channel(kappa) for kappa in self.kappa]

    def far(self, squared_distances: Float[Array, "*pairs"]) -> list[tuple]:
        """Compute the kernel beyond three lengths, 1/mm, and apply `-1/r d/dr` once, 1/mm^3, and
        twice, 1/mm^5. All are finite at distance 0.
        """
        inverse = jax.lax.rsqrt(jnp.where(squared_distances > 0, squared_distances, 1.0))
        distance, squared = squared_distances * inverse, inverse * inverse

        def of_channel(kappa):
            exponent = kappa * distance
            value = jnp.exp(-exponent) * inverse / (4 * math.pi)
            once, twice = 1 + exponent, 3 + exponent * (3 + exponent)
            return value, value * squared * once, value * squared * squared * twice

        return [of_channel(kappa) for kappa in self.kappa]

    def _softening(self, squared_distances):
        """Compute `1 / r_s`, and `-1/r` times its derivative in `r`."""
        q = squared_distances / (self.length * self.length)
        near = q < _SMALL
        away = jnp.where(near, 1.0, q)
        root, small = jnp.sqrt(away), jnp.where(near, q, 0.0)
        ratio = jax.scipy.special.erf(root) / root
        fall = (ratio - _SCALE * jnp.exp(-away)) / away
        by_series, fall_by_series = jnp.zeros_like(q), jnp.zeros_like(q)
        for n in range(_TERMS, -1, -1):
            term = _SCALE * (-1) ** n / (math.factorial(n) * (2 * n + 1))
            by_series = by_series * small + term
            if n:
                fall_by_series = fall_by_series * small - 2 * n * term
        ratio = jnp.where(near, by_series, ratio)
        fall = jnp.where(near, fall_by_series, fall)
        return ratio / self.length, fall / self.length**3

    def plane_integral(self, height: Float[Array, "channels *points"]) -> Float[Array, "..."]:
        """Integrate the part that softening removes over a plane, mm.

        **Arguments:**

        - `height`: of the point over the plane, mm.
        """
        nodes, weights = np.polynomial.legendre.leggauss(_NODES)
        kappa = self.kappa.reshape(-1, *[1] * (height.ndim - 1))
        end, total = _REACH * self.length, jnp.zeros_like(height)
        span = jnp.maximum(end - jnp.abs(height), 0)
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True):
            r = end - span * (1 - node) / 2
            inverse, _ = self._softening(r * r)
            left_out = jnp.exp(-kappa * r) - r * inverse * jnp.exp(-kappa / inverse)
            total = total + weight / 4 * span * left_out
        return total
