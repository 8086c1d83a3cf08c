"""The five passes, wired: plan once what shapes they need, then render. No mathematics lives
here.
"""

from ._batches import map_over as map_over
from ._checks import check_displayable as check_displayable, check_scene as check_scene
from ._gathered import (
    gather_picture as gather_picture,
    gather_picture_and_slopes as gather_picture_and_slopes,
)
from ._gathered import GatheredPicture as GatheredPicture
from ._jacobian import picture_jacobian as picture_jacobian, PictureJacobian as PictureJacobian
from ._lighting import AbstractLighting as AbstractLighting, entering_light as entering_light
from ._lighting import EnteringLight as EnteringLight, let_light_in as let_light_in
from ._lighting import LightAtSplats as LightAtSplats, LightOnSplats as LightOnSplats
from ._lighting import (
    surface_attributes as surface_attributes,
    surface_parameters as surface_parameters,
)
from ._plan import plan as plan
from ._records import Plan as Plan, ShadowPlan as ShadowPlan
from ._render import diffuse as diffuse, light_on_splats as light_on_splats, render as render
from ._settings import RenderSettings as RenderSettings
from ._streamed import render_streamed as render_streamed
