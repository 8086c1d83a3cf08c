"""Splats: discs that cover a surface."""

from collections.abc import Callable, Iterable
from typing import TypeAlias

import equinox as eqx
from jaxtyping import Array, Float

from splatjax._records import check_values, numbers, record

_ROUNDING = 1e-5
"""By which an albedo may leave [0, 1]."""
_FINITE = "finite: drop such splats before rendering"
_POSITIVE = "finite and at least 0"


@record
class Splats(eqx.Module):
    r"""A surface as a set of discs, one row per splat; mm, right-handed, +y up.

    Nearby splats should be near in memory (`read_splats` and `sample_mesh` sort them so); the
    picture does not depend on the order, only the time it takes.

    **Attributes:** (all differentiable unless said otherwise)

    - `centers`: mm. Visibility is discontinuous in them; coverage and shading are smooth.
    - `normals`: unit vectors, outward.
    - `radii`: mm, positive. Discs overlap so that they leave no hole: about 1.5 times the root of
      the area.
    - `areas`: the area of the surface that each splat stands for, mm^2. They add up to the
      surface's area. (The discs overlap, so `pi r^2` is not the area.)
    - `albedo`: diffuse color, linear, in [0, 1]; `None` where the material's weights alone carry
      color.
    - `specular`: factor on the material's specular strength; `None` for 1.
    - `roughness`: factor on the material's roughness; `None` for 1.

    **Raises:** `ValueError` for arrays of different lengths, for entries that are not finite, for
    negative radii and areas, and for an albedo outside [0, 1].
    """

    centers: Float[Array, "splats 3"] = eqx.field(converter=numbers)
    normals: Float[Array, "splats 3"] = eqx.field(converter=numbers)
    radii: Float[Array, " splats"] = eqx.field(converter=numbers)
    areas: Float[Array, " splats"] = eqx.field(converter=numbers)
    albedo: Float[Array, "splats channels"] | None = eqx.field(converter=numbers, default=None)
    specular: Float[Array, " splats"] | None = eqx.field(converter=numbers, default=None)
    roughness: Float[Array, " splats"] | None = eqx.field(converter=numbers, default=None)

    def __check_init__(self):
        for name in ("centers", "normals"):
            check_values(f"Splats.{name}", getattr(self, name), _FINITE, lambda x: x == x)
        for name in ("radii", "areas", "specular", "roughness"):
            check_values(f"Splats.{name}", getattr(self, name), _POSITIVE, lambda x: x >= 0)
        check_values(
            "Splats.albedo",
            self.albedo,
            "in [0, 1]: linear colors, 8-bit values divided by 255 and decoded",
            lambda x: (x >= -_ROUNDING) & (x <= 1 + _ROUNDING),
        )

    @property
    def count(self) -> int:
        return self.centers.shape[0]

    def scaled(self, factor: Float[Array, ""] | float) -> "Splats":
        """Scale the body about the origin. Light travels as far as before, so that a smaller body
        is more translucent.
        """
        scaled = self.centers * factor, self.radii * factor, self.areas * (factor * factor)
        return eqx.tree_at(
            lambda splats: (splats.centers, splats.radii, splats.areas), self, scaled
        )


Parts: TypeAlias = Callable[[], Iterable[Splats]]
"""A function that returns all splats part by part, the same ones at every call."""
