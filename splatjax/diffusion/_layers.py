"""Pass 4: splat-based diffusion (section 4.2), one layer per Gaussian."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import map_chunks
from splatjax.scene import Material
from splatjax.splatting import TILES_AT_ONCE, Atlas

from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources, diffuse_with_slopes
from ._normalization import AbstractNormalization
from ._points import Points, SeenSurface


class DiffusionLayers(eqx.Module):
    """The layers `L_k`, and how much of each is the diffusion integral, not the surface's own
    irradiance.
    """

    layers: Float[Array, "tiles gaussians channels pixels"]
    resolved: Float[Array, "tiles gaussians pixels"]


class ExitanceJacobian(eqx.Module):
    """What radiant exitance does per change of the material; the channels of the weights do not
    mix.
    """

    weights: Float[Array, "tiles gaussians channels pixels"]
    variances: Float[Array, "tiles gaussians channels pixels"]
    """1/mm^2."""


def diffusion_layers(
    sources: Sources,
    material: Material,
    seen: SeenSurface,
    interval: Float[Array, "2"],
    atlas: Atlas,
    diffuser: AbstractDiffuser,
    normalization: AbstractNormalization,
) -> tuple[DiffusionLayers, Float[Array, ""]]:
    r"""Diffuse the irradiance of the splats to the points that the pixels see.

    **Arguments:**

    - `sources`: centers (mm), normals, areas (mm^2) and irradiance of the splats. Differentiable.
    - `material`: its Gaussians, one per layer. Their weights tell the normalization how much light
      is absorbed; the layers are not multiplied by them. Differentiable.
    - `seen`: the surfaces, in the tiles of the atlas. Differentiable.
    - `interval`: from `handover_interval`.

    **Returns:** the layers, without weights, and what capacity was needed over what was planned.
    They are linear in the light. For weights that are not negative and sum to one or less, their
    weighted sum is at most the greatest irradiance; where they sum to one it keeps constants. Each
    layer keeps constants, and `min E <= L_k <= max E`, where the normalization's gain is 1:
    everywhere for `PlainMean`; for `ExitOdds` on flat pieces and at open edges.

    **Source:** Kim et al. 2010, section 4.2; the normalization's own.
    """
    kernels = Kernels.of(material.gaussians.variances, normalization)
    diffused = diffuser.diffuse(sources, kernels, seen.points, seen.covered, atlas)
    return layers_of(diffused, material, seen, interval, normalization), diffused.needed


def layers_of(
    diffused: Diffused,
    material: Material,
    seen: SeenSurface,
    interval: Float[Array, "2"],
    normalization: AbstractNormalization,
) -> DiffusionLayers:
    """Make the layers of the diffusion integrals, and of what the splats are too far apart to
    carry.
    """

    def layers(seen, means, exits):
        at = Points.of(material, seen, means, exits, diffused.carried)
        return DiffusionLayers(
            *_tiles_first(at.layers(interval, normalization, material.gaussians.variances))
        )

    return _in_parts(layers, seen, diffused.means, diffused.exits)


def exitance_jacobian(
    sources: Sources,
    material: Material,
    seen: SeenSurface,
    interval: Float[Array, "2"],
    atlas: Atlas,
    diffuser: AbstractDiffuser,
    normalization: AbstractNormalization,
) -> tuple[DiffusionLayers, ExitanceJacobian, Float[Array, ""]]:
    r"""Diffuse, and differentiate the radiant exitance `M = sum_k w_k L_k` of every pixel in the
    weights and the variances.

    Layer k gathers light by its own variance alone, so one more accumulation per layer, of `A E
    dG/dv` and `A dG/dv`, serves the whole Jacobian; the rest is done pixel by pixel. Where the
    normalization's gain is 1 the derivative in a weight is the layer itself.

    **Arguments:** as in `diffusion_layers`; the irradiance counts as given.

    **Returns:** the layers and the Jacobian, and what capacity was needed over what was planned.
    """
    variances = material.gaussians.variances
    given = sources, variances, normalization, seen.points, seen.covered, atlas
    diffused, slopes = diffuse_with_slopes(diffuser, *given, jnp.ones_like(variances))

    def layers(seen, means, exits, slopes_of_means, slopes_of_exits):
        at = Points.of(material, seen, means, exits, diffused.carried).per_channel()

        def exitance(at: Points):
            layers, resolved = at.layers(interval, normalization, variances)
            return jnp.sum(at.weights * layers, axis=0), (layers, resolved)

        total, pull, found = jax.vjp(exitance, at, has_aux=True)
        (slope,) = pull(jnp.ones_like(total))
        of_means = slope.means * slopes_of_means.transpose(1, 2, 0, 3)
        of_exits = slope.exits * slopes_of_exits.transpose(1, 0, 2)[:, None]
        jacobian = slope.weights, slope.variances + of_means + of_exits
        return DiffusionLayers(*_tiles_first(found)), ExitanceJacobian(
            *(each.transpose(2, 0, 1, 3) for each in jacobian)
        )

    found, jacobian = _in_parts(
        layers, seen, diffused.means, diffused.exits, slopes.means, slopes.exits
    )
    return found, jacobian, diffused.needed


def _in_parts(function, *trees):
    return map_chunks(function, *trees, at_once=TILES_AT_ONCE)


def _tiles_first(found):
    layers, resolved = found
    return layers.transpose(2, 0, 1, 3), resolved[:, 0].transpose(1, 0, 2)
