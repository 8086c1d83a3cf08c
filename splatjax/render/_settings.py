"""How a picture is made: one record per pass, and the objects that carry the passes out."""

import equinox as eqx

from splatjax import diffusion as _diffusion, splatting as _splatting

from ._lighting import AbstractLighting, LightAtSplats


class RenderSettings(eqx.Module):
    r"""How each pass works: the records of its room, and the objects that carry it out.

    **Attributes:**

    - `splatting`: passes 2 and 3: epsilon-z, the screen filter.
    - `shadows`: pass 1: resolution and bias of shadow maps.
    - `diffusion`: pass 4: normalization, and which layers are too narrow for the splats.
    - `rasterizer`: `TileRasterizer()`, or `DenseRasterizer()`, the plain reference.
    - `diffuser`: `ClusterDiffuser()`, or `DenseDiffuser()`, the plain reference.
    - `lighting`: what splats carry into the picture: `LightAtSplats()` has the irradiance in them;
      `splatjax.baselines` has others.
    """

    splatting: _splatting.SplattingSettings = _splatting.SplattingSettings()
    shadows: _splatting.ShadowSettings = _splatting.ShadowSettings()
    diffusion: _diffusion.DiffusionSettings = _diffusion.DiffusionSettings()
    rasterizer: _splatting.AbstractRasterizer = _splatting.TileRasterizer()
    diffuser: _diffusion.AbstractDiffuser = _diffusion.ClusterDiffuser()
    lighting: AbstractLighting = LightAtSplats()
