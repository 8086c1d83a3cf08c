"""The law of Figure 5: how much a layer errs when it is made of fewer splats, and how many are
enough.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scene import Splats

_EVEN = 0.2  # fitted on the bust: docs/figures.md
_POINTS = 512  # at which the contrast is measured
_AT_ONCE = 8


def thinning_error(
    width: Float[Array, "..."],
    spacing: Float[Array, "..."],
    ratio: Float[Array, "..."],
    contrast: Float[Array, "..."],
) -> Float[Array, "..."]:
    r"""Estimate the error of a layer that is made of a part of the splats, spread evenly: root mean
    square, of the layer's own.

        E = 0.2 s x^(3/2) (1 - q)^(1/2),    x = (h / sigma) q^(-1/2)

    What counts is `x`, the spacing of the splats that stay in widths of the layer: where a radius
    is amplified a-fold, `1 / a^2` of the splats serve as well, as Figure 5 shows. A layer averages
    over `4 pi / x^2` of them. Were splats left out at random, each would err by `s`, and the mean
    by `s x (1 - q)^(1/2) / (2 sqrt(pi))`, with nothing to fit. Evenly spread, each stands for a
    cell around it and errs chiefly where an edge of light crosses the cell. That is a share of `x`
    of the cells, so that the error falls by another `x^(1/2)`; the factor is fitted.

    **Arguments:**

    - `width`: of the layer, the root of its variance, mm.
    - `spacing`: of all splats, the root of their mean area, mm.
    - `ratio`: of the splats that stay, in (0, 1].
    - `contrast`: `s`, from `layer_contrast`.

    **Returns:** within a factor of 1.5 of what is measured, in 99% of 234 layers with `x` up to 2.2
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
    r"""Find the ratio of the splats of which a layer errs by no more than `error`: the inverse of
    `thinning_error`.

    To the root `(1 - q)^(1/2)`, which counts as 1: a little too many, where most of them stay.

    **Arguments:** as in `thinning_error`.

    **Returns:** in (0, 1].
    """
    x = (error / (_EVEN * contrast)) ** (2 / 3)
    return jnp.minimum((spacing / (width * x)) ** 2, 1.0)


@jax.jit
def layer_contrast(
    splats: Splats, source: Float[Array, "splats channels"], variance: Float[Array, ""]
) -> Float[Array, ""]:
    r"""Measure how uneven light is within a layer's width: `s`, of the layer's root mean square.

    The standard deviation of the light under `G(v / 2, r)`, which is the square of the layer's
    Gaussian; root mean square over 512 splats, evenly chosen, and over the channels.

    **Arguments:**

    - `source`: the light that spreads, as `splatjax.render.compute_irradiance` gives it.
    - `variance`: of the layer, mm^2.

    **Returns:** 0 under even light.
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
