"""Records of scenes, cameras, lights, materials and frames."""

from ._area_lights import (
    AbstractAreaLight as AbstractAreaLight,
    DiskLight as DiskLight,
    RectangleLight as RectangleLight,
    SphereLight as SphereLight,
)
from ._environment import (
    EnvironmentLight as EnvironmentLight,
    even_directions as even_directions,
)
from ._formulas import (
    HarmonicLight as HarmonicLight,
    overcast_sky as overcast_sky,
    spherical_harmonics as spherical_harmonics,
    studio as studio,
    sun_and_sky as sun_and_sky,
)
from ._light_groups import (
    light_kinds as light_kinds,
    lights_by_kind as lights_by_kind,
    stack_lights as stack_lights,
    StackedLights as StackedLights,
)
from ._lights import (
    AbstractExtendedLight as AbstractExtendedLight,
    AbstractHighlight as AbstractHighlight,
    AbstractLight as AbstractLight,
    AbstractLightSample as AbstractLightSample,
    AbstractPointSample as AbstractPointSample,
    DirectionalLight as DirectionalLight,
    DistantStratum as DistantStratum,
    EmitterStratum as EmitterStratum,
    GaussianBeam as GaussianBeam,
    PointLight as PointLight,
    SpotLight as SpotLight,
)
from ._material import Material as Material
from ._scene import (
    Camera as Camera,
    Frame as Frame,
    Parts as Parts,
    rotation_by as rotation_by,
    rotation_towards as rotation_towards,
    Scene as Scene,
    Splats as Splats,
)
