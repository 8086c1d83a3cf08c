"""Layers from fewer splats, as the paper has it: the others are left out, and those that stay stand
for them.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax.diffusion import AbstractDiffuser, DenseDiffuser, Diffused, Kernels, Sources
from splatjax.scene import Splats
from splatjax.splatting import Atlas


class ThinnedDiffuser(AbstractDiffuser):
    r"""Sums over every `keep`-th splat alone. What is kept lies evenly where nearby splats are near
    in memory.

    The renderer's own `ClusterDiffuser` merges splats instead, which errs far less for as many.

    **Attributes:**

    - `keep`: one splat of how many. Static.
    - `whole`: sums over those that are kept.

    **Source:** Kim et al. 2010, section 4.2 and Figure 5.
    """

    keep: int = eqx.field(static=True)
    whole: AbstractDiffuser = DenseDiffuser()

    def planned(
        self,
        splats: Splats,
        kernels: Kernels,
        interval: Float[Array, "2"],
        atlases: Sequence[Atlas],
    ) -> "ThinnedDiffuser":
        kept = jax.tree.map(lambda rows: rows[:: self.keep], splats)
        return ThinnedDiffuser(self.keep, self.whole.planned(kept, kernels, interval, atlases))

    def diffuse(
        self,
        sources: Sources,
        kernels: Kernels,
        points: Float[Array, "tiles 3 points"],
        covered: Bool[Array, "tiles points"],
        atlas: Atlas,
    ) -> Diffused:
        kept = jax.tree.map(lambda rows: rows[..., :: self.keep], sources)
        larger = eqx.tree_at(
            lambda kept: kept.areas,
            kept,
            kept.areas * (jnp.sum(sources.areas) / jnp.sum(kept.areas)),
        )
        return self.whole.diffuse(larger, kernels, points, covered, atlas)

    def in_forward_mode(self) -> "ThinnedDiffuser":
        return ThinnedDiffuser(self.keep, self.whole.in_forward_mode())
