"""The light that a surface receives, and pass 5: reflection and transmission at the rough
interface.
"""

from splatjax._smooth import albedo_root as albedo_root

from ._deferred import (
    albedo_under as albedo_under,
    average_transmission as average_transmission,
    diffuse_transmission as diffuse_transmission,
    exit_transmission as exit_transmission,
    reflected_radiance as reflected_radiance,
    single_scattered_radiance as single_scattered_radiance,
    sum_received as sum_received,
    SurfacePoints as SurfacePoints,
    unit_normals as unit_normals,
)
from ._specular import (
    average_albedo as average_albedo,
    directional_albedo as directional_albedo,
    fresnel_f0 as fresnel_f0,
    specular_lobe as specular_lobe,
)
