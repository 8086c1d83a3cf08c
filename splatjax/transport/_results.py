"""Counts of ended photons, and the results of walks: means, standard errors, and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import jit_unless_traced
from splatjax.scattering import Tabulated

from ._walk import ABOVE, BELOW, PathWeights, Photons

# Many equal numbers, added one by one to one ring, are off in float32: they are added to as many
# sums of it first.
_TABLES = 16
_AT_ONCE = 32


class Sum(eqx.Module):
    """A running sum with its rounding error: exact to the precision of its terms after any number
    of them.

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

    def plus(
        self,
        photons: Photons,
        weights: PathWeights,
        slopes: PathWeights,
        done: Bool[Array, " photons"],
        dropped: Bool[Array, " photons"],
        edges: Float[Array, "channels edges"],
    ) -> "Tally":
        """Add the photons that are done. Those `dropped` were terminated at a tiny weight, and do
        not count.
        """
        rings = edges.shape[1] - 1
        radius = jnp.sqrt(photons.x * photons.x + photons.y * photons.y)

        def leave(carried, slope, edges):
            # Photons within the first edge and beyond the last are in no ring, and count as farther
            # out.
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


class SampleMean(eqx.Module):
    """A mean over photons and its standard error, of one shape."""

    value: Float[Array, "..."]
    deviation: Float[Array, "..."]


class AbstractTallies(eqx.Module):
    r"""The distribution of the light that enters; powers are fractions of it.

    **Attributes:**

    - `reflected`, `transmitted`: the light that leaves above and below through each ring, by the
      area of the ring; 1/mm^2, [rings, channels].
    - `total_reflectance`, `total_transmittance`: all light that leaves, at any distance;
      [channels].
    - `absorbed`: in each layer; [layers, channels].
    - `unfinished`: of photons after their last allowed flight; [channels].
    """

    reflected: SampleMean
    transmitted: SampleMean
    total_reflectance: SampleMean
    total_transmittance: SampleMean
    absorbed: SampleMean
    unfinished: SampleMean


class PathDerivatives(AbstractTallies):
    """Derivatives of the results of `monte_carlo`, with their standard errors. A leading axis runs
    over the layers in whose coefficient each channel is differentiated; 1/mm as a unit of the
    coefficients.
    """


class MonteCarlo(AbstractTallies):
    r"""The fate of the light that entered, by counting photons.

    **Attributes:** besides those of `AbstractTallies`,

    - `edges`: of the rings, mm.
    - `specular`: the fraction of the arriving light that the surface reflects; [channels].
    """

    edges: Float[Array, " edges"]
    specular: Float[Array, " channels"]

    @property
    @jit_unless_traced
    def radii(self) -> Float[Array, " rings"]:
        """The mean radius of each ring, mm: where a straight profile has its mean over the ring."""
        a, b = self.edges[:-1], self.edges[1:]
        return 2 / 3 * (a * a + a * b + b * b) / (a + b)

    def profile(self) -> Tabulated:
        """Return the reflectance as a profile; its total includes light beyond the last ring."""
        return Tabulated(
            self.radii,
            self.reflected.value,
            self.reflected.deviation,
            self.total_reflectance.value,
        )


@eqx.filter_jit
def assemble(
    tallies: list[Tally],
    order: Int[Array, " channels"],
    edges: Float[Array, " edges"],
    photons: Int[Array, ""],
    specular: Float[Array, " channels"],
    layers: int,
) -> tuple[MonteCarlo, PathDerivatives, PathDerivatives] | tuple[MonteCarlo]:
    """Turn sums over photons into means and errors, with derivatives in the coefficients of so many
    layers. The moments are value, square, derivatives, and squares of derivatives.
    """
    rings = edges.shape[0] - 1
    count, others = photons.astype(edges.dtype), (photons - 1).astype(edges.dtype)
    left = jnp.concatenate([tally.left.over(count) for tally in tallies])[order]
    absorbed = jnp.concatenate([tally.absorbed.over(count) for tally in tallies], axis=1)[:, order]
    areas = jnp.pi * (edges[1:] ** 2 - edges[:-1] ** 2)
    above, below, unfinished = left[:, : rings + 1], left[:, rings + 1 : -1], left[:, -1]

    def means(value: int, square: int) -> dict[str, SampleMean]:
        def mean(moments: Float[Array, "*shape moments"]) -> SampleMean:
            variance = (moments[..., square] - moments[..., value] ** 2) / others
            return SampleMean(moments[..., value], jnp.sqrt(jnp.maximum(variance, 0.0)))

        def by_area(moments) -> SampleMean:
            return jax.tree.map(lambda part: (part / areas[None]).T, mean(moments[:, :-1]))

        return {
            "reflected": by_area(above),
            "transmitted": by_area(below),
            "total_reflectance": mean(jnp.sum(above, axis=1)),
            "total_transmittance": mean(jnp.sum(below, axis=1)),
            "absorbed": mean(absorbed),
            "unfinished": mean(unfinished),
        }

    result = MonteCarlo(edges=edges, specular=specular, **means(0, 1))
    if layers == 0:
        return (result,)
    slopes = [
        PathDerivatives(**means(2 + number, 2 + 2 * layers + number))
        for number in range(2 * layers)
    ]
    by_absorption, by_scattering = (
        jax.tree.map(lambda *parts: jnp.stack(parts), *slopes[i : i + layers]) for i in (0, layers)
    )
    return result, by_absorption, by_scattering
