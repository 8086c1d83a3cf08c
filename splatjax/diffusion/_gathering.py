"""What one layer sums over its sources, and what the sums mean."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._gaussian_sums import source_table
from ._tree import Clusters


class Gathering(eqx.Module):
    r"""Sources of one layer. Energy off a cluster's center counts to first order: `G(x - o) = G(x)
    (1 + o x / v)`.
    """

    clusters: Clusters
    """As wide as their splats are spread, and below them."""
    wide: Float[Array, " clusters"]
    """Variances of layer and cluster together, mm^2."""
    flat: Float[Array, " clusters"]
    """What makes a flat sheet one exit."""

    @classmethod
    def of(
        cls, clusters: Clusters, variance: Float[Array, ""], depth: Float[Array, ""]
    ) -> "Gathering":
        below = clusters.lowered(depth)
        wide = variance + below.spread
        return cls(below, wide, jnp.exp(0.5 * depth * depth / wide) / (2 * jnp.pi * wide))

    def table(self, block: int, slopes: bool) -> Float[Array, "blocks_and_one columns block"]:
        """Give what `gaussian_sums` needs for the values, and for the slopes."""
        clusters = self.clusters
        mass = clusters.areas * self.flat
        plain = jnp.concatenate([mass[None] * clusters.irradiance, mass[None]])
        rows = [plain]
        if clusters.moments is not None:
            moments = clusters.moments * (self.flat / self.wide)[None, None]
            energy = plain[:-1] - jnp.sum(moments * clusters.centers[None], axis=1)
            rows = [energy, mass[None], moments.reshape(-1, mass.shape[0])]
        if slopes:
            pulls = plain / self.wide[None]
            rows += [pulls, *(pulls * axis[None] for axis in clusters.centers)]
        return source_table(clusters.centers, 0.5 / self.wide, jnp.concatenate(rows), block)

    def values_and_slopes(
        self, sums: Float[Array, "rows points"], points: Float[Array, "3 points"]
    ) -> tuple[Float[Array, "values points"], Float[Array, "3 values points"]]:
        """Give the values at points, and their slopes in space (1/mm), for a table that had
        slopes.
        """
        values, pulls = self.finish.split(sums, points)
        # grad N = sum w E (q - x) / v, and grad (N / D) = (grad N - (N / D) grad D) / D.
        gathered, count = values[-1], values.shape[0]
        pulls, firsts = pulls[:count], pulls[count:].reshape(3, count, *gathered.shape)
        slopes = firsts - points[:, None] * pulls[None]
        inverse = 1 / jnp.where(gathered > 0, gathered, 1.0)
        of_means = (slopes[:, :-1] - values[None, :-1] * slopes[:, -1:]) * inverse[None, None]
        slopes = jnp.concatenate([of_means, slopes[:, -1:]], axis=1)
        return values, jnp.where(gathered > 0, slopes, 0.0)

    @property
    def finish(self) -> "MeansAndExits":
        return MeansAndExits(self.clusters.irradiance.shape[0], self.clusters.moments is not None)


class MeansAndExits(eqx.Module):
    """Makes the means and last the exits of the sums of a gathering. Static."""

    channels: int = eqx.field(static=True)
    moments: bool = eqx.field(static=True)

    def __call__(
        self, sums: Float[Array, "rows points"], points: Float[Array, "3 points"]
    ) -> Float[Array, "values points"]:
        return self.split(sums, points)[0]

    def split(self, sums: Float[Array, "rows points"], points: Float[Array, "3 points"]):
        """Give the values, and the sums that follow theirs."""
        energy, gathered, rest = (
            sums[: self.channels],
            sums[self.channels],
            sums[self.channels + 1 :],
        )
        if self.moments:
            moments, rest = (
                rest[: 3 * self.channels].reshape(self.channels, 3, -1),
                rest[3 * self.channels :],
            )
            energy = energy + jnp.sum(moments * points[None], axis=1)
        reached = gathered > 0
        means = energy / jnp.where(reached, gathered, 1.0)[None]
        return jnp.where(reached[None], jnp.concatenate([means, gathered[None]]), 0.0), rest


def nodes_table(
    centers: Float[Array, "3 nodes"],
    areas: Float[Array, " nodes"],
    values: Float[Array, "values nodes"],
    slopes: Float[Array, "3 values nodes"],
    rates: Float[Array, " nodes"],
    block: int,
) -> Float[Array, "blocks_and_one columns block"]:
    """Give the table of nodes that `blended_nodes` blends, each by its area and a Gaussian of a
    rate (1/mm^2).
    """
    continued = values - 0.5 * jnp.sum(slopes * centers[:, None], axis=0)
    rows = [jnp.ones_like(areas)[None], centers, continued, slopes.reshape(-1, areas.shape[0])]
    return source_table(centers, rates, jnp.concatenate(rows) * areas[None], block)


def blended_nodes(
    sums: Float[Array, "rows points"], points: Float[Array, "3 points"]
) -> Float[Array, "values points"]:
    r"""Give the values at points from the sums over nodes near them; 0 where there is none.

    A node is continued along half its slope: the whole slope errs by as much as none does, with the
    other sign, so that the error is of third order in the distance of the nodes. Nodes lie around a
    point unevenly; the other half of their mean slope makes up for that.
    """
    count = (sums.shape[0] - 4) // 4
    weight, middle, continued = sums[0], sums[1:4], sums[4 : 4 + count]
    slopes = sums[4 + count :].reshape(3, count, *weight.shape)
    reached = weight > 0
    inverse = 1 / jnp.where(reached, weight, 1.0)
    off = points - middle * inverse[None]
    found = (continued + 0.5 * jnp.sum(slopes * (points + off)[:, None], axis=0)) * inverse[None]
    return jnp.where(reached[None], found, 0.0)
