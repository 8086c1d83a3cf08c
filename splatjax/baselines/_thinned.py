"""Layers from fewer splats, as in the paper: some are omitted, and the others represent them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from splatjax._chunking import take_points
from splatjax.diffusion import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    dense_layers,
)

_GOLDEN = (5**0.5 - 1) / 2


class ThinnedDiffuser(AbstractDiffuser):
    r"""Sums over one of every `keep` splats, at all splats. The kept ones are evenly spread,
    because a plan sorts splats by position.

    The renderer's own `ClusterDiffuser` merges splats instead, with a far smaller error for the
    same number.

    **Attributes:**

    - `keep`: one splat of how many. Static.

    **Source:** Kim et al. 2010, section 4.2 and Figure 5.
    """

    keep: int = eqx.field(static=True)

    def make_plan(self, parts, variances, kernel, interval):
        return ThinnedPlan(jnp.arange(len(variances), dtype=jnp.int32), self.keep)


class ThinnedPlan(AbstractDiffusionPlan):
    """The plan of sums over fewer splats: the number of omitted ones."""

    keep: int = eqx.field(static=True)

    def diffuse(self, sources, variances, kernel, combination, at=None):
        everywhere = combination.gather(sources, axis=-1)
        group = np.arange(-(-everywhere.areas.shape[0] // self.keep))
        # The first of each group would be on the same side of all groups.
        chosen = group * self.keep + (group * _GOLDEN % 1 * self.keep).astype(int)
        chosen = np.minimum(chosen, everywhere.areas.shape[0] - 1)
        kept = jax.tree.map(lambda rows: rows[..., chosen], everywhere)
        stands_for = combination.total([jnp.sum(sources.areas)]) / jnp.sum(kept.areas)
        kept = dataclasses.replace(kept, areas=kept.areas * stands_for)
        points = sources.centers if at is None else take_points(sources.centers, at)
        layers = dense_layers(kept, points, self.variances_of_layers(variances), kernel)
        return Diffused(layers, jnp.zeros((), sources.centers.dtype))
