"""Pass 4: splat-based diffusion (section 4.2), one layer per Gaussian."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.scene import Material
from splatjax.splatting import AbstractView, Surface

from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources
from ._handover import resolved_share
from ._normalization import AbstractNormalization


class DiffusionLayers(eqx.Module):
    """The layers `L_k` of one surface, and how much of each is the diffusion integral, not the surface's own irradiance."""

    layers: Float[Array, "gaussians channels height width"]
    resolved: Float[Array, "gaussians height width"]


class ExitanceJacobian(eqx.Module):
    """What radiant exitance does per change of the material; the channels of the weights do not mix."""

    weights: Float[Array, "gaussians channels height width"]
    variances: Float[Array, "gaussians channels height width"]
    """1/mm^2."""


class SeenSurface(eqx.Module):
    """A surface as the pixels see it, with what pass 3 blended for the layers that the splats are too far apart to carry."""

    surface: Surface
    irradiance: Float[Array, "channels height width"]
    area: Float[Array, "height width"]
    """Of a splat, mm^2."""
    albedo: Float[Array, "channels height width"]
    """What colors the surface, besides the Gaussians' weights."""


def pixel_points(view: AbstractView, depth: Float[Array, "height width"]) -> Float[Array, "3 height width"]:
    """Give the points (mm) that the pixels see at a depth (mm)."""
    x = jnp.arange(view.width, dtype=depth.dtype)[None] + 0.5
    y = jnp.arange(view.height, dtype=depth.dtype)[:, None] + 0.5
    return view.unproject(jnp.broadcast_to(x, depth.shape), jnp.broadcast_to(y, depth.shape), depth)


def diffusion_layers(
    sources: Sources,
    material: Material,
    seen: Sequence[SeenSurface],
    interval: Float[Array, "2"],
    view: AbstractView,
    diffuser: AbstractDiffuser,
    normalization: AbstractNormalization,
) -> tuple[list[DiffusionLayers], Float[Array, ""]]:
    r"""Diffuse the irradiance of the splats to the points that the pixels see.

    **Arguments:**

    - `sources`: centers (mm), normals, areas (mm^2) and irradiance of the splats. Differentiable.
    - `material`: its Gaussians, one per layer. Their weights tell the normalization how much light is absorbed; the layers are
      not multiplied by them. Differentiable.
    - `seen`: the surface in front, and the one that shows behind its silhouettes. Differentiable.
    - `interval`: from `handover_interval`.

    **Returns:** the layers of both, without weights, and what capacity was needed over what was planned. They are linear in the
    light. For weights that are not negative and sum to one or less, their weighted sum is at most the greatest irradiance; where
    they sum to one it keeps constants. Each layer keeps constants, and `min E <= L_k <= max E`, where the normalization's gain
    is 1: everywhere for `PlainMean`; for `ExitOdds` on flat pieces and at open edges.

    **Source:** Kim et al. 2010, section 4.2; the normalization's own.
    """
    points, covered = _receivers(seen, view)
    variances = material.gaussians.variances
    diffused = diffuser.diffuse(sources, _kernels(variances, normalization), points, covered, view)
    found = []
    for place, each in enumerate(seen):
        at = _Point.of(material, each, diffused, covered, place)
        layers, resolved = at.layers(interval, normalization, variances)
        found.append(DiffusionLayers(layers, resolved[:, 0]))
    return found, diffused.needed


