"""Where photons end: rings of the surfaces they leave through, and layers that absorb."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._walk import ABOVE, BELOW, PathWeights, Photons

_TABLES = 16
"""Many equal numbers, added one by one to one ring, are off in float32: they are added to as many
sums of it first.
"""
_AT_ONCE = 32


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


class Tally(eqx.Module):
    r"""Sums over finished photons of weights, of their squares, and of derivatives and their
    squares.

    **Attributes:** (the last axis: weight, its square; then the derivatives, then their squares)

    - `left`: by channel, and by ring: those above, what left farther out, those below, what left
      farther out there, and what was still on its way when it was given up.
    - `absorbed`: by layer and channel.
    """

    left: Sum
    absorbed: Sum

    @classmethod
    def empty(cls, rings: int, layers: int, channels: int, slopes: int, dtype) -> "Tally":
        moments = 2 + 2 * slopes
        return cls(
            Sum.zeros((channels, 2 * (rings + 1) + 1, moments), dtype),
            Sum.zeros((layers, channels, moments), dtype),
        )

    def plus(
        self,
        photons: Photons,
        weights: PathWeights,
        slopes: PathWeights,
        done: Bool[Array, " photons"],
        dropped: Bool[Array, " photons"],
        edges: Float[Array, "channels edges"],
    ) -> "Tally":
        """Add the photons that are done. Those `dropped` were given up for having too little to
        carry, and leave nothing.
        """
        rings = edges.shape[1] - 1
        radius = jnp.sqrt(photons.x * photons.x + photons.y * photons.y)

        def leave(carried, slope, edges):
            # Within the first edge and beyond the last is farther out too: no ring knows it.
            ring = jnp.searchsorted(edges, radius, side="right", method="scan_unrolled") - 1
            ring = jnp.where((ring < 0) | (ring >= rings), rings, ring)
            ring = jnp.where(
                photons.place == ABOVE,
                ring,
                jnp.where(photons.place == BELOW, ring + rings + 1, 2 * rings + 2),
            )
            counts = (done & ~dropped).astype(carried.dtype)
            moments = _moments(carried, slope) * jnp.broadcast_to(
                counts[:, None], (counts.shape[0], self.left.high.shape[-1])
            )
            table = jnp.arange(counts.shape[0], dtype=jnp.int32) % _TABLES
            return jnp.sum(
                jnp.zeros((_TABLES, *self.left.high.shape[1:]), carried.dtype)
                .at[table, ring]
                .add(moments),
                axis=0,
            )

        left = jax.vmap(leave, in_axes=(0, 1, 0))(weights.carried, slopes.carried, edges)

        def absorb(absorbed, slope):
            return total(done.astype(absorbed.dtype), _moments(absorbed, slope))

        absorbed = jax.vmap(jax.vmap(absorb, in_axes=(0, 1)), in_axes=(0, 1))(
            weights.absorbed, slopes.absorbed
        )
        return Tally(self.left.plus(left), self.absorbed.plus(absorbed))


def _moments(
    values: Float[Array, " photons"], slopes: Float[Array, "slopes photons"]
) -> Float[Array, "photons moments"]:
    return jnp.concatenate([values[None], (values * values)[None], slopes, slopes * slopes]).T
