"""All that is seen by a camera."""

import equinox as eqx

from ._lights import AbstractLight
from ._material import Material
from ._splats import Splats


class Scene(eqx.Module):
    """Splats of one material under some lights. Lights of one kind are computed together."""

    splats: Splats
    lights: tuple[AbstractLight, ...]
    material: Material

    def __check_init__(self):
        if isinstance(self.lights, AbstractLight):
            raise TypeError(
                f"lights is a {type(self.lights).__name__}; it must be a tuple of lights: (light,) "
                "for one"
            )
