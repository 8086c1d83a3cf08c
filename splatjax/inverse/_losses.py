"""Which pixels count, and how much their residuals do."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

FILLED = 0.999
"""Coverage of a pixel behind which nothing else is seen."""


class AbstractLoss(eqx.Module):
    """The loss of a pixel, as a function of its residual in units of its deviation."""

    @abc.abstractmethod
    def root(self, residuals: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute the root of the loss, with the sign of the residual: near zero the
        residual itself.
        """


class SquaredLoss(AbstractLoss):
    """The square: right for noise that is normal, misled by every highlight that the model does not
    know.
    """

    def root(self, residuals: Float[Array, "..."]) -> Float[Array, "..."]:
        return residuals


class HuberLoss(AbstractLoss):
    r"""The square for small residuals and twice the absolute value times the bend for large ones,
    smoothly.

        loss(r) = 2 b^2 (sqrt(1 + r^2 / b^2) - 1)

    **Attributes:**

    - `bend`: deviations at which one becomes the other, positive. Static.

    **Raises:** `ValueError` for a bend that is not positive.

    **Source:** Huber 1964; in this smooth form Charbonnier and others 1997.
    """

    bend: float = eqx.field(static=True, default=2.0)

    def __check_init__(self):
        if not self.bend > 0:
            raise ValueError(f"bend must be positive (deviations); got {self.bend:g}")

    def root(self, residuals: Float[Array, "..."]) -> Float[Array, "..."]:
        squared = (residuals / self.bend) ** 2
        return residuals * jnp.sqrt(2 / (1 + jnp.sqrt(1 + squared)))


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
