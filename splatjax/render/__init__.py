"""The five passes, wired: plan once what shapes they need, then render. No mathematics lives here."""

from ._jacobian import picture_jacobian as picture_jacobian, PictureJacobian as PictureJacobian
from ._plan import Plan as Plan, plan as plan, ShadowPlan as ShadowPlan
from ._render import diffuse as diffuse, render as render
from ._settings import RenderSettings as RenderSettings
