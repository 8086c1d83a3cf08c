"""The five passes: plan the sizes of their arrays, then render.

The formulas of the passes are in splatting, diffusion and shading.
"""

# Read `Passes` in `_passes.py` first: every picture is one call of `Passes.picture`. Its arguments
# are the function that lights the splats (`light_at`) and the function that reads the shaded points
# (`read`). `_render.py` has the simplest pictures, and `_devices.py` the distribution over devices.

from ._basis import (
    diffusion_basis as diffusion_basis,
    DiffusionBasis as DiffusionBasis,
    relighting_basis as relighting_basis,
    RelightingBasis as RelightingBasis,
)
from ._checks import (
    BYTES_PER_PIXEL as BYTES_PER_PIXEL,
    BYTES_PER_SPLAT as BYTES_PER_SPLAT,
    check_scene as check_scene,
)
from ._jacobian import picture_jacobian as picture_jacobian, PictureJacobian as PictureJacobian
from ._lighting import (
    Irradiance as Irradiance,
    irradiance_at_points as irradiance_at_points,
    irradiance_at_splats as irradiance_at_splats,
    LightVisibility as LightVisibility,
    shadow_views as shadow_views,
    Transfer as Transfer,
)
from ._passes import SplatLight as SplatLight
from ._map_over import map_over as map_over
from ._plan import make_plan as make_plan, Plan as Plan
from ._settings import (
    AbstractLighting as AbstractLighting,
    LightAtSplats as LightAtSplats,
    RenderSettings as RenderSettings,
)
from ._surface import (
    surface_parameters as surface_parameters,
    SurfaceAttributes as SurfaceAttributes,
    SurfaceSamples as SurfaceSamples,
)
from ._render import (
    compute_irradiance as compute_irradiance,
    diffuse_irradiance as diffuse_irradiance,
    illuminate as illuminate,
    render as render,
    transfer as transfer,
)
from ._streamed import render_streamed as render_streamed
