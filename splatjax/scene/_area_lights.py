"""Lights of a size, near a body: rectangles, disks and balls of even radiance."""

import abc
import functools
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._records import check_values, numbers, record

from ._lights import AbstractExtendedLight, AbstractHighlight, AbstractLightSample, EmitterStratum

_GRAZING = 1e-3  # cosine to an emitter's plane, below which a mirrored ray meets it far away
_GOLDEN = (5**0.5 - 1) / 2


class AbstractAreaLight(AbstractExtendedLight, AbstractHighlight):
    r"""A surface of even radiance. A glossy surface mirrors a single point of it, the one nearest
    to the mirrored ray.

    **Source:** Karis 2013, "Real Shading in Unreal Engine 4": the representative point.
    """

    center: eqx.AbstractVar[Float[Array, "3"]]
    radiance: eqx.AbstractVar[Float[Array, " channels"]]

    @abc.abstractmethod
    def facing_area(self, wi: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
        """Compute the area, mm^2, that points in the direction `-wi` from the light see of it."""

    @abc.abstractmethod
    def nearest(
        self, points: Float[Array, "*points 3"], mirrored: Float[Array, "*points 3"]
    ) -> Float[Array, "*points 3"]:
        """Find the place on the light that is nearest to rays from points, mm."""

    def highlight(self) -> AbstractHighlight:
        return self

    def reflected(self, points, mirrored, roughness, lobe, albedo):
        r"""Take the lobe, with the solid angle `s = albedo / lobe(mirrored)`, for a Gaussian.

        A light of the solid angle `w` in its middle then fills `1 - exp(-w / s)` of it: a small
        light is a point, and a large one is seen with its radiance.
        """
        wi, squared = _towards(self.center, points)
        solid_angle = self.facing_area(wi) / squared
        middle = lobe(mirrored)
        is_seen = middle > 0
        size = jnp.where(is_seen, albedo, 0.0) / jnp.where(is_seen, middle, 1.0)
        filled = -jnp.expm1(-solid_angle / jnp.where(is_seen, size, 1.0)) * size
        nearest, _ = _towards(self.nearest(points, mirrored), points)
        return self.radiance.reshape(-1, *[1] * filled.ndim) * (lobe(nearest) * filled)[None]


def _towards(
    places: Float[Array, "*#points 3"], points: Float[Array, "*points 3"]
) -> tuple[Float[Array, "*points 3"], Float[Array, "*points"]]:
    """Compute unit directions and squared distances, at least 1e-6 mm^2."""
    offset = jnp.broadcast_to(places, points.shape) - points
    squared = jnp.maximum(jnp.sum(offset * offset, axis=-1), 1e-6)
    return offset / jnp.sqrt(squared)[..., None], squared


class AbstractFlatLight(AbstractAreaLight):
    """An area light in a plane, which emits to one side."""

    @abc.abstractmethod
    def plane(self) -> tuple[Float[Array, "3"], Float[Array, "2 3"], Float[Array, ""]]:
        """Compute the unit normal on the side that emits, the two edges from which the samples are
        laid out, mm, and the area, mm^2.
        """

    @abc.abstractmethod
    def within(self, places: Float[Array, "*places 2"]) -> Float[Array, "*places 2"]:
        """Move places to the light, in units of its edges from the center."""

    @abc.abstractmethod
    def pattern(self) -> Float[np.ndarray, "samples 2"]:
        """Lay out the samples, in units of the edges from the center."""

    def stacked_samples(self) -> AbstractLightSample:
        normal, edges, area = self.plane()
        positions = self.center[None] + jnp.asarray(self.pattern(), edges.dtype) @ edges
        intensity = self.radiance * (area / self.count)

        def sample(position):
            return EmitterStratum(position, intensity, normal, self.cast_shadows)

        return jax.vmap(sample)(positions)

    def facing_area(self, wi: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
        normal, _, area = self.plane()
        return area * jnp.maximum(-jnp.tensordot(wi, normal, 1), 0)

    def nearest(
        self, points: Float[Array, "*points 3"], mirrored: Float[Array, "*points 3"]
    ) -> Float[Array, "*points 3"]:
        normal, edges, _ = self.plane()
        from_center = points - jnp.broadcast_to(self.center, points.shape)
        approach = jnp.maximum(-jnp.tensordot(mirrored, normal, 1), _GRAZING)
        distance = jnp.tensordot(from_center, normal, 1) / approach
        hit = from_center + distance[..., None] * mirrored
        places = self.within(jnp.tensordot(hit, jnp.linalg.pinv(edges), 1))
        return jnp.broadcast_to(self.center, points.shape) + jnp.tensordot(places, edges, 1)


@record
class RectangleLight(AbstractFlatLight):
    r"""A rectangle of even radiance that emits to one side, such as a softbox.

    **Attributes:**

    - `center`: mm. Differentiable.
    - `edges`: two edges, mm: the rectangle reaches half of each to both sides. It emits in the
      direction of their cross product. Differentiable.
    - `radiance`: a rectangle that fills the whole sky of a white diffuser shows it its own
      radiance. Differentiable.
    - `count`: of samples, each with a shadow map. Static.
    - `cast_shadows`: static.
    """

    center: Float[Array, "3"] = eqx.field(converter=numbers)
    edges: Float[Array, "2 3"] = eqx.field(converter=numbers)
    radiance: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength_field: ClassVar[str] = "radiance"
    count: int = eqx.field(static=True, default=16)
    cast_shadows: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if isinstance(self.edges, jax.Array):
            requirement = "two that span an area: their cross product"
            check_values("RectangleLight.edges", self.plane()[2], requirement, lambda x: x > 0)

    def plane(self) -> tuple[Float[Array, "3"], Float[Array, "2 3"], Float[Array, ""]]:
        across = jnp.cross(self.edges[0], self.edges[1])
        area = jnp.linalg.norm(across)
        return across / area, self.edges, area

    def within(self, places: Float[Array, "*places 2"]) -> Float[Array, "*places 2"]:
        return jnp.clip(places, -0.5, 0.5)

    def pattern(self) -> Float[np.ndarray, "samples 2"]:
        i = np.arange(self.count) + 0.5
        return np.stack([i / self.count, i * _GOLDEN % 1], axis=1) - 0.5


@record
class DiskLight(AbstractFlatLight):
    r"""A disk of even radiance that emits to one side.

    **Attributes:** as of `RectangleLight`, and

    - `direction`: the way the disk faces, and its light travels, any length but zero.
      Differentiable.
    - `radius`: mm. Differentiable.
    """

    center: Float[Array, "3"] = eqx.field(converter=numbers)
    direction: Float[Array, "3"] = eqx.field(converter=numbers)
    radius: Float[Array, ""] = eqx.field(converter=numbers)
    radiance: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength_field: ClassVar[str] = "radiance"
    count: int = eqx.field(static=True, default=16)
    cast_shadows: bool = eqx.field(static=True, default=True)

    def plane(self) -> tuple[Float[Array, "3"], Float[Array, "2 3"], Float[Array, ""]]:
        normal = self.direction / jnp.linalg.norm(self.direction)
        least = jax.nn.one_hot(jnp.argmin(jnp.abs(normal)), 3, dtype=normal.dtype)
        across = jnp.cross(normal, least)
        across = across / jnp.linalg.norm(across)
        edges = self.radius * jnp.stack([across, jnp.cross(normal, across)])
        return normal, edges, jnp.pi * self.radius**2

    def within(self, places: Float[Array, "*places 2"]) -> Float[Array, "*places 2"]:
        return places / jnp.sqrt(jnp.maximum(jnp.sum(places**2, axis=-1, keepdims=True), 1.0))

    def pattern(self) -> Float[np.ndarray, "samples 2"]:
        i = np.arange(self.count) + 0.5
        angle = 2 * np.pi * _GOLDEN * i
        return np.sqrt(i / self.count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@record
class SphereLight(AbstractAreaLight):
    r"""A ball whose surface has even radiance.

    Its samples fill the ball so that they look like an even disk from every side. Points inside it
    are lit by these, which means nothing.

    **Attributes:** as of `RectangleLight`, and

    - `radius`: mm. Differentiable.
    """

    center: Float[Array, "3"] = eqx.field(converter=numbers)
    radius: Float[Array, ""] = eqx.field(converter=numbers)
    radiance: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength_field: ClassVar[str] = "radiance"
    count: int = eqx.field(static=True, default=16)
    cast_shadows: bool = eqx.field(static=True, default=True)

    def stacked_samples(self) -> AbstractLightSample:
        places = jnp.asarray(_ball(self.count), self.radius.dtype)
        intensity = self.radiance * (jnp.pi * self.radius**2 / self.count)

        def sample(position):
            return EmitterStratum(position, intensity, None, self.cast_shadows)

        return jax.vmap(sample)(self.center[None] + self.radius * places)

    def facing_area(self, wi: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
        return jnp.broadcast_to(jnp.pi * self.radius**2, wi.shape[:-1])

    def nearest(
        self, points: Float[Array, "*points 3"], mirrored: Float[Array, "*points 3"]
    ) -> Float[Array, "*points 3"]:
        center = jnp.broadcast_to(self.center, points.shape)
        along = jnp.maximum(jnp.sum((center - points) * mirrored, axis=-1, keepdims=True), 0)
        offset = points + along * mirrored - center
        reach = jnp.sqrt(jnp.maximum(jnp.sum(offset**2, axis=-1, keepdims=True), self.radius**2))
        return center + offset * (self.radius / reach)


@functools.cache
def _ball(count: int) -> Float[np.ndarray, "samples 3"]:
    """Lay out points in the unit ball that look like an evenly filled disk from every side: their
    density is `1 / sqrt(1 - s^2)`.
    """
    i = np.arange(count) + 0.5
    s = np.sin(np.linspace(0, np.pi / 2, 1000))
    s = np.interp(i * 2**0.5 % 1, 2 / np.pi * (np.arcsin(s) - s * np.sqrt(1 - s * s)), s)
    z, angle = 1 - 2 * i / count, 2 * np.pi * _GOLDEN * i
    across = np.sqrt(1 - z * z)
    return s[:, None] * np.stack([across * np.cos(angle), z, across * np.sin(angle)], axis=1)
