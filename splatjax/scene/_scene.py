"""All that is seen by a camera."""

import equinox as eqx

from splatjax._records import record, several

from ._lights import AbstractLight
from ._material import Material
from ._splats import Splats


@record
class Scene(eqx.Module):
    """Splats of one material under some lights. Lights of one kind are computed together.

    `lights` may be given as a list or as a single light. A light of one channel shines in every
    channel of the material.
    """

    splats: Splats
    lights: tuple[AbstractLight, ...] = eqx.field(converter=several)
    material: Material

    def __post_init__(self):
        channels = self.material.channels
        self.lights = tuple(light.with_channels(channels) for light in self.lights)
