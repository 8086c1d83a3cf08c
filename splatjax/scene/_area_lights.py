"""Area lights near a body: rectangles, disks and spheres of uniform radiance."""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import Numbers, as_floats, check_values, numbers, record

from ._environment import even_directions
from ._lights import AbstractExtendedLight, AbstractHighlight, AbstractLightSample, EmitterStratum
from ._scene import rotation_towards

_GRAZING = 1e-3  # least cosine between a mirrored ray and the normal of an emitter
_RIM = 16  # number of points on the rim of a disk
_GOLDEN = (5**0.5 - 1) / 2


class AbstractAreaLight(AbstractExtendedLight, AbstractHighlight):
    r"""A light surface of uniform radiance. A glossy surface reflects its point nearest to the
    mirrored ray.

    **Source:** Karis 2013, "Real Shading in Unreal Engine 4" (representative point).
    """

    center: Float[Array, "3"] = eqx.field(converter=numbers)
    radiance: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength_field: ClassVar[str] = "radiance"
    # Area of the light divided by the area of the parallelogram that its first two axes span.
    area_factor: eqx.AbstractClassVar[float]

    @abc.abstractmethod
    def axes(self) -> Float[Array, "axes 3"]:
        """Compute the axes along which the samples are placed, mm. A flat light has two and emits
        in the direction of their cross product; a sphere has three.
        """

    @abc.abstractmethod
    def sample_offsets(self) -> Float[np.ndarray, "samples axes"]:
        """Compute the positions of the samples, in units of the axes from the center."""

    @abc.abstractmethod
    def nearest(self, places: Float[Array, "*places axes"]) -> Float[Array, "*places axes"]:
        """Find the nearest points on the light, in units of the axes from the center."""

    @abc.abstractmethod
    def solid_angle(self, from_center: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
        """Compute the solid angle of the emitting side as seen from points relative to the center,
        mm.
        """

    def normal_and_area(
        self,
    ) -> tuple[Float[Array, "3"] | None, Float[Array, ""]]:
        """Compute the unit normal of a flat light, and the projected area of the light, mm^2."""
        axes = self.axes()
        across = jnp.cross(axes[0], axes[1])
        area = jnp.linalg.norm(across)
        return across / area if len(axes) == 2 else None, self.area_factor * area

    @jit_unless_traced
    def stacked_samples(self) -> AbstractLightSample:
        axes, (normal, area) = self.axes(), self.normal_and_area()
        positions = self.center[None] + jnp.asarray(self.sample_offsets(), axes.dtype) @ axes
        sample = eqx.Partial(
            EmitterStratum,
            intensity=self.radiance * (area / self.count),
            normal=normal,
            cast_shadows=self.cast_shadows,
        )
        return jax.vmap(sample)(positions)

    def highlight(self) -> AbstractHighlight:
        return self

    def reflected(self, points, mirrored, roughness, lobe, albedo):
        r"""Approximate the lobe by a Gaussian with the solid angle `s = albedo / lobe(mirrored)`. A
        light of solid angle `w` at its center then covers the fraction `1 - exp(-w / s)` of the
        lobe: a small light acts as a point, and a large one is reflected with its radiance.
        """
        normal, _ = self.normal_and_area()
        from_center = points - jnp.broadcast_to(self.center, points.shape)
        along = -jnp.sum(from_center * mirrored, axis=-1)
        if normal is not None:  # intersect the plane of the light
            approach = jnp.maximum(-jnp.tensordot(mirrored, normal, 1), _GRAZING)
            along = jnp.tensordot(from_center, normal, 1) / approach
        hit = from_center + jnp.maximum(along, 0)[..., None] * mirrored
        axes = self.axes()  # perpendicular
        per_axis = axes / jnp.sum(axes * axes, axis=1, keepdims=True)
        closest = jnp.tensordot(self.nearest(jnp.tensordot(hit, per_axis.T, 1)), axes, 1)
        to_nearest = closest - from_center
        wi = to_nearest / _lengths(to_nearest)[..., None]

        middle = lobe(mirrored)
        is_seen = (middle > 0) & (albedo > 0)
        size = jnp.where(is_seen, albedo, 0.0) / jnp.where(is_seen, middle, 1.0)
        filled = -jnp.expm1(-self.solid_angle(from_center) / jnp.where(is_seen, size, 1.0)) * size
        return self.radiance.reshape(-1, *[1] * filled.ndim) * (lobe(wi) * filled)[None]


@record
class RectangleLight(AbstractAreaLight):
    r"""A rectangle of uniform radiance that emits from one side, such as a softbox. Its size makes
    shadows soft.

        softbox = RectangleLight.facing((-250, 150, 350), (0, -40, 0), 200, 200, radiance=6)

    `facing` turns a rectangle of a given width and height towards a target.

    **Attributes:**

    - `center`: mm. Differentiable.
    - `radiance`: radiance of the emitting side. Far away, the irradiance is the radiance times the
      visible area divided by the squared distance. Differentiable.
    - `edges`: two edge vectors, mm, perpendicular to each other: highlights are wrong otherwise.
      The rectangle is centered at `center` and emits in the direction of their cross product.
      Differentiable.
    - `count`: number of points that represent the rectangle; more points give smoother penumbras
      and take longer. Static.
    - `cast_shadows`: whether each point has a shadow map. Static.
    """

    edges: Float[Array, "2 3"] = eqx.field(converter=numbers)
    area_factor: ClassVar[float] = 1.0

    def __check_init__(self):
        if isinstance(self.edges, jax.Array):
            check_values(
                "RectangleLight.edges",
                self.normal_and_area()[1],
                "two vectors that span an area; the area is 0",
                lambda area: area > 0,
            )

    @classmethod
    def facing(
        cls,
        center: Numbers,
        target: Numbers,
        width: Numbers,
        height: Numbers,
        radiance: Numbers,
        **settings,
    ) -> "RectangleLight":
        """Make a rectangle that faces a target, with a horizontal lower edge. Straight above or
        below the target, the lower edge is along x.

        **Arguments:**

        - `center`, `target`, `width`, `height`: mm.
        - `radiance`: one number, or one per channel.
        - `settings`: `count` and `cast_shadows`.
        """
        center = as_floats(center)
        right, down = _across(as_floats(target) - center)
        return cls(center, radiance, jnp.stack([width * right, height * down]), **settings)

    def axes(self) -> Float[Array, "2 3"]:
        return self.edges

    def sample_offsets(self) -> Float[np.ndarray, "samples 2"]:
        i = np.arange(self.count) + 0.5
        return np.stack([i / self.count, i * _GOLDEN % 1], axis=1) - 0.5

    def nearest(self, places: Float[Array, "*places 2"]) -> Float[Array, "*places 2"]:
        return jnp.clip(places, -0.5, 0.5)

    def solid_angle(self, from_center: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
        """Add the solid angles of two triangles.

        **Source:** Van Oosterom and Strackee 1983, "The solid angle of a plane triangle".
        """
        signs = jnp.asarray([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        corners = signs.astype(self.edges.dtype) @ self.edges
        to_corners = _offsets(from_center, corners)
        lengths = _lengths(to_corners)
        volume = jnp.tensordot(from_center, jnp.cross(*self.edges), 1)  # equal for both triangles

        def triangle(*corners):
            (a, b, c), (u, v, w) = (rows[np.asarray(corners)] for rows in (lengths, to_corners))
            cosines = (jnp.sum(x * y, axis=-1) for x, y in ((v, w), (w, u), (u, v)))
            dots = sum(length * dot for length, dot in zip((a, b, c), cosines, strict=True))
            return 2 * jnp.arctan2(volume, a * b * c + dots)

        return jnp.maximum(triangle(0, 1, 2) + triangle(0, 2, 3), 0)


@record
class DiskLight(AbstractAreaLight):
    r"""A disk of uniform radiance that emits from one side.

        lamp = DiskLight((0, 300, 200), radiance=20, direction=(0, -1, -1), radius=40)

    **Attributes:** `center`, `radiance`, `count` and `cast_shadows` as for `RectangleLight`, and

    - `direction`: normal of the emitting side, of any nonzero length. Differentiable.
    - `radius`: mm. Differentiable.
    """

    direction: Float[Array, "3"] = eqx.field(converter=numbers)
    radius: Float[Array, ""] = eqx.field(converter=numbers)
    area_factor: ClassVar[float] = np.pi

    def axes(self) -> Float[Array, "2 3"]:
        return self.radius * _across(self.direction)

    def sample_offsets(self) -> Float[np.ndarray, "samples 2"]:
        i = np.arange(self.count) + 0.5
        angle = 2 * np.pi * _GOLDEN * i
        return np.sqrt(i / self.count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def nearest(self, places: Float[Array, "*places axes"]) -> Float[Array, "*places axes"]:
        return places / jnp.sqrt(jnp.maximum(jnp.sum(places**2, axis=-1, keepdims=True), 1.0))

    def solid_angle(self, from_center: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
        r"""Integrate along the rim, `(r^2 - q . x) / (s (s + h))` at `q` for a point `x` at the
        height `h` and the distance `s` from `q`, by the trapezoidal rule. The error is at most 0.02
        at distances above a fifth of the radius.
        """
        angle = 2 * np.pi * np.arange(_RIM) / _RIM
        around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        rim = jnp.asarray(around, self.radius.dtype) @ self.axes()
        normal = self.direction / jnp.linalg.norm(self.direction)
        height = jnp.tensordot(from_center, normal, 1)
        distances = _lengths(_offsets(from_center, rim))
        inside = self.radius**2 - jnp.tensordot(rim, from_center, (1, -1))
        terms = inside / (distances * (distances + jnp.maximum(height, 0)[None]))
        return jnp.where(height > 0, 2 * jnp.pi * jnp.mean(terms, axis=0), 0.0)


@record
class SphereLight(AbstractAreaLight):
    r"""A sphere whose surface has uniform radiance.

    The samples fill the sphere such that, seen from any side, they are distributed as over a
    uniform disk. The light is invalid for points inside the sphere.

    **Attributes:** `center`, `radiance`, `count` and `cast_shadows` as of `RectangleLight`, and

    - `radius`: mm. Differentiable.
    """

    radius: Float[Array, ""] = eqx.field(converter=numbers)
    area_factor: ClassVar[float] = np.pi

    def axes(self) -> Float[Array, "3 3"]:
        return self.radius * jnp.eye(3, dtype=self.radius.dtype)

    def sample_offsets(self) -> Float[np.ndarray, "samples 3"]:
        # A density of 1 / sqrt(1 - s^2) is uniform when projected along any direction.
        i = np.arange(self.count) + 0.5
        s = np.sin(np.linspace(0, np.pi / 2, 1000))
        within = 2 / np.pi * (np.arcsin(s) - s * np.sqrt(1 - s * s))
        s = np.interp(i * 2**0.5 % 1, within, s)
        return s[:, None] * even_directions(self.count)

    nearest = DiskLight.nearest

    def solid_angle(self, from_center: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
        squared_sine = (self.radius / _lengths(from_center)) ** 2
        return 2 * jnp.pi * squared_sine / (1 + jnp.sqrt(jnp.maximum(1 - squared_sine, 1e-6)))


def _offsets(
    points: Float[Array, "*points 3"], places: Float[Array, "places 3"]
) -> Float[Array, "places *points 3"]:
    return places.reshape(-1, *[1] * (points.ndim - 1), 3) - points[None]


def _lengths(vectors: Float[Array, "*points 3"]) -> Float[Array, "*points"]:
    return jnp.sqrt(jnp.maximum(jnp.sum(vectors * vectors, axis=-1), 1e-12))


def _across(direction: Float[Array, "3"]) -> Float[Array, "2 3"]:
    """Compute two unit vectors perpendicular to a direction: to the right and down as seen along
    it.
    """
    forward = direction / jnp.linalg.norm(direction)
    y, z = jnp.eye(3, dtype=forward.dtype)[1:]
    return rotation_towards(forward, jnp.where(jnp.abs(forward[1]) < 0.999, y, z))[:2]
