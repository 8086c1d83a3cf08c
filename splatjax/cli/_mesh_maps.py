"""Options of `splatjax sample` for the maps of a mesh."""

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from ._options import OptionalFloat, OptionalPath

_V_UP = (
    "Whether v = 0 is the lower edge of a map. Without it, as the format prescribes: OBJ yes, glTF "
    "and GLB no. If lips land on "
    "the chin, say True."
)


@dataclass(frozen=True, kw_only=True)
class MeshMaps:
    """Maps of a mesh, and where they lie."""

    #: Map of the mesh's diffuse color, sRGB. Without it, the texture that the file itself carries,
    #: if any.
    albedo: OptionalPath = None
    #: Gray map: factor on the material's specular strength.
    specular: OptionalPath = None
    #: Tangent-space normal map; green points up.
    normal: OptionalPath = None
    v_up: Annotated[
        bool | None, tyro.conf.arg(metavar="{True,False}", help=_V_UP, help_behavior_hint="")
    ] = None
    #: Cut off what lies below this height, in the file's unit.
    crop_min_y: OptionalFloat = None

    def worn(self) -> dict[str, Any]:
        """Give them as `splatjax.sample_mesh` and `splatjax.io.read_textured_mesh` take them."""
        maps = {"albedo": self.albedo, "specular": self.specular, "normal": self.normal}
        return maps | {"v_up": self.v_up, "crop_min_y": self.crop_min_y}
