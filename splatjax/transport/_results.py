"""What a walk of many photons reports: means, their standard errors, and derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._chunking import jit_unless_traced
from splatjax.scattering import Tabulated

from ._tally import Tally


class SampleMean(eqx.Module):
    """A mean over photons and its standard error, of one shape."""

    value: Float[Array, "..."]
    deviation: Float[Array, "..."]


class AbstractTallies(eqx.Module):
    r"""Where the light goes that enters; powers are fractions of it.

    **Attributes:**

    - `reflected`, `transmitted`: the light that leaves above and below through each ring, by the
      area of the ring; 1/mm^2, [rings, channels].
    - `total_reflectance`, `total_transmittance`: all light that leaves, at any distance;
      [channels].
    - `absorbed`: in each layer; [layers, channels].
    - `unfinished`: carried by photons after the last flight that they were allowed; [channels].
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
    def radii(self) -> Float[Array, " rings"]:
        """The mean radius of each ring, mm: where a straight profile has its mean over the ring."""
        return _mean_radii(self.edges)

    def profile(self) -> Tabulated:
        """Return the reflectance as a profile; its total includes light beyond the last ring."""
        total = self.total_reflectance.value
        return Tabulated(self.radii, self.reflected.value, self.reflected.deviation, total)

    def transmitted_profile(self) -> Tabulated:
        """Return the transmittance as a profile."""
        total = self.total_transmittance.value
        return Tabulated(self.radii, self.transmitted.value, self.transmitted.deviation, total)

    def balance(self) -> Float[Array, " channels"]:
        """Compute all light that is accounted for, less 1: rounding, and the chance by which faint
        photons are given up.
        """
        parts = (self.total_reflectance, self.total_transmittance, self.unfinished)
        return sum(part.value for part in parts) + jnp.sum(self.absorbed.value, axis=0) - 1


@jit_unless_traced
def _mean_radii(edges: Float[Array, " edges"]) -> Float[Array, " rings"]:
    a, b = edges[:-1], edges[1:]
    return 2 / 3 * (a * a + a * b + b * b) / (a + b)


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
