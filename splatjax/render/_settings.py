"""How a picture is made: the settings of each pass, and the objects that carry the passes out."""

import equinox as eqx

from splatjax import diffusion as _diffusion, splatting as _splatting

from ._lighting import AbstractLighting, LightAtSplats


class RenderSettings(eqx.Module):
    r"""How each pass works.

    **Attributes:**

    - `splatting`: passes 2 and 3: epsilon-z, the screen filter.
    - `shadows`: pass 1: resolution and bias of shadow maps.
    - `kernel`: pass 4: how a layer spreads, is normalized, and when the splats resolve it:
      `EscapeNormalization()`, or `PlainMean()`, the paper's.
    - `rasterizer`: `TileRasterizer()`, or `DenseRasterizer()`, the plain reference.
    - `diffuser`: `ClusterDiffuser()`, or `DenseDiffuser()`, the plain reference.
    - `lighting`: what the splats carry into the picture: `LightAtSplats()` blends their irradiance;
      `splatjax.baselines` has others.
    """

    splatting: _splatting.SplattingSettings = _splatting.SplattingSettings()
    shadows: _splatting.ShadowSettings = _splatting.ShadowSettings()
    kernel: _diffusion.AbstractDiffusionKernel = _diffusion.EscapeNormalization()
    rasterizer: _splatting.AbstractRasterizer = _splatting.TileRasterizer()
    diffuser: _diffusion.AbstractDiffuser = _diffusion.ClusterDiffuser()
    lighting: AbstractLighting = LightAtSplats()
