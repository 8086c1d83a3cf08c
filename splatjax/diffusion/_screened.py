"""The Green's function of the diffusion equation as a sum of Gaussians."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_STEP = math.log(2) / 2  # of the trapezoid rule in log s: right to 2e-6
_NARROW, _REST = 40, 60  # Gaussians beyond those that are summed: below 1e-6 is left out
_SQUARINGS = 3  # after which rounding counts
_FLAT = 0.15  # widest exponent that a parabola stands for, as a root


class ScreenedKernel(eqx.Module):
    r"""`exp(-kappa r) / (4 pi r)`, split by the width of its Gaussians:

        exp(-kappa r) / r = (2 / sqrt(pi)) int_0^inf exp(-r^2 s^2 - kappa^2 / (4 s^2)) ds

    Points of a surface resolve the Gaussians that are at least as wide as `spread`. Narrower ones
    see a plane around each point, and are integrated over it in closed form.

    **Attributes:** (differentiable)

    - `squared_kappa`: 1/mm^2; smooth at 0.
    - `spread`: mm. The narrowest Gaussian that is summed is `exp(-(r / spread)^2)`, and each next
      one has twice the variance.
    - `count`: of the Gaussians that are summed. Static.
    """

    squared_kappa: Float[Array, ""]
    spread: Float[Array, ""]
    count: int = eqx.field(static=True)

    @staticmethod
    def count_for(reach: float, spread: float) -> int:
        """Return how many Gaussians distances up to `reach` need; wider ones are parabolas."""
        return max(math.ceil(2 * math.log2(reach / spread / _FLAT)), 1)

    def finer(self, octaves: int) -> "ScreenedKernel":
        """Sum Gaussians down to variances smaller by `2^octaves`."""
        spread = self.spread * 2 ** (-octaves / 2)
        return ScreenedKernel(self.squared_kappa, spread, self.count + octaves)

    def _gaussians(self, numbers: np.ndarray):
        """Return `s^2` and the weight of some Gaussians; the narrowest that is summed is 0."""
        squared = jnp.asarray(0.5**numbers, self.spread.dtype) / (self.spread * self.spread)
        scale = 2 / math.sqrt(math.pi) * _STEP / (4 * math.pi)
        return squared, scale * jnp.sqrt(squared) * jnp.exp(-self.squared_kappa / (4 * squared))

    def __call__(
        self, squared_distances: Float[Array, "*pairs"]
    ) -> tuple[Float[Array, "*pairs"], Float[Array, "*pairs"]]:
        """Compute the part that is summed, 1/mm, and `-1/r` times its derivative in `r`, 1/mm^3."""
        squared, weights = self._gaussians(np.arange(self.count))
        # Gaussians wider than the body, by the first two terms of their series.
        wide, of_wide = self._gaussians(np.arange(self.count, self.count + _REST))
        curvature = jnp.sum(wide * of_wide)
        value = jnp.sum(of_wide) - curvature * squared_distances
        slope = jnp.full_like(squared_distances, 2) * curvature
        gaussian = squared_distances
        for i in range(self.count - 1, -1, -1):
            if (self.count - 1 - i) % (_SQUARINGS + 1) == 0:
                gaussian = jnp.exp(-squared[i] * squared_distances)
            else:
                gaussian = gaussian * gaussian
            value = value + weights[i] * gaussian
            slope = slope + 2 * squared[i] * weights[i] * gaussian
        return value, slope

    def plane_integral(self, height: Float[Array, "*points"]) -> Float[Array, "*points"]:
        """Integrate the part that is not summed over a plane at this height, mm."""
        squared, weights = self._gaussians(np.arange(-_NARROW, 0))

        def integral(squared, weight):
            return jnp.pi * weight / squared * jnp.exp(-squared * height * height)

        return jnp.sum(jax.vmap(integral)(squared, weights), axis=0)
