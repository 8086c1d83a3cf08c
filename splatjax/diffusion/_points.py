"""Continue the layers from splats to points of the surface, and weigh them with a material's
Gaussians.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax.gaussians import SumOfGaussians

from ._diffuser import LayerValues
from ._kernel import AbstractDiffusionKernel, resolved_fraction


def continue_from_splats(layers: LayerValues, centers: Float[Array, "3 splats"]) -> LayerValues:
    """Prepare layers of the splats for blending (Eq. 1): half of each slope goes into the mean.

    `continue_to_points` computes the layer at points from the blended rows.
    """
    return LayerValues(layers.values - 0.5 * _along_slopes(layers, centers), layers.slopes)


def _along_slopes(
    layers: LayerValues, offsets: Float[Array, "3 points"]
) -> Float[Array, "*layers values points"]:
    # Written out, so that it is fused with what reads it: a third of the time of a reduction.
    slopes, above = layers.slopes, range(layers.slopes.ndim - 2)
    along = slopes * jnp.expand_dims(offsets, tuple(above))
    x, y, z = jax.lax.split(along, (1, 1, 1), axis=slopes.ndim - 2)
    return (x + y + z)[..., 0, :]


def continue_to_points(
    blended: LayerValues,
    derivative: LayerValues | None,
    centers: Float[Array, "3 points"],
    points: Float[Array, "3 points"],
    channels: int,
) -> tuple[Float[Array, "*layers values points"], Float[Array, "*layers values points"] | None]:
    r"""Continue blended layers, and their derivatives, to points of the surface.

    Each splat is continued along half its slope: the full slope errs as much as none, with the
    opposite sign, so that the error is of third order in the spacing. Splats lie unevenly around a
    point; the other half of their mean slope, from their mean center, makes up for that:

        L(x) = sum w_i (L_i + s_i (x - p_i) / 2) / W + (sum w_i s_i / W) (x - sum w_i p_i / W) / 2

    Where that is no neighborhood, as where a pixel blends two surfaces, the slope does not carry:
    light and mass stay between 0 and twice what they are at the mean center.

    **Arguments:**

    - `blended`: from the rows of `continue_from_splats`: means of each channel, perhaps those of
      the derivative of the source, and mass.
    - `derivative`: of the same rows; `None` where it is not asked for.
    - `centers`: blended centers of the splats, mm, from the same origin as `points`.
    """

    # The value at the mean center, and the change from there to the point: together the sum above.
    def parts(rows: LayerValues):
        return rows.values + 0.5 * _along_slopes(rows, centers), _along_slopes(
            rows, points - centers
        )

    value, change = parts(blended)
    # Row i is limited where row `limited_like[i]` is: derivatives like the light itself.
    rows = value.shape[-2]
    limited_like = np.append(np.arange(rows - 1) % channels, rows - 1)
    is_below, is_above = (value + change < 0) | (value < 0), change > value
    below, above = is_below[..., limited_like, :], is_above[..., limited_like, :]

    def limited(value, change):
        return jnp.where(below, 0.0, jnp.where(above, 2 * value, value + change))

    return limited(value, change), None if derivative is None else limited(*parts(derivative))


class LayersAtPoints(eqx.Module):
    r"""The light that every layer brings to points of the surface, whatever the layers weigh.

    Weights enter after this, point by point: no splat is looked at again, and derivatives of every
    kind and order exist.

    **Attributes:**

    - `variances`: of the layers, mm^2.
    - `means`, `mass`: of every layer; 0 for layers that no splat resolves.
    - `irradiance`, `area`, `albedo`: of the surface itself; area per splat in mm^2.
    - `interval`, `kernel`: from which width layers are resolved, and how they are normalized.
    - `derivative`: of means and mass in the logarithm of the variance; `None` where it was not
      asked for.
    """

    variances: Float[Array, " gaussians"]
    means: Float[Array, "gaussians channels points"]
    mass: Float[Array, "gaussians points"]
    irradiance: Float[Array, "channels points"]
    area: Float[Array, " points"]
    albedo: Float[Array, "channels points"]
    interval: Float[Array, "2"]
    kernel: AbstractDiffusionKernel
    derivative: (
        tuple[Float[Array, "gaussians channels points"], Float[Array, "gaussians points"]] | None
    )

    # Fields that lie along the points.
    ALONG_POINTS: ClassVar = ("means", "mass", "irradiance", "area", "albedo", "derivative")

    @classmethod
    def of(
        cls,
        variances: Float[Array, " gaussians"],
        gaussians: Int[Array, " layers"],
        layers: Float[Array, "layers values points"],
        derivative: Float[Array, "layers values points"] | None,
        irradiance: Float[Array, "channels points"],
        area: Float[Array, " points"],
        albedo: Float[Array, "channels points"],
        interval: Float[Array, "2"],
        kernel: AbstractDiffusionKernel,
    ) -> "LayersAtPoints":
        """Sort layers at points by their Gaussians.

        **Arguments:**

        - `gaussians`: of the layers, as in a plan.
        - `layers`: means of the channels first, the mass last; those beyond the channels of
          `irradiance` are left out.
        """
        count, channels = len(variances), len(irradiance)
        layer = jnp.full(count, len(gaussians), jnp.int32)
        layer = layer.at[gaussians].set(jnp.arange(len(gaussians), dtype=jnp.int32), mode="drop")

        def by_gaussian(rows):
            rows = rows.at[layer].get(mode="fill", fill_value=0)
            return rows[:, :channels], rows[:, -1]

        means, mass = by_gaussian(layers)
        return cls(
            variances=variances,
            means=means,
            mass=mass,
            irradiance=irradiance,
            area=area,
            albedo=albedo,
            interval=interval,
            kernel=kernel,
            derivative=None if derivative is None else by_gaussian(derivative),
        )

    def weigh(
        self, gaussians: SumOfGaussians, single_scattering_albedo: Float[Array, " channels"]
    ) -> tuple[Float[Array, "gaussians channels points"], Float[Array, "gaussians points"]]:
        r"""Compute the layers `L_k` at every point, and how much of each is the diffusion integral.

        The rest, where the splats are too far apart, is the surface's own irradiance. Constants are
        kept, and `min E <= L_k <= max E`, where the gain of the kernel is 1: everywhere for
        `PlainMean`; for `EscapeNormalization` on flat pieces and at open edges.

        **Arguments:**

        - `gaussians`: the weights tell the kernel how much light is absorbed; the layers are not
          multiplied by them.
        - `single_scattering_albedo`: the fraction that leaves a flat piece as single scattering.
        """
        weights, variances = gaussians.weights[:, :, None], self.variances[:, None, None]
        given = weights, variances, single_scattering_albedo, self.means, self.mass[:, None]
        layers, resolved = self._weigh(*given)
        return layers, resolved[:, 0]

    def _weigh(self, weights, variances, single_scattering_albedo, means, mass):
        resolved = resolved_fraction(variances, self.area[None, None], self.interval)
        resolved = jnp.where(mass > 0, resolved, 0.0)
        own = self.irradiance[None]
        # Splats too far apart to resolve a layer do not tell its mass either.
        gain = self.kernel.gain(
            1 + resolved * (mass - 1),
            self.variances,
            weights * self.albedo[None],
            single_scattering_albedo[:, None] * self.albedo,
        )
        return gain * (own + resolved * (means - own)), resolved

    def exitance(self, gaussians: SumOfGaussians) -> Float[Array, "channels points"]:
        """Compute the radiant exitance `sum_k w_k L_k` of a material without single scattering.
        Differentiable in every mode.

        **Arguments:**

        - `gaussians`: with the derivative, their variances may be a little off those of the layers;
          without it they do not matter.
        """
        weights, variances = gaussians.weights[:, :, None], gaussians.variances[:, None, None]
        return self._exitance(weights, variances, jnp.zeros_like(weights[0, :, 0]))

    def _exitance(self, weights, variances, single_scattering_albedo):
        own = self.variances[:, None, None]
        means, mass = self.means, self.mass[:, None]
        if self.derivative is None:
            variances = own
        else:
            moved = jnp.log(variances / own)
            means = means + moved * self.derivative[0]
            mass = jnp.maximum(mass + moved * self.derivative[1][:, None], 0)
        layers, _ = self._weigh(weights, variances, single_scattering_albedo, means, mass)
        return jnp.sum(weights * layers, axis=0)

    def exitance_jacobian(
        self, gaussians: SumOfGaussians, single_scattering_albedo: Float[Array, " channels"]
    ) -> tuple[
        Float[Array, "gaussians channels points"], Float[Array, "gaussians channels points"]
    ]:
        """Differentiate the radiant exitance of every point and channel in the weights of its
        channel, and in the variances (1/mm^2).

        **Raises:** `ValueError` without the derivative of the layers.
        """
        if self.derivative is None:
            raise ValueError("derivative is None; compute the layers with derivative=True")
        # Every point and channel has numbers of its own, so that one derivative is that of all.
        own = gaussians.weights[:, :, None], gaussians.variances[:, None, None]
        own = tuple(jnp.broadcast_to(each, self.means.shape) for each in own)

        def exitance(weights, variances):
            return self._exitance(weights, variances, single_scattering_albedo)

        total, pull = jax.vjp(exitance, *own)
        return pull(jnp.ones_like(total))