def exitance_jacobian(
    sources: Sources,
    material: Material,
    seen: Sequence[SeenSurface],
    interval: Float[Array, "2"],
    view: AbstractView,
    diffuser: AbstractDiffuser,
    normalization: AbstractNormalization,
) -> tuple[list[DiffusionLayers], list[ExitanceJacobian], Float[Array, ""]]:
    r"""Diffuse, and differentiate the radiant exitance `M = sum_k w_k L_k` of every pixel in the weights and the variances.

    Layer k gathers light by its own variance alone, so one more accumulation per layer, of `A E dG/dv` and `A dG/dv`, serves the
    whole Jacobian; the rest is done pixel by pixel. Where the normalization's gain is 1 the derivative in a
    weight is the layer itself.

    **Arguments:** as in `diffusion_layers`; the irradiance counts as given.

    **Returns:** the layers and the Jacobian, of both surfaces, and what capacity was needed over what was planned.
    """
    points, covered = _receivers(seen, view)
    variances = material.gaussians.variances
    forward = diffuser.in_forward_mode()

    def diffuse(variances):
        return forward.diffuse(sources, _kernels(variances, normalization), points, covered, view)

    diffused, slopes = jax.jvp(diffuse, (variances,), (jnp.ones_like(variances),))
    layers, jacobians = [], []
    for place, each in enumerate(seen):
        at = _Point.of(material, each, diffused, covered, place).per_channel()

        def exitance(at: _Point):
            layers, resolved = at.layers(interval, normalization, variances)
            return jnp.sum(at.weights * layers, axis=0), DiffusionLayers(layers, resolved[:, 0])

        total, pull, found = jax.vjp(exitance, at, has_aux=True)
        (slope,) = pull(jnp.ones_like(total))
        of_means = slope.means * slopes.means[:, place]
        of_exits = slope.exits * slopes.exits[:, place][:, None]
        layers.append(found)
        jacobians.append(ExitanceJacobian(slope.weights, slope.variances + of_means + of_exits))
    return layers, jacobians, diffused.needed


def _kernels(variances: Float[Array, " gaussians"], normalization: AbstractNormalization) -> Kernels:
    return Kernels(variances, normalization.depths(variances))


def _receivers(seen: Sequence[SeenSurface], view: AbstractView):
    """Give the points of all surfaces, and where there is one."""
    covered = jnp.stack([stop_gradient(each.surface.weight_sum) > 0 for each in seen])
    return jnp.stack([pixel_points(view, each.surface.depth) for each in seen]), covered


class _Point(eqx.Module):
    """All that makes the layers of a pixel; pixels, and channels, do not know of each other."""

    weights: Float[Array, "gaussians channels #height #width"]
    variances: Float[Array, "gaussians #channels #height #width"]
    means: Float[Array, "gaussians channels height width"]
    exits: Float[Array, "gaussians #channels height width"]
    carried: Float[Array, " gaussians"]
    once: Float[Array, "channels 1 1"]
    surface: SeenSurface
    area: Float[Array, "height width"]

    @classmethod
    def of(cls, material: Material, seen: SeenSurface, diffused: Diffused, covered, place: int) -> "_Point":
        gaussians = material.gaussians
        return cls(
            weights=gaussians.weights[:, :, None, None],
            variances=gaussians.variances[:, None, None, None],
            means=diffused.means[:, place],
            exits=diffused.exits[:, place][:, None],
            carried=diffused.carried,
            once=(material.total_reflectance() - gaussians.total_reflectance())[:, None, None],
            surface=seen,
            area=jnp.where(covered[place], seen.area, 1.0),
        )

    def per_channel(self) -> "_Point":
        """Give every pixel and channel numbers of its own, so that one derivative is that of all."""
        own = [jnp.broadcast_to(each, self.means.shape) for each in (self.weights, self.variances, self.exits)]
        return eqx.tree_at(lambda at: (at.weights, at.variances, at.exits), self, own)

    def layers(
        self, interval: Float[Array, "2"], normalization: AbstractNormalization, order: Float[Array, " gaussians"]
    ) -> tuple[Float[Array, "gaussians channels height width"], Float[Array, "gaussians #channels height width"]]:
        resolved = resolved_share(self.variances, self.area[None, None], interval) * self.carried[:, None, None, None]
        resolved = jnp.where(self.exits > 0, resolved, 0.0)  # no splat within reach
        own = self.surface.irradiance[None]
        # Splats too far apart to carry a layer do not count its exits either.
        exits = 1 + resolved * (self.exits - 1)
        means = own + resolved * (self.means - own)
        albedo = self.surface.albedo
        return normalization.gain(exits, order, self.weights * albedo[None], self.once * albedo) * means, resolved
