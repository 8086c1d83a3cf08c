"""Splats: discs that cover a surface."""

from collections.abc import Callable, Iterable
from typing import TypeAlias

import equinox as eqx
from jaxtyping import Array, Float


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
    """

    centers: Float[Array, "splats 3"]
    normals: Float[Array, "splats 3"]
    radii: Float[Array, " splats"]
    areas: Float[Array, " splats"]
    albedo: Float[Array, "splats channels"] | None = None
    specular: Float[Array, " splats"] | None = None
    roughness: Float[Array, " splats"] | None = None

    @property
    def count(self) -> int:
        return self.centers.shape[0]

    def scaled(self, factor: Float[Array, ""] | float) -> "Splats":
        """Give the same body in another size, about the origin. Light goes as far as before: a
        small one is more translucent.
        """
        grown = self.centers * factor, self.radii * factor, self.areas * (factor * factor)
        return eqx.tree_at(lambda splats: (splats.centers, splats.radii, splats.areas), self, grown)


Parts: TypeAlias = Callable[[], Iterable[Splats]]
"""What gives all splats, part by part, whenever it is called."""
