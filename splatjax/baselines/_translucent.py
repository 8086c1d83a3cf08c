"""The far side of thin parts in texture space: ignored, or by a translucent shadow map."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jax.lax import stop_gradient
from jaxtyping import Array, Float

from splatjax.splatting import TILE_SIDE, TileGrid

from ._mesh_light import MeshLight, MeshShadow
from ._textured_mesh import SurfaceTexels

# Distance in the texture, in standard deviations of a layer, at which the blur no longer connects
# two texels.
_APART = 6.0


class FarSide(eqx.Module):
    """For each texel and each light with a shadow map, the point on the far side where light
    enters.
    """

    uvs: Float[Array, "lights points 2"]
    nearness: Float[Array, "lights points"]
    """`exp(-thickness / scale)`: 0 where there is no far side, 1 where it is close."""
    apart: Float[Array, "lights points"]
    """Distance in the texture from the texel to this point, in average mm of the texture."""
    scale: Float[Array, ""]
    """mm."""

    def share(
        self,
        nearness: Float[Array, "lights points"],
        variance: Float[Array, ""],
        depth: Float[Array, ""],
    ):
        """Compute the weight of the far side in a layer, relative to the texel's own surroundings,
        `[lights, points]`.
        """
        is_far = nearness > 0
        thickness = -self.scale * jnp.log(jnp.where(is_far, nearness, 1.0))
        beyond = thickness - depth  # the source lies below its own surface, so nearer to this one
        fade = jnp.exp(-0.5 * (beyond * beyond - depth * depth) / variance)
        apart = jnp.clip(self.apart / (_APART * jnp.sqrt(variance)), 0, 1)
        return jnp.where(is_far, fade * apart, 0.0)


class AbstractThinParts(eqx.Module):
    """The transmission of light through thin parts."""

    @abc.abstractmethod
    def far_side(
        self,
        texels: SurfaceTexels,
        light: MeshLight,
        widest: Float[Array, ""],
        millimeters: Float[Array, ""],
    ) -> FarSide | None:
        """Find the far side of each texel; `widest` is the widest layer's standard deviation,
        `millimeters` the average length of a texture's edge.
        """


class OpaqueParts(AbstractThinParts):
    """No transmission: only the texture is blurred."""

    def far_side(self, texels, light, widest, millimeters):
        return None


class TranslucentShadowMap(AbstractThinParts):
    r"""A shadow map with the texture coordinates and the distance of the point where light enters
    (the modified map of d'Eon and Luebke).

    A Gaussian is separable in depth too: the transmitted light is the blurred light of the far side
    times `exp(-d^2 / 2v)`. The thickness `d` is measured along the light, reduced by the cosine
    where the two sides face apart, and blurred with the light. Texels that face the light, or are
    lit by the shadow map, have no far side. If the far side is close in the texture, the blur
    already includes its light.

    **Source:** d'Eon and Luebke 2007 (GPU Gems 3, chapter 14.5), after Dachsbacher and Stamminger
    2003.
    """

    def far_side(self, texels, light, widest, millimeters):
        sides = [
            self._of(texels, shadow, light.settings.bias, widest)
            for shadow in light.shadows
            if shadow is not None
        ]
        if not sides:
            return None
        uvs, nearness = (jnp.stack(rows) for rows in zip(*sides, strict=True))
        offset = uvs - texels.uvs[None]
        return FarSide(
            uvs, nearness, millimeters * jnp.sqrt(jnp.sum(offset * offset, axis=2)), widest
        )

    def _of(self, texels: SurfaceTexels, shadow: MeshShadow, bias: float, scale: Float[Array, ""]):
        view, (front, coverage, *_) = shadow.depths.view, shadow.depths.planes
        points, normals = texels.points.centers, texels.points.normals
        x, y, depth = view.project(points.T)
        column = jnp.clip(stop_gradient(jnp.floor(x)).astype(jnp.int32), 0, view.width - 1)
        row = jnp.clip(stop_gradient(jnp.floor(y)).astype(jnp.int32), 0, view.height - 1)
        tile, pixel = jnp.divmod(TileGrid(view.width, view.height).pixel(column, row), TILE_SIDE**2)
        entered, lit = shadow.attributes[tile, :, pixel].T, coverage[tile, pixel] > 0
        entry = view.unproject(
            x, y, jnp.where(lit, jnp.minimum(front[tile, pixel], depth), depth)
        ).T
        squared = jnp.sum((points - entry) ** 2, axis=1)
        way = jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
        wi, _ = shadow.light.incidence(points)
        cosine = jnp.sum(wi * normals, axis=1)
        opposite = jnp.clip(-jnp.sum(entered[2:].T * normals, axis=1), 0, 1)
        thickness = way + opposite * (jnp.clip(-cosine, 0, 1) * way - way)
        # The bias is in diagonals of a pixel, because texels have no extent.
        least = bias * 2**0.5 * view.pixel_size(depth)
        is_far = lit & (cosine < 0) & (depth > front[tile, pixel] + least)
        return entered[:2].T, jnp.where(is_far, jnp.exp(-thickness / scale), 0.0)
