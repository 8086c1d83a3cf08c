"""The Green's function of the diffusion equation, softened within the spacing of the splats."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_SMALL = 0.1  # squared distance, in softening lengths, below which a series is used
_NODES, _REACH = 12, 4.0  # of the integral of the removed part: nodes, and end in softening lengths
_SCALE = 2 / math.sqrt(math.pi)
# The series of `erf(sqrt(q)) / sqrt(q)` up to the eighth power of q.
_SERIES = [_SCALE * (-1) ** n / (math.factorial(n) * (2 * n + 1)) for n in range(8, -1, -1)]
SOFTENED = 3.0  # softening lengths beyond which the kernel is not softened


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
        series, slope = (jnp.asarray(s, q.dtype) for s in (_SERIES, -2 * np.polyder(_SERIES)))
        ratio = jnp.where(near, jnp.polyval(series, small), ratio)
        fall = jnp.where(near, jnp.polyval(slope, small), fall)
        return ratio / self.length, fall / self.length**3

    def plane_integral(self, height: Float[Array, "channels *points"]) -> Float[Array, "..."]:
        """Integrate the part that softening removes over a plane, mm.

        **Arguments:**

        - `height`: of the point over the plane, mm.
        """
        kappa = self.kappa.reshape(-1, *[1] * (height.ndim - 1))
        end = _REACH * self.length
        span = jnp.maximum(end - jnp.abs(height), 0)

        def removed(fraction):
            r = end - span * (1 - fraction)
            inverse, _ = self._softening(r * r)
            return jnp.exp(-kappa * r) - r * inverse * jnp.exp(-kappa / inverse)

        return 0.5 * span * integrate(removed, _NODES, height)


def integrate(
    function: Callable[[Array], Float[Array, "*shape"]], nodes: int, like: Float[Array, "*shape"]
) -> Float[Array, "*shape"]:
    """Integrate a function from 0 to 1 by Gauss and Legendre's rule, one node after the other; its
    values have the shape of `like`.
    """
    x, weights = np.polynomial.legendre.leggauss(nodes)
    rule = jnp.asarray(np.stack([(1 + x) / 2, weights / 2], axis=1), like.dtype)

    def add(total, node_and_weight):
        return total + node_and_weight[1] * function(node_and_weight[0]), None

    return jax.lax.scan(jax.checkpoint(add), jnp.zeros_like(like), rule)[0]
