"""Light that is gathered once, for any weights: what of pass 4 depends on the variances alone."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.devices import Devices
from splatjax.gaussians import SumOfGaussians
from splatjax.splatting import Atlas

from ._diffuser import AbstractDiffuser, Diffused, Kernels, Sources, diffuse_with_slopes
from ._handover import resolved_share
from ._normalization import AbstractNormalization
from ._points import Points, SeenSurface


class GatheredSlopes(eqx.Module):
    """What the diffusion integrals and their denominators do per change of the logarithm of their
    layer's variance.
    """

    means: Float[Array, "gaussians channels points"]
    exits: Float[Array, "gaussians points"]


class GatheredLight(eqx.Module):
    r"""The light that each layer brings to points of the surface, before it is known how much of it
    each layer carries.

    Weights enter after this, point by point: `exitance` costs no look at any splat, and has
    derivatives of every kind and order.

    **Attributes:**

    - `variances`: of the layers, mm^2.
    - `means`, `exits`: the diffusion integrals and their denominators, as `Diffused` has them.
    - `carried`: 0 for a layer that is narrower than the splats.
    - `irradiance`, `area`, `albedo`: of the surface itself; mm^2.
    - `interval`, `normalization`: of the layers' handover, and of their gain.
    - `slopes`: where variances may move a little; `None` where they are held.
    """

    variances: Float[Array, " gaussians"]
    means: Float[Array, "gaussians channels points"]
    exits: Float[Array, "gaussians points"]
    carried: Float[Array, " gaussians"]
    irradiance: Float[Array, "channels points"]
    area: Float[Array, " points"]
    albedo: Float[Array, "channels points"]
    interval: Float[Array, "2"]
    normalization: AbstractNormalization
    slopes: GatheredSlopes | None = None

    def of_all(self, devices: Devices) -> "GatheredLight":
        """Give the light at the points of all devices, one after the other."""

        def gathered(rows: Float[Array, "*rows points"]) -> Float[Array, "*rows all"]:
            return jnp.moveaxis(devices.everything(jnp.moveaxis(rows, -1, 0)), 0, -1)

        def parts(light: "GatheredLight"):
            own = light.means, light.exits, light.irradiance, light.area, light.albedo
            return own if light.slopes is None else (*own, light.slopes.means, light.slopes.exits)

        return eqx.tree_at(parts, self, [gathered(rows) for rows in parts(self)])

    def resolved(self) -> Float[Array, " gaussians"]:
        """Give the share of the points at which the splats carry each layer."""
        shape = (len(self.variances), len(self.area))
        variances, area = (
            jnp.broadcast_to(each, shape) for each in (self.variances[:, None], self.area[None])
        )
        return self.carried * jnp.mean(resolved_share(variances, area, self.interval), axis=1)

    def exitance(self, gaussians: SumOfGaussians) -> Float[Array, "channels points"]:
        """Give the radiant exitance `sum_k w_k L_k` of a material without single scattering.
        Differentiable.

        **Arguments:**

        - `gaussians`: variances near those of the layers, which are moved along their slopes;
          without slopes they do not matter.
        """
        variances, means, exits = self.variances, self.means, self.exits
        if self.slopes is not None:
            moved = jnp.log(gaussians.variances / variances)[:, None]
            variances = gaussians.variances
            means = means + moved[..., None] * self.slopes.means
            exits = jnp.maximum(exits + moved * self.slopes.exits, 0)
        weights = gaussians.weights
        points = Points(
            weights=weights[:, :, None, None],
            variances=variances[:, None, None, None],
            means=means[:, :, None],
            exits=exits[:, None, None],
            carried=self.carried,
            once=jnp.zeros((weights.shape[1], 1, 1), weights.dtype),
            irradiance=self.irradiance[:, None],
            area=self.area[None],
            albedo=self.albedo[:, None],
        )
        layers, _ = points.layers(self.interval, self.normalization, variances)
        return jnp.sum(weights[:, :, None] * layers[:, :, 0], axis=0)


def gather_light(
    sources: Sources,
    variances: Float[Array, " gaussians"],
    seen: SeenSurface,
    interval: Float[Array, "2"],
    atlas: Atlas,
    diffuser: AbstractDiffuser,
    normalization: AbstractNormalization,
) -> tuple[GatheredLight, Float[Array, ""]]:
    """Diffuse the irradiance of the splats to the points that the pixels see, for any weights.

    **Arguments:** as in `diffusion_layers`.

    **Returns:** the light at every point of every tile, tile by tile, and what capacity was needed
    over what was planned.
    """
    found = diffuser.diffuse(
        sources, Kernels.of(variances, normalization), seen.points, seen.covered, atlas
    )
    return _in_a_row(found, None, variances, seen, interval, normalization), found.needed


def gather_light_and_slopes(
    sources: Sources,
    variances: Float[Array, " gaussians"],
    seen: SeenSurface,
    interval: Float[Array, "2"],
    atlas: Atlas,
    diffuser: AbstractDiffuser,
    normalization: AbstractNormalization,
) -> tuple[GatheredLight, Float[Array, ""]]:
    """Diffuse as `gather_light`, and differentiate in the variances: one more accumulation per
    layer.
    """
    given = sources, variances, normalization, seen.points, seen.covered, atlas
    found, slopes = diffuse_with_slopes(diffuser, *given, variances)
    return _in_a_row(found, slopes, variances, seen, interval, normalization), found.needed


Gather: TypeAlias = Callable[..., tuple[GatheredLight, Array]]
"""`gather_light`, or `gather_light_and_slopes`."""


def _in_a_row(
    found: Diffused,
    slopes: Diffused | None,
    variances: Array,
    seen: SeenSurface,
    interval: Array,
    normalization,
) -> GatheredLight:
    def row(tiles: Float[Array, "tiles *rows pixels"]) -> Float[Array, "*rows points"]:
        return jnp.moveaxis(tiles, 0, -2).reshape(*tiles.shape[1:-1], -1)

    return GatheredLight(
        variances=variances,
        means=row(found.means),
        exits=row(found.exits),
        carried=found.carried,
        irradiance=row(seen.irradiance),
        area=jnp.where(seen.covered, seen.area, 1.0).reshape(-1),
        albedo=row(seen.albedo),
        interval=interval,
        normalization=normalization,
        slopes=None if slopes is None else GatheredSlopes(row(slopes.means), row(slopes.exits)),
    )
