"""The point-based methods that the paper compares with its own, as settings of this renderer."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax import shading as _shading
from splatjax.render import LightAtSplats, RenderSettings
from splatjax.scene import Frame

from ._blending import BlendingRasterizer
from ._kernels import DiscKernel, DiscOrPixelKernel, EwaKernel
from ._lighting import LightAtPixels, NormalFields
from ._nearest import NearestRasterizer


def elliptical_points(settings: RenderSettings = RenderSettings()) -> RenderSettings:
    """Return settings that draw elliptical points: the nearest splat wins, and has one color, as in
    flat shading.

    Neither color nor normals are interpolated, and nothing is filtered. Figure 7, left.
    """
    return replace(settings, rasterizer=NearestRasterizer(), lighting=LightAtSplats())


def ewa_splatting(settings: RenderSettings = RenderSettings()) -> RenderSettings:
    """Return settings that splat surfaces with the elliptical weighted average: the splat's kernel
    is blurred by the pixel's filter.

    The projection is affine; where splats are large in the picture and the perspective is strong,
    small holes open. Shading is per pixel.

    **Source:** Zwicker et al. 2001, "Surface Splatting".
    """
    return replace(settings, rasterizer=BlendingRasterizer(EwaKernel()), lighting=LightAtPixels())


def phong_splatting(settings: RenderSettings = RenderSettings()) -> RenderSettings:
    """Return settings for Phong splatting: normals vary linearly within each splat, and nothing is
    filtered in the picture.

    Few splats suffice for a smooth surface; splats smaller than a pixel alias. The scene must
    contain `PhongSplats`.

    **Source:** Botsch et al. 2004, "Phong Splatting".
    """
    return replace(settings, rasterizer=BlendingRasterizer(DiscKernel()), lighting=NormalFields())


def deferred_splatting(settings: RenderSettings = RenderSettings()) -> RenderSettings:
    """Return settings for high-quality deferred splatting: attributes are blended, with a filter
    for small splats, then shaded.

    Figure 7, middle.

    **Source:** Botsch et al. 2005, "High-Quality Surface Splatting on Today's GPUs".
    """
    return replace(
        settings, rasterizer=BlendingRasterizer(DiscOrPixelKernel()), lighting=LightAtPixels()
    )


def exitance(frame: Frame) -> Float[Array, "height width channels"]:
    """Compute the radiant exitance of a picture before the exit half of the albedo, for a surface
    without a change of index (`eta` 1).

    It is the weighted sum of the layers `L_k`; 0 where no surface is visible.
    """
    is_covered = frame.coverage > 0
    share = jnp.where(is_covered, frame.coverage, 1.0)[..., None]
    spread = jnp.pi * frame.diffuse / (share * _shading.albedo_root(frame.albedo / share))
    return jnp.where(is_covered[..., None], spread, 0.0)
