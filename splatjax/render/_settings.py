"""Settings of each pass, and where irradiance is computed: at the splats, by default."""

import abc

import equinox as eqx
from jaxtyping import Array, Float

from splatjax import diffusion as _diffusion, splatting as _splatting
from splatjax._records import record, valid
from splatjax.scene import (
    AbstractLightSample,
    DistantStratum,
    EmitterStratum,
    Scene,
    StackedLights,
)

from ._lighting import (
    Irradiance,
    LightVisibility,
    single_scattering_at_splats,
)
from ._surface import SurfaceAttributes, SurfaceSamples, surface_parameters


class AbstractLighting(eqx.Module):
    """Which splat attributes are blended, and how the blended attributes are used at the pixels
    before shading.
    """

    def attributes(
        self,
        scene: Scene,
        light: LightVisibility,
        irradiance: Irradiance,
        eye: Float[Array, "3"],
    ) -> SurfaceAttributes:
        """Collect the attributes that passes 2 and 3 blend, except for the layers of pass 4. A
        subclass adds its own as `extra`.
        """
        splats = scene.splats
        specular, roughness = surface_parameters(scene.material, splats)
        return SurfaceAttributes(
            normals=splats.normals.T,
            area=splats.areas[None],
            source=irradiance.source,
            albedo=None if splats.albedo is None else splats.albedo.T,
            irradiance=None if splats.albedo is None else irradiance.entering,
            specular=None if splats.specular is None else specular[None],
            roughness=None if splats.roughness is None else roughness[None],
            visibility=light.per_light(splats.centers, splats.normals),
            single_scattering=single_scattering_at_splats(scene, light, eye),
            weights=_diffusion.Sources.of(splats, irradiance.source).weights,
        )

    @abc.abstractmethod
    def at_pixels(
        self, scene: Scene, groups: list[StackedLights], samples: SurfaceSamples
    ) -> SurfaceAttributes:
        """Compute the inputs of passes 4 and 5 from the attributes blended at the pixels."""


class LightAtSplats(AbstractLighting):
    """The irradiance of the splats, blended like all attributes."""

    def at_pixels(self, scene, groups, samples):
        return samples.attributes


@record
class RenderSettings(eqx.Module):
    r"""Settings of the passes, and the algorithms that compute them.

        settings = RenderSettings(bounces=1, shadows=ShadowSettings(resolution=2048))
        frame = render(scene, camera, settings, make_plan(scene, camera, settings))

    Pass the same settings to `make_plan` and to `render`. The defaults suit most pictures. Change
    `bounces` for light that leaves the body and lights it again, `diffuser` for less time
    (`ExitanceDiffuser`) or thin parts (`ShapeDiffuser`), and `sample_shadows` for sharper shadows
    of environments and area lights.

    **Attributes:** (their classes are in `splatjax.splatting` and `splatjax.diffusion`)

    - `splatting`: passes 2 and 3: the depth within which fragments belong to the front surface
      (epsilon-z), the filter of splats smaller than a pixel, and the coverage of outlines.
    - `shadows`: pass 1: resolution, bias and softness of shadow maps.
    - `sample_shadows`: the same for environments and area lights. They have many samples, so each
      map is coarser; `ShadowSettings()` makes it as fine as those of other lights.
    - `bounces`: number of times that light may leave the body and enter it again. Static.
    - `sightlines`: the directions in which each splat searches the body, for bounces.
    - `kernel`: pass 4: source depth, normalization, and resolution of a layer. By default
      `EscapeNormalization()`; `PlainMean()` is the kernel of the paper.
    - `rasterizer`: algorithm of passes 1 to 3. By default `TileRasterizer()`; `DenseRasterizer()`
      is the plain reference.
    - `diffuser`: algorithm of pass 4. By default `ClusterDiffuser()`. `ExitanceDiffuser()` takes
      less time and has no separate layers; `ShapeDiffuser()` solves the diffusion equation in the
      body; `DenseDiffuser()` is the plain reference.
    - `lighting`: where irradiance is computed. By default `LightAtSplats()`, which blends the
      irradiance of the splats; `splatjax.baselines` has other classes.
    """

    splatting: _splatting.SplattingSettings = _splatting.SplattingSettings()
    shadows: _splatting.ShadowSettings = _splatting.ShadowSettings()
    sample_shadows: _splatting.ShadowSettings = _splatting.ShadowSettings(
        resolution=512, compared=2, merged_spacing=4.0
    )
    bounces: int = eqx.field(static=True, default=0, metadata=valid("0 or more", lambda n: n >= 0))
    sightlines: _splatting.SightlineSettings = _splatting.SightlineSettings()
    kernel: _diffusion.AbstractDiffusionKernel = _diffusion.EscapeNormalization()
    rasterizer: _splatting.AbstractRasterizer = _splatting.TileRasterizer()
    diffuser: _diffusion.AbstractDiffuser = _diffusion.ClusterDiffuser()
    lighting: AbstractLighting = LightAtSplats()

    def __check_init__(self):
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
