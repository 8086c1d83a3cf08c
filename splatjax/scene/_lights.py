"""Lights. A `direction` is the direction in which light travels; `wi` points from the surface to
the light.
"""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._records import check_values, is_traced, numbers, record, valid
from splatjax._smooth import smooth_step
from splatjax.gaussians import gaussian

_TOUCHING = 1e-6  # mm
# Requirements on fields of lights: a description and a check. All other fields must be finite.
_EXPECTED = {
    "direction": ("the way light travels, not zero", np.any),
    "variance": ("positive (mm^2)", lambda x: x > 0),
    "strength": ("at least 0", lambda x: x >= 0),
    "up": ("the direction of the image's upper edge, not zero", np.any),
    "radius": ("positive (mm)", lambda x: x > 0),
    "count": ("1 or more samples", lambda x: x >= 1),
    "image": ("finite and not negative; replace NaN, and clip negative values", lambda x: x >= 0),
}


class AbstractHighlight(eqx.Module):
    """The reflection of an extended light by glossy surfaces, instead of its samples' lobes."""

    @abc.abstractmethod
    def reflected(
        self,
        points: Float[Array, "*points 3"],
        mirrored: Float[Array, "*points 3"],
        roughness: Float[Array, "..."],
        lobe: Callable[[Float[Array, "*points 3"]], Float[Array, "*points"]],
        albedo: Float[Array, "*points"],
    ) -> Float[Array, "channels *points"]:
        """Compute the radiance that a specular lobe of strength 1 reflects, without shadows.

        **Arguments:**

        - `points`: mm.
        - `mirrored`: the mirrored direction of the eye, a unit vector.
        - `lobe`: computes the radiance towards the eye per irradiance on a surface that faces `wi`.
        - `albedo`: the lobe's integral over all `wi`.
        """


class AbstractLight(eqx.Module):
    """A light, represented by samples, which are points or directions.

    **Attributes:** (of the class)

    - `strength_field`: the name of the field that holds the power of each channel.
    """

    strength_field: ClassVar[str] = ""

    def __check_init__(self):
        for name in (field.name for field in dataclasses.fields(self)):
            check_values(
                f"{type(self).__name__}.{name}",
                getattr(self, name),
                *_EXPECTED.get(name, ("finite", lambda x: x == x)),
            )

    def with_channels(self, channels: int) -> "AbstractLight":
        """Repeat the strength of a light of one channel for all channels."""
        strength = getattr(self, self.strength_field, None)
        if strength is None or strength.shape != (1,):
            return self
        return eqx.tree_at(
            lambda light: getattr(light, light.strength_field),
            self,
            jnp.broadcast_to(strength, (channels,)),
        )

    @abc.abstractmethod
    def samples(self) -> tuple["AbstractLightSample", ...]:
        """Return the points and directions from which the light comes. Each sample has its own
        shadow in the light that enters the surface. The specular lobes, or the common highlight,
        use the mean visibility of the samples, so that passes 2 and 3 blend only one row per light.
        """

    def highlight(self) -> AbstractHighlight | None:
        """Prepare the highlight for all points; `None` if it is the sum of the lobes of the
        samples.
        """
        return None


class AbstractLightSample(AbstractLight):
    """A light from one point or direction."""

    @property
    @abc.abstractmethod
    def cast_shadows(self) -> bool:
        """Whether the sample has a shadow map; a static field of each class, with a default."""

    def samples(self) -> tuple["AbstractLightSample", ...]:
        """Return the light itself."""
        return (self,)

    @abc.abstractmethod
    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        """Compute at points (mm) the unit direction `wi` towards the light, and the irradiance on a
        surface that faces the light.
        """

    def weight(self, irradiance: Float[Array, "*points channels"]) -> Float[Array, "*points"]:
        """Compute the weight of the sample in its light's mean visibility: the irradiance."""
        return jnp.sum(abs(irradiance), axis=-1)


class AbstractExtendedLight(AbstractLight):
    """A light with many samples and one highlight.

    **Attributes:** (static)

    - `count`: number of samples.
    - `cast_shadows`: whether each sample has a shadow map.
    """

    count: int = eqx.field(static=True, default=64, kw_only=True)
    cast_shadows: bool = eqx.field(static=True, default=True, kw_only=True)

    @abc.abstractmethod
    def stacked_samples(self) -> AbstractLightSample:
        """Return the samples, stacked along the first axis of every leaf."""

    def samples(self) -> tuple[AbstractLightSample, ...]:
        leaves, structure = jax.tree.flatten(self.stacked_samples())
        return tuple(map(structure.unflatten, zip(*map(_rows, leaves), strict=True)))


def _rows(leaf: Float[Array, "rows ..."]) -> Sequence[Float[Array, "..."]]:
    """Return the rows of an array. Outside `jit` they are split on the host, because slicing would
    compile a kernel for each row.
    """
    if is_traced(leaf):
        return jnp.unstack(leaf)
    return jax.device_put(list(np.asarray(leaf)))


def _per_channel(
    value: Float[Array, " channels"], points: Float[Array, "*points 3"]
) -> Float[Array, "*points channels"]:
    return jnp.broadcast_to(value, (*points.shape[:-1], *value.shape))


