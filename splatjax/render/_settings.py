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
    - `sample_shadows`: those of the maps of the samples of extended lights: many, so that each is
      coarser. `ShadowSettings()` makes them like those of other lights.
    - `bounces`: how many times light that has left the body may enter it again. Static.
    - `sightlines`: in how many directions each splat sees the body, for these.
    - `kernel`: pass 4: how a layer spreads, is normalized, and when the splats resolve it:
      `EscapeNormalization()`, or `PlainMean()`, the paper's.
    - `rasterizer`: `TileRasterizer()`, or `DenseRasterizer()`, the plain reference.
    - `diffuser`: `ClusterDiffuser()`; `DenseDiffuser()`, the plain reference; or `ShapeDiffuser()`,
      which solves the diffusion equation in the body itself.
    - `lighting`: what the splats carry into the picture: `LightAtSplats()` blends their irradiance;
      `splatjax.baselines` has others.
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
