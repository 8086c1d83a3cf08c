"""Layers from fewer splats, as in the paper: some are omitted, and the others represent them. The
law of Figure 5: the error of such a layer, and the number of splats that suffices.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import take_points
from splatjax.diffusion import (
    AbstractDiffuser,
    AbstractDiffusionPlan,
    Diffused,
    dense_layers,
)
from splatjax.scene import Splats

_GOLDEN = (5**0.5 - 1) / 2
_EVEN = 0.2  # fitted on the bust: docs/figures.md
_POINTS = 512  # number of points at which the contrast is measured
_AT_ONCE = 8


class ThinnedDiffuser(AbstractDiffuser):
    r"""Sums over one in every `keep` splats, evaluated at all splats. The kept ones are evenly
    spread, because a plan sorts splats by position.

    The renderer's own `ClusterDiffuser` merges splats instead, with a far smaller error for the
    same number.

    **Attributes:**

    - `keep`: number of splats of which one is kept. Static.

    **Source:** Kim et al. 2010, section 4.2 and Figure 5.
    """

    keep: int = eqx.field(static=True)

    def make_plan(self, splats, variances, kernel, interval, devices=1):
        return ThinnedPlan(jnp.arange(len(variances), dtype=jnp.int32), self.keep)


class ThinnedPlan(AbstractDiffusionPlan):
    """The plan of sums over fewer splats: of every `keep` splats, one is kept."""

    keep: int = eqx.field(static=True)

    def diffuse(self, sources, variances, kernel, combination, at=None):
        everywhere = combination.gather(sources, axis=-1).of_layers(self.gaussians)
        group = np.arange(-(-everywhere.areas.shape[0] // self.keep))
        # The first splat of each group would lie on the same side of every group.
        chosen = group * self.keep + (group * _GOLDEN % 1 * self.keep).astype(int)
        chosen = np.minimum(chosen, everywhere.areas.shape[0] - 1)
        kept = jax.tree.map(lambda rows: rows[..., chosen], everywhere)
        stands_for = combination.total([jnp.sum(sources.areas)]) / jnp.sum(kept.areas)
        kept = dataclasses.replace(kept, areas=kept.areas * stands_for)
        points = take_points(sources.centers, at)
        layers = dense_layers(kept, points, self.variances_of_layers(variances), kernel)
        return Diffused(layers, jnp.zeros((), sources.centers.dtype))


def thinning_error(
    width: Float[Array, "..."],
    spacing: Float[Array, "..."],
    ratio: Float[Array, "..."],
    contrast: Float[Array, "..."],
) -> Float[Array, "..."]:
    r"""Estimate the error of a layer computed from a fraction of the splats, evenly spread: its
    root mean square divided by the layer's.

        E = 0.2 s x^(3/2) (1 - q)^(1/2),    x = (h / sigma) q^(-1/2)

    The error depends on `x`, the spacing of the kept splats over the width of the layer: for a
    radius amplified a-fold, `1 / a^2` of the splats suffice, as Figure 5 shows. A layer averages
    over `4 pi / x^2` of them. For splats omitted at random, the error of each is `s`, and that of
    the mean `s x (1 - q)^(1/2) / (2 sqrt(pi))`, without a fitted factor. An evenly spread splat
    represents a cell around it, and its error is large where an edge of light crosses the cell.
    Edges cross a fraction `x` of the cells, so the error decreases by another `x^(1/2)`; the factor
    is fitted.

    **Arguments:**

    - `width`: width of the layer, `sigma`, the root of its variance, mm.
    - `spacing`: spacing of all splats, `h`, the root of their mean area, mm.
    - `ratio`: fraction of splats that are kept, `q`, in (0, 1].
    - `contrast`: `s`, from `layer_contrast`.

    **Returns:** within a factor of 1.5 of measurements, in 99% of 234 layers with `x` up to 2.2
    (docs/figures.md).

    **Source:** fitted; Kim et al. 2010, Figure 5, which it explains.
    """
    x = spacing / (width * jnp.sqrt(ratio))
    return _EVEN * contrast * x**1.5 * jnp.sqrt(1 - ratio)


def splats_that_suffice(
    width: Float[Array, "..."],
    spacing: Float[Array, "..."],
    error: Float[Array, "..."],
    contrast: Float[Array, "..."],
) -> Float[Array, "..."]:
    r"""Compute the fraction of splats that gives a layer an error: the inverse of `thinning_error`.

    The root `(1 - q)^(1/2)` is replaced by 1, so the ratio is slightly too large if most are kept.

    **Arguments:** as in `thinning_error`.

    **Returns:** in (0, 1].
    """
    x = (error / (_EVEN * contrast)) ** (2 / 3)
    return jnp.minimum((spacing / (width * x)) ** 2, 1.0)


@jax.jit
def layer_contrast(
    splats: Splats, source: Float[Array, "splats channels"], variance: Float[Array, ""]
) -> Float[Array, ""]:
    r"""Measure the variation of light within a layer's width: `s`, relative to the layer's root
    mean square.

    It is the standard deviation of the light weighted by `G(v / 2, r)`, the square of the layer's
    Gaussian, averaged (root mean square) over 512 evenly chosen splats and over the channels.

    **Arguments:**

    - `source`: the light that spreads, as `splatjax.render.compute_irradiance` gives it.
    - `variance`: of the layer, mm^2.

    **Returns:** 0 for uniform light.
    """
    count = min(_POINTS, splats.count) // _AT_ONCE * _AT_ONCE
    if count == 0:
        return jnp.zeros((), source.dtype)
    chosen = jnp.linspace(0, splats.count - 1, count).astype(jnp.int32)

    def around(points: Float[Array, "points 3"]):
        offset = points[:, None] - splats.centers[None]
        squared = jnp.sum(offset * offset, axis=2)

        def mean(variance, values):
            weight = splats.areas[None] * jnp.exp(-0.5 * squared / variance)
            return (weight @ values) / jnp.sum(weight, axis=1, keepdims=True)

        narrow, square = mean(variance / 2, source), mean(variance / 2, source * source)
        return mean(variance, source), jnp.maximum(square - narrow * narrow, 0)

    layer, uneven = jax.lax.map(around, splats.centers[chosen].reshape(-1, _AT_ONCE, 3))
    return jnp.sqrt(jnp.mean(uneven) / jnp.mean(layer * layer))
