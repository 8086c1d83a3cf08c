"""Sums of very many small numbers."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Sum(eqx.Module):
    """A running sum and what rounding left out of it: exact to the precision of its terms after any
    number of them.

    **Source:** Neumaier 1974.
    """

    high: Float[Array, "..."]
    low: Float[Array, "..."]

    @classmethod
    def zeros(cls, shape: tuple[int, ...], dtype) -> "Sum":
        return cls(jnp.zeros(shape, dtype), jnp.zeros(shape, dtype))

    def plus(self, term: Float[Array, "..."]) -> "Sum":
        high = self.high + term
        lost = jnp.where(
            jnp.abs(self.high) >= jnp.abs(term),
            (self.high - high) + term,
            (term - high) + self.high,
        )
        low = self.low + lost
        both = high + low
        return Sum(both, low - (both - high))

    def over(self, count) -> Float[Array, "..."]:
        """Compute the mean."""
        return self.high / count + self.low / count


_AT_ONCE = 32


def total(
    counts: Float[Array, " terms"], values: Float[Array, "terms moments"]
) -> Float[Array, " moments"]:
    """Compute `counts @ values`, a few terms at a time: thousands of them, one after the other, are
    off by 5e-5 in float32.
    """
    while counts.shape[0] % _AT_ONCE == 0:
        values = jnp.einsum(
            "ga,gam->gm",
            counts.reshape(-1, _AT_ONCE),
            values.reshape(-1, _AT_ONCE, values.shape[1]),
        )
        counts = jnp.ones(values.shape[0], values.dtype)
    return counts @ values
