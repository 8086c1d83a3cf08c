"""What `splatjax sample` and `splatjax figure` share: how a mesh wears its maps."""

from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from ._outputs import OptionalPath


@dataclass(frozen=True, kw_only=True)
class MeshMaps:
    """Maps of a mesh, and where they lie."""

    albedo: OptionalPath = None
    """Map of the mesh's diffuse color, sRGB. Without it, the texture that the file itself carries, if any."""
    specular: OptionalPath = None
    """Gray map: factor on the material's specular strength."""
    normal: OptionalPath = None
    """Tangent-space normal map; green points up."""
    v_up: bool | None = None
    """Whether v = 0 is the lower edge of a map. None: as the format prescribes (OBJ yes, glTF and GLB no). If lips land on the
    chin, say True."""
    crop_min_y: Annotated[float | None, tyro.conf.arg(metavar="Y")] = None
    """Cut off what lies below this height, in the file's unit."""

    def worn(self) -> dict[str, Any]:
        """Give them as `splatjax.sample_mesh` and `splatjax.io.read_textured_mesh` take them."""
        maps = {"albedo": self.albedo, "specular": self.specular, "normal": self.normal}
        return maps | {"v_up": self.v_up, "crop_min_y": self.crop_min_y}
