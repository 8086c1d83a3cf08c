"""What lies behind a body in its pictures."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

FILLED = 0.999
"""Coverage of a pixel behind which nothing else is seen."""


class AbstractBackground(eqx.Module):
    """Which pixels count, by how much of them the body covers."""

    @abc.abstractmethod
    def counts(self, coverage: Float[Array, "height width"]) -> Float[Array, "height width"]:
        """Return 1 for pixels that count, 0 for others; constant to the derivative."""


class UnknownBackground(AbstractBackground):
    """Anything: pixels that the body does not fill do not count. A silhouette then tells
    nothing.
    """

    def counts(self, coverage: Float[Array, "height width"]) -> Float[Array, "height width"]:
        return jax.lax.stop_gradient(jnp.where(coverage > FILLED, 1.0, 0.0).astype(coverage.dtype))


class BlackBackground(AbstractBackground):
    """Nothing that sends light: all pixels count, and where the body ends is what tells most of a
    camera's pose.
    """

    def counts(self, coverage: Float[Array, "height width"]) -> Float[Array, "height width"]:
        return jnp.ones_like(coverage)
