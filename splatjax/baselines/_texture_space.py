"""Texture-space diffusion (d'Eon and Luebke 2007): light is blurred in the texture of a mesh,
Gaussian by Gaussian.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax.render import Irradiance
from splatjax.scene import Material

from ._blur import blur_along
from ._mesh_light import MeshLight
from ._mesh_raster import Landing, see_faces
from ._textured_mesh import SurfaceTexels, TexturedMesh, look_up_charts, surface_texels
from ._translucent import AbstractThinParts, FarSide, TranslucentShadowMap

# Fraction of the texels whose blur has the full width; wider blurs are cut off.
_WIDEST = 0.995
_SUPPORT = 3.75  # standard deviations


class AbstractStretch(eqx.Module):
    """The extent of a texel on the surface, mm."""

    @abc.abstractmethod
    def millimeters(
        self, extents: Float[Array, "2 height width"], valid: Float[Array, "height width"]
    ) -> Float[Array, "2 height width"]:
        """Convert a texel's extents along u and v, mm, to the extents that the blur uses."""


class StretchCorrected(AbstractStretch):
    """Every texel has its own extent, along u and along v: the stretch map of d'Eon and Luebke."""

    def millimeters(self, extents, valid):
        return extents


class Uncorrected(AbstractStretch):
    """One extent for the whole texture: the root of the mean area of a texel."""

    def millimeters(self, extents, valid):
        return jnp.full_like(extents, _mean_extent(extents, valid))


class TextureSpaceSettings(eqx.Module):
    r"""Settings of texture-space diffusion.

    **Attributes:**

    - `resolution`: texels along an edge of the irradiance map. Static.
    - `stretch`: `StretchCorrected()` or `Uncorrected()`.
    - `thin_parts`: `TranslucentShadowMap()` or `OpaqueParts()`.
    - `kernel`: as in pass 4; the depth of the sources affects only the far side.
    - `shadows`: settings of the lights' shadow maps; the bias is in pixels of the map, since texels
      have no radius.
    """

    resolution: int = eqx.field(static=True, default=1024)
    stretch: AbstractStretch = StretchCorrected()
    thin_parts: AbstractThinParts = TranslucentShadowMap()
    kernel: _diffusion.AbstractDiffusionKernel = _diffusion.EscapeNormalization()
    shadows: _splatting.ShadowSettings = _splatting.ShadowSettings(bias=1.0)


class TextureLayers(eqx.Module):
    r"""Light diffused in a texture.

    **Attributes:**

    - `layers`: one per Gaussian, as `L_k` of pass 4; 0 between the charts.
    - `valid`: 1 on the charts.
    - `entering`: the light before it spreads.
    - `renormalized`: per Gaussian, the mean fraction of its weight that lies between the charts or
      beyond the texture. This light is not lost, but does not cross seams.
    - `needed`: needed over planned capacity; above 1, the plan's capacity is exceeded.
    """

    layers: Float[Array, "gaussians height width channels"]
    valid: Float[Array, "height width"]
    entering: Irradiance
    renormalized: Float[Array, " gaussians"]
    needed: Float[Array, ""]


def rasterize_in_texture(mesh: TexturedMesh, resolution: int, capacity: int) -> SurfaceTexels:
    """Rasterize a mesh in its texture. Differentiable in positions, normals and maps."""
    landing = Landing.in_texture(mesh.uvs, resolution)
    return surface_texels(mesh, landing, see_faces(landing, capacity))


def stretch_map(mesh: TexturedMesh, texels: SurfaceTexels) -> Float[Array, "2 height width"]:
    """Compute every texel's extent along u and v, mm; between the charts, the average extent."""
    seen = texels.seen
    along = jnp.stack(mesh.lengths())[:, seen.faces] / seen.faces.shape[0]
    mean = _mean_extent(along, seen.covered.astype(along.dtype))
    return jnp.where(seen.covered[None], along, mean)


def _mean_extent(
    extents: Float[Array, "2 height width"], valid: Float[Array, "height width"]
) -> Float[Array, ""]:
    """Compute the root of the mean area of the texels on the charts, mm."""
    return jnp.sqrt(jnp.sum(valid * extents[0] * extents[1]) / jnp.sum(valid))