@record
class DirectionalLight(AbstractLightSample):
    r"""Parallel light of a distant source, such as the sun.

    **Attributes:**

    - `direction`: the direction in which light travels, of any nonzero length. Differentiable.
    - `irradiance`: irradiance on a surface that faces the light; pi on a white diffuser gives
      radiance 1. Differentiable.
    - `cast_shadows`: whether the light has a shadow map. Static.
    """

    direction: Float[Array, "3"] = eqx.field(converter=numbers)
    irradiance: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength_field: ClassVar[str] = "irradiance"
    cast_shadows: bool = eqx.field(static=True, default=True)

    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        wi = -self.direction / jnp.linalg.norm(self.direction)
        return jnp.broadcast_to(wi, points.shape), _per_channel(self.irradiance, points)


class AbstractPointSample(AbstractLightSample):
    """Light from a point, with inverse-square falloff."""

    position: eqx.AbstractVar[Float[Array, "3"]]
    intensity: eqx.AbstractVar[Float[Array, " channels"]]
    strength_field: ClassVar[str] = "intensity"

    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        to_light = jnp.broadcast_to(self.position, points.shape) - points
        squared = jnp.sum(to_light * to_light, axis=-1, keepdims=True)
        apart = squared > _TOUCHING**2
        squared = jnp.where(apart, squared, 1.0)
        wi = jnp.where(apart, to_light / jnp.sqrt(squared), 0.0)
        return wi, jnp.where(apart, _per_channel(self.intensity, points) / squared, 0.0)


@record
class PointLight(AbstractPointSample):
    r"""Light from a point, with inverse-square falloff.

    A surface point within 1e-6 mm of the light receives no light: the irradiance diverges there, so
    value and gradient are set to 0.

    **Attributes:**

    - `position`: mm. Differentiable.
    - `intensity`: power per solid angle; the irradiance is `intensity cos / d^2`, d in mm.
      Differentiable.
    - `cast_shadows`: whether the light has a shadow map. Static.
    """

    position: Float[Array, "3"] = eqx.field(converter=numbers)
    intensity: Float[Array, " channels"] = eqx.field(converter=numbers)
    cast_shadows: bool = eqx.field(static=True, default=True)


@record
class SpotLight(AbstractPointSample):
    r"""A point light restricted to a cone.

    The intensity falls to 0 from the inner to the outer angle, by a smooth step in the cosine of
    the angle to the axis (as in pbrt's `SpotLight`).

    **Attributes:**

    - `position`: mm. Differentiable.
    - `direction`: direction in which light travels along the axis, of any nonzero length.
      Differentiable.
    - `intensity`: power per solid angle inside the inner cone. Differentiable.
    - `inner_angle`, `outer_angle`: degrees from the axis, at most 180. Differentiable.
    - `cast_shadows`: whether the light has a shadow map. Static.

    **Raises:** `ValueError` unless the outer angle is larger than the inner angle.
    """

    position: Float[Array, "3"] = eqx.field(converter=numbers)
    direction: Float[Array, "3"] = eqx.field(converter=numbers)
    intensity: Float[Array, " channels"] = eqx.field(converter=numbers)
    inner_angle: Float[Array, ""] = eqx.field(
        converter=numbers, default=20.0, metadata=valid("at least 0 degrees", lambda x: x >= 0)
    )
    outer_angle: Float[Array, ""] = eqx.field(converter=numbers, default=30.0)
    cast_shadows: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        check_values(
            "SpotLight.outer_angle",
            self.outer_angle,
            "larger than inner_angle, and at most 180 degrees",
            lambda x: (x > self.inner_angle) & (x <= 180),
        )

    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        wi, irradiance = super().incidence(points)
        cosine = -jnp.tensordot(wi, self.direction / jnp.linalg.norm(self.direction), 1)
        inner, outer = (jnp.cos(jnp.radians(x)) for x in (self.inner_angle, self.outer_angle))
        return wi, irradiance * smooth_step(cosine, outer, inner)[..., None]


class DistantStratum(DirectionalLight):
    """A part of an environment, treated as parallel light.

    **Attributes:**

    - `shadow_towards`: the direction in which the shadow map sees the light. `None`: opposite to
      `direction`.
    """

    shadow_towards: Float[Array, "3"] | None = None


class EmitterStratum(PointLight):
    """A part of an area light, treated as a point.

    **Attributes:**

    - `normal`: unit vector; the intensity is proportional to the cosine to it. `None`: isotropic.
    """

    normal: Float[Array, "3"] | None = None

    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        wi, irradiance = super().incidence(points)
        if self.normal is None:
            return wi, irradiance
        return wi, irradiance * jnp.maximum(-jnp.tensordot(wi, self.normal, 1), 0)[..., None]


@record
class GaussianBeam(AbstractLightSample):
    r"""A laser beam: parallel light with a Gaussian cross section. It casts no shadows.

    **Attributes:**

    - `origin`: a point on the axis, mm. Differentiable.
    - `direction`: the direction in which light travels, of any nonzero length. Differentiable.
    - `power`: total power of the beam. Differentiable.
    - `variance`: variance of the Gaussian per axis, mm^2. Differentiable.
    """

    origin: Float[Array, "3"] = eqx.field(converter=numbers)
    direction: Float[Array, "3"] = eqx.field(converter=numbers)
    power: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength_field: ClassVar[str] = "power"
    variance: Float[Array, ""] = eqx.field(converter=numbers)
    cast_shadows: bool = eqx.field(static=True, default=False, init=False)

    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        axis = jnp.broadcast_to(self.direction / jnp.linalg.norm(self.direction), points.shape)
        offset = points - jnp.broadcast_to(self.origin, points.shape)
        across = offset - jnp.sum(offset * axis, axis=-1, keepdims=True) * axis
        squared = jnp.sum(across * across, axis=-1, keepdims=True)
        return -axis, _per_channel(self.power, points) * gaussian(self.variance, squared)
