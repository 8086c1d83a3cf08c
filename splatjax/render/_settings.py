"""How each pass works."""

import equinox as eqx

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax._records import check_values
from splatjax.scene import AbstractLightSample, DistantStratum, EmitterStratum

from ._lighting import AbstractLighting, LightAtSplats


class RenderSettings(eqx.Module):
    r"""How each pass works.

    **Attributes:**

    - `splatting`: passes 2 and 3: epsilon-z, the screen filter.
    - `shadows`: pass 1: resolution and bias of shadow maps.
    - `sample_shadows`: the same for the samples of extended lights, which are many, so each map is
      coarser. `ShadowSettings()` makes them as fine as those of other lights.
    - `bounces`: number of times that light may leave the body and enter it again. Static.
    - `sightlines`: the directions in which each splat sees the body, for bounces.
    - `kernel`: pass 4: source depth, normalization, and resolution of a layer:
      `EscapeNormalization()`, or `PlainMean()`, the paper's.
    - `rasterizer`: `TileRasterizer()`, or `DenseRasterizer()`, the plain reference.
    - `diffuser`: `ClusterDiffuser()`; `DenseDiffuser()`, the plain reference; or `ShapeDiffuser()`,
      which solves the diffusion equation in the body.
    - `lighting`: `LightAtSplats()` blends the irradiance of the splats; `splatjax.baselines` has
      others.
    """

    splatting: _splatting.SplattingSettings = _splatting.SplattingSettings()
    shadows: _splatting.ShadowSettings = _splatting.ShadowSettings()
    sample_shadows: _splatting.ShadowSettings = _splatting.ShadowSettings(
        resolution=512, compared=2, merged_spacing=4.0
    )
    bounces: int = eqx.field(static=True, default=0)
    sightlines: _splatting.SightlineSettings = _splatting.SightlineSettings()
    kernel: _diffusion.AbstractDiffusionKernel = _diffusion.EscapeNormalization()
    rasterizer: _splatting.AbstractRasterizer = _splatting.TileRasterizer()
    diffuser: _diffusion.AbstractDiffuser = _diffusion.ClusterDiffuser()
    lighting: AbstractLighting = LightAtSplats()

    def __check_init__(self):
        check_values("bounces", self.bounces, "0 or more", lambda n: n >= 0)
        if self.bounces and not isinstance(self.lighting, LightAtSplats):
            raise ValueError(
                f"bounces is {self.bounces} and lighting is {type(self.lighting).__name__}; "
                "light bounces only between splats; give bounces=0, or "
                "lighting=LightAtSplats()"
            )

    def shadows_of(self, light: AbstractLightSample) -> _splatting.ShadowSettings:
        """Return the settings of the shadow maps of a light or sample."""
        is_sample = isinstance(light, DistantStratum | EmitterStratum)
        return self.sample_shadows if is_sample else self.shadows