def reaches_of(
    variances: Float[Array, " gaussians"],
    extents: Float[Array, "2 height width"],
    valid: Float[Array, "height width"],
) -> tuple[int, ...]:
    """Compute the reach of each step of the blurs, texels, for concrete variances and extents; per
    step first u, then v.
    """
    widths = np.sqrt(np.diff(np.sort(np.asarray(variances, np.float64)), prepend=0.0))
    on_chart = np.asarray(extents)[:, np.asarray(valid) > 0]
    smallest = np.maximum(np.quantile(on_chart, 1 - _WIDEST, axis=1), 1e-6)
    reaches = np.ceil(_SUPPORT * widths[:, None] / smallest).astype(int) + 1
    return tuple(np.minimum(reaches, valid.shape[0] // 4).ravel().tolist())


def diffuse_in_texture(
    mesh: TexturedMesh,
    texels: SurfaceTexels,
    light: MeshLight,
    material: Material,
    settings: TextureSpaceSettings,
    reaches: tuple[int, ...],
) -> TextureLayers:
    r"""Diffuse light in the texture of a mesh.

    The irradiance map is blurred along u and along v by the difference of successive variances, so
    that layer k is blurred by `v_k` in total; the stretch map is blurred with it. Weights are
    divided by their sum on the charts.

    **Arguments:**

    - `texels`: from `rasterize_in_texture`. Differentiable.
    - `light`: from `mesh_light`. Differentiable.
    - `material`: its Gaussians, in any order. Differentiable.
    - `reaches`: from `reaches_of`. Static.

    **Returns:** `TextureLayers`. Constant light stays constant, and layers lie between the least
    and the greatest irradiance, where the gain of the kernel is 1.

    **Source:** d'Eon, Luebke and Enderton 2007; d'Eon and Luebke 2007 (GPU Gems 3, chapter 14).
    """
    entering = light.entering(texels.points, material)
    valid = texels.seen.covered.astype(entering.source.dtype)
    extents = stretch_map(mesh, texels)
    taken = settings.stretch.millimeters(extents, valid)
    variances = material.gaussians.variances
    average = _mean_extent(extents, valid) * settings.resolution
    far = settings.thin_parts.far_side(texels, light, jnp.sqrt(jnp.max(variances)), average)
    rows = [texels.picture(entering.source.T).transpose(2, 0, 1), taken]
    if far is not None:
        rows.append(far.nearness.reshape(-1, *valid.shape))
    channels, blurred = entering.source.shape[0], jnp.concatenate(rows) * valid[None]
    order, spent = jnp.argsort(variances), jnp.zeros((), variances.dtype)
    means, masses, lost = [], [], []
    for step in range(len(variances)):
        variance = variances[order[step]]
        blurred, kept = _spread(
            blurred, valid, variance - spent, channels, reaches[2 * step : 2 * step + 2]
        )
        spent = variance
        near_side = blurred[:channels].reshape(channels, -1)
        mean, mass = _with_far_side(
            near_side, blurred[channels + 2 :], far, valid, variance, settings
        )
        means.append(mean)
        masses.append(mass)
        lost.append(1 - jnp.sum(kept) / jnp.sum(valid))
    back = jnp.argsort(order)
    layers = _normalized(
        jnp.stack(means)[back], jnp.stack(masses)[back], texels, material, settings
    )
    return TextureLayers(
        layers=texels.picture(layers.transpose(2, 0, 1)).transpose(2, 0, 1, 3)
        * valid[None, :, :, None],
        valid=valid,
        entering=entering,
        renormalized=jnp.cumsum(jnp.stack(lost))[back],
        needed=jnp.maximum(texels.seen.needed, light.needed),
    )


def look_up_layers(
    texture: TextureLayers, uvs: Float[Array, "points 2"]
) -> Float[Array, "gaussians points channels"]:
    """Interpolate the layers at texture coordinates, bilinearly by the texels on the charts."""
    gaussians, height, width, channels = texture.layers.shape
    picture = texture.layers.transpose(1, 2, 0, 3).reshape(height, width, -1)
    return (
        look_up_charts(picture, texture.valid, uvs)
        .reshape(-1, gaussians, channels)
        .transpose(1, 0, 2)
    )


def _spread(rows, valid, variance, channels: int, reaches: tuple[int, ...]):
    """Blur along u and along v, each scaled by the local stretch; also return the fraction of the
    weights that was on the charts.
    """
    kept = valid
    for axis, extent, reach in ((1, channels, reaches[0]), (0, channels + 1, reaches[1])):
        size = jnp.where(valid > 0, rows[extent], 1.0)
        widest = (reach / _SUPPORT) ** 2
        variance_in_texels = jnp.minimum(variance / (size * size), widest)
        sums = blur_along(axis, rows, valid, lambda chart: chart, variance_in_texels, reach)
        rows = sums.renormalized() * valid[None]
        kept = kept * sums.trusted / sums.total
    return rows, kept


def _with_far_side(
    near_side, nearness, far: FarSide | None, valid, variance, settings: TextureSpaceSettings
):
    """Compute mean and kernel mass of the texel's own surroundings and of the far side."""
    if far is None:
        return near_side, jnp.ones_like(near_side[:1])
    depth = settings.kernel.depths(variance[None])[0]
    share = far.share(nearness.reshape(nearness.shape[0], -1), variance, depth)
    picture = near_side.T.reshape(*valid.shape, -1)
    total, weight = near_side, jnp.ones_like(near_side[:1])
    for uvs, own_share in zip(far.uvs, share, strict=True):
        total = total + own_share[None] * look_up_charts(picture, valid, uvs).T
        weight = weight + own_share[None]
    return total / weight, weight


def _normalized(
    means, mass, texels: SurfaceTexels, material: Material, settings: TextureSpaceSettings
):
    weights = material.gaussians.weights
    albedo = texels.points.albedo
    albedo = jnp.ones((1, *means.shape[1:]), means.dtype) if albedo is None else albedo.T[None]
    single = material.total_reflectance() - material.gaussians.total_reflectance()
    variances, colored = material.gaussians.variances, weights[:, :, None] * albedo
    gain = settings.kernel.gain(mass, variances, colored, single[:, None] * albedo[0])
    return gain * means
