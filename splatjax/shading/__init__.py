"""Pass 5: the rough interface. What it reflects, and what it leaves to the light below."""

from ._deferred import (
    albedo_root as albedo_root,
    diffuse_transmission as diffuse_transmission,
    leaving_share as leaving_share,
    reflected_radiance as reflected_radiance,
    single_scattered_radiance as single_scattered_radiance,
    SurfacePoints as SurfacePoints,
    unit_normals as unit_normals,
)
from ._specular import (
    average_albedo as average_albedo,
    directional_albedo as directional_albedo,
    fresnel_f0 as fresnel_f0,
    specular_lobe as specular_lobe,
)
