"""How a picture is made: one record per pass, and the objects that carry the passes out."""

import equinox as eqx

from splatjax import diffusion as _diffusion, splatting as _splatting

from ._lighting import AbstractLighting, LightAtSplats


class RenderSettings(eqx.Module):
    """How each pass works: the records of its room, and the objects that carry it out."""

    splatting: _splatting.SplattingSettings = _splatting.SplattingSettings()
    shadows: _splatting.ShadowSettings = _splatting.ShadowSettings()
    diffusion: _diffusion.DiffusionSettings = _diffusion.DiffusionSettings()
    rasterizer: _splatting.AbstractRasterizer = _splatting.TileRasterizer()
    diffuser: _diffusion.AbstractDiffuser = _diffusion.ClusterDiffuser()
    lighting: AbstractLighting = LightAtSplats()
