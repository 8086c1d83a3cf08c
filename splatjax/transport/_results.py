"""Sums over finished photons, and the results of walks: means and standard errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from splatjax._chunking import jit_unless_traced
from splatjax.scattering import Tabulated

from ._walk import BELOW, INSIDE, PathWeights, Photons

# Adding many equal numbers to one sum is inaccurate in float32, so each ring first has this many
# partial sums.
_TABLES = 16
_AT_ONCE = 32


class Sum(eqx.Module):
    """A compensated running sum, accurate to the precision of its terms after any number of them.

    **Source:** Neumaier 1974.
    """

    high: Float[Array, "..."]
    low: Float[Array, "..."]

    def plus(self, term: Float[Array, "..."]) -> "Sum":
        high = self.high + term
        low = self.low + jnp.where(
            jnp.abs(self.high) >= jnp.abs(term),
            (self.high - high) + term,
            (term - high) + self.high,
        )
        rounded = high + low
        return Sum(rounded, low - (rounded - high))


def total(
    counts: Float[Array, " terms"], values: Float[Array, "terms moments"]
) -> Float[Array, " moments"]:
    """Compute `counts @ values` hierarchically, a few terms at a time; a plain sum of thousands of
    terms has an error of 5e-5 in float32.
    """
    while counts.shape[0] % _AT_ONCE == 0:
        values = jnp.einsum(
            "ga,gam->gm",
            counts.reshape(-1, _AT_ONCE),
            values.reshape(-1, _AT_ONCE, values.shape[1]),
        )
        counts = jnp.ones(values.shape[0], values.dtype)
    return counts @ values


def photon_moments(
    photons: Photons,
    weights: PathWeights,
    slopes: PathWeights,
    done: Bool[Array, " photons"],
    dropped: Bool[Array, " photons"],
    edges: Float[Array, "channels edges"],
) -> Float[Array, "channels places moments"]:
    """Sum weights, their squares and their derivatives over the `done` photons. Photons that
    Russian roulette `dropped` count in the absorbed light only.

    **Returns:** sums by place, in this order: the rings above, all other light that left above, the
    rings below, all other light that left below, unfinished photons, and absorption in each layer.
    """
    rings = edges.shape[1] - 1
    radius = jnp.sqrt(photons.x * photons.x + photons.y * photons.y)
    table = jnp.arange(done.shape[0], dtype=jnp.int32) % _TABLES

    def leave(carried, slope, edges):
        # Photons inside the first edge and beyond the last are in no ring, and share one place.
        ring = jnp.searchsorted(edges, radius, side="right", method="scan_unrolled") - 1
        ring = jnp.where((ring < 0) | (ring >= rings), rings, ring)
        ring = jnp.where(photons.place == BELOW, ring + rings + 1, ring)
        ring = jnp.where(photons.place == INSIDE, 2 * rings + 2, ring)
        moments = jnp.where((done & ~dropped)[:, None], _moments(carried, slope), 0.0)
        sums = jnp.zeros((_TABLES, 2 * rings + 3, moments.shape[1]), carried.dtype)
        return jnp.sum(sums.at[table, ring].add(moments), axis=0)

    def absorb(absorbed, slope):
        return total(done.astype(absorbed.dtype), _moments(absorbed, slope))

    left = jax.vmap(leave, in_axes=(0, 1, 0))(weights.carried, slopes.carried, edges)
    by_layer = jax.vmap(jax.vmap(absorb, (0, 1)), (1, 2))
    return jnp.concatenate([left, by_layer(weights.absorbed, slopes.absorbed)], axis=1)


def _moments(
    values: Float[Array, " photons"], slopes: Float[Array, "slopes photons"]
) -> Float[Array, "photons moments"]:
    return jnp.concatenate([values[None], (values * values)[None], slopes]).T


class SampleMean(eqx.Module):
    """A mean over photons and its standard error, of equal shape."""

    value: Float[Array, "..."]
    deviation: Float[Array, "..."]


class MonteCarlo(eqx.Module):
    r"""The result of `monte_carlo`. Powers are fractions of the light that entered.

    **Attributes:**

    - `edges`: edges of the rings, mm.
    - `specular`: the fraction of the incident light that the surface reflects; [channels].
    - `reflected`, `transmitted`: the light that leaves above and below through each ring, per area;
      1/mm^2, [rings, channels].
    - `total_reflectance`, `total_transmittance`: all light that leaves, at any distance;
      [channels].
    - `absorbed`: the light absorbed in each layer; [layers, channels].
    - `unfinished`: the power of photons after their last allowed flight; [channels].
    """

    edges: Float[Array, " edges"]
    specular: Float[Array, " channels"]
    reflected: SampleMean
    transmitted: SampleMean
    total_reflectance: SampleMean
    total_transmittance: SampleMean
    absorbed: SampleMean
    unfinished: SampleMean

    @property
    @jit_unless_traced
    def radii(self) -> Float[Array, " rings"]:
        """Return the area-weighted mean radius of each ring, mm, where a linear profile equals its
        mean over the ring.
        """
        a, b = self.edges[:-1], self.edges[1:]
        return 2 / 3 * (a * a + a * b + b * b) / (a + b)

    def profile(self) -> Tabulated:
        """Return the reflectance as a profile. Its total includes light beyond the last ring."""
        return Tabulated(
            self.radii,
            self.reflected.value,
            self.reflected.deviation,
            self.total_reflectance.value,
        )


@eqx.filter_jit
def assemble(
    moments: Float[Array, "channels places two"],
    edges: Float[Array, " edges"],
    photons: Int[Array, ""],
    specular: Float[Array, " channels"],
) -> MonteCarlo:
    """Compute the results from means of weights and of their squares. Errors are constants."""
    rings, divisor = edges.shape[0] - 1, (photons - 1).astype(edges.dtype)
    areas = jnp.pi * (edges[1:] ** 2 - edges[:-1] ** 2)
    above, below, unfinished, absorbed = jnp.split(
        moments, [rings + 1, 2 * rings + 2, 2 * rings + 3], axis=1
    )

    def mean(moments: Float[Array, "*shape two"]) -> SampleMean:
        variance = jax.lax.stop_gradient(moments[..., 1] - moments[..., 0] ** 2) / divisor
        return SampleMean(moments[..., 0].T, jnp.sqrt(jnp.maximum(variance, 0.0)).T)

    def by_area(moments: Float[Array, "channels rings two"]) -> SampleMean:
        return jax.tree.map(lambda part: part / areas[:, None], mean(moments[:, :-1]))

    return MonteCarlo(
        edges=edges,
        specular=specular,
        reflected=by_area(above),
        transmitted=by_area(below),
        total_reflectance=mean(jnp.sum(above, axis=1)),
        total_transmittance=mean(jnp.sum(below, axis=1)),
        absorbed=mean(absorbed),
        unfinished=mean(unfinished[:, 0]),
    )
