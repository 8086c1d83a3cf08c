"""The layers of surface points, once the light around them is gathered: handover and gain, point by
point.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax.scene import Material

from ._handover import resolved_share
from ._normalization import AbstractNormalization


class SeenSurface(eqx.Module):
    """What the pixels see, with what pass 3 blended for the layers that the splats are too far
    apart to carry.
    """

    points: Float[Array, "tiles 3 pixels"]
    """mm."""
    covered: Bool[Array, "tiles pixels"]
    irradiance: Float[Array, "tiles channels pixels"]
    area: Float[Array, "tiles pixels"]
    """Of a splat, mm^2."""
    albedo: Float[Array, "tiles channels pixels"]
    """What colors the surface, besides the Gaussians' weights."""


class Points(eqx.Module):
    """All that makes the layers of surface points; points, and channels, do not know of each
    other.
    """

    weights: Float[Array, "gaussians channels #tiles #pixels"]
    variances: Float[Array, "gaussians #channels #tiles #pixels"]
    means: Float[Array, "gaussians channels tiles pixels"]
    exits: Float[Array, "gaussians #channels tiles pixels"]
    carried: Float[Array, " gaussians"]
    once: Float[Array, "channels 1 1"]
    irradiance: Float[Array, "channels tiles pixels"]
    """Of the surface itself."""
    area: Float[Array, "tiles pixels"]
    albedo: Float[Array, "channels tiles pixels"]

    @classmethod
    def of(cls, material: Material, seen: SeenSurface, means, exits, carried) -> "Points":
        """Give the points that the pixels see, with the integrals of `Diffused`."""
        gaussians = material.gaussians
        return cls(
            weights=gaussians.weights[:, :, None, None],
            variances=gaussians.variances[:, None, None, None],
            means=means.transpose(1, 2, 0, 3),
            exits=exits.transpose(1, 0, 2)[:, None],
            carried=carried,
            once=(material.total_reflectance() - gaussians.total_reflectance())[:, None, None],
            irradiance=seen.irradiance.transpose(1, 0, 2),
            area=jnp.where(seen.covered, seen.area, 1.0),
            albedo=seen.albedo.transpose(1, 0, 2),
        )

    def per_channel(self) -> "Points":
        """Give every pixel and channel numbers of its own, so that one derivative is that of
        all.
        """
        own = [
            jnp.broadcast_to(each, self.means.shape)
            for each in (self.weights, self.variances, self.exits)
        ]
        return eqx.tree_at(lambda at: (at.weights, at.variances, at.exits), self, own)

    def layers(
        self,
        interval: Float[Array, "2"],
        normalization: AbstractNormalization,
        order: Float[Array, " gaussians"],
    ) -> tuple[
        Float[Array, "gaussians channels tiles pixels"],
        Float[Array, "gaussians #channels tiles pixels"],
    ]:
        resolved = (
            resolved_share(self.variances, self.area[None, None], interval)
            * self.carried[:, None, None, None]
        )
        resolved = jnp.where(self.exits > 0, resolved, 0.0)  # no splat within reach
        own = self.irradiance[None]
        # Splats too far apart to carry a layer do not count its exits either.
        exits = 1 + resolved * (self.exits - 1)
        means = own + resolved * (self.means - own)
        return normalization.gain(
            exits, order, self.weights * self.albedo[None], self.once * self.albedo
        ) * means, resolved
