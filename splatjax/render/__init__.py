"""The five passes, wired: plan once what shapes they need, then render. No mathematics lives here."""

from ._gathered import gather_picture as gather_picture, gather_picture_and_slopes as gather_picture_and_slopes
from ._gathered import GatheredPicture as GatheredPicture
from ._jacobian import picture_jacobian as picture_jacobian, PictureJacobian as PictureJacobian
from ._plan import Plan as Plan, plan as plan, ShadowPlan as ShadowPlan
from ._render import diffuse as diffuse, render as render
from ._settings import RenderSettings as RenderSettings
