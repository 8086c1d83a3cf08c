"""Plain records: what is drawn, what with, and what comes out. No algorithms."""

from ._camera import Camera as Camera
from ._frame import Frame as Frame
from ._lights import (
    AbstractLight as AbstractLight,
    DirectionalLight as DirectionalLight,
    GaussianBeam as GaussianBeam,
    PointLight as PointLight,
    stack_lights as stack_lights,
    StackedLights as StackedLights,
    sum_over_lights as sum_over_lights,
)
from ._material import Material as Material
from ._scene import Scene as Scene
from ._splats import Parts as Parts, Splats as Splats
