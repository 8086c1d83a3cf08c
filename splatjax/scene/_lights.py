"""Lights. Directions point the way the light travels; `wi` points back, from the surface towards
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

from splatjax._records import check_values, numbers, record
from splatjax.gaussians import gaussian

_TOUCHING = 1e-6  # mm


class AbstractLight(eqx.Module):
    """A light. Whether it casts shadows is static: a light that casts none costs no shadow map."""

    cast_shadows: eqx.AbstractVar[bool]

    strength: ClassVar[str] = ""
    """The field with the power of each channel."""

    def __check_init__(self):
        for field in dataclasses.fields(self):
            name, values = f"{type(self).__name__}.{field.name}", getattr(self, field.name)
            if field.name == "direction":
                check_values(name, values, "the way light travels, not zero", np.any)
            elif field.name == "variance":
                check_values(name, values, "positive (mm^2)", lambda x: x > 0)
            else:
                check_values(name, values, "finite", lambda x: x == x)

    def with_channels(self, channels: int) -> "AbstractLight":
        """Repeat the strength of a light of one channel for so many channels."""
        strength = getattr(self, self.strength, None)
        if strength is None or strength.shape != (1,):
            return self
        repeated = jnp.broadcast_to(strength, (channels,))
        return eqx.tree_at(lambda light: getattr(light, light.strength), self, repeated)

    @abc.abstractmethod
    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        """Compute, at points in mm, the unit direction `wi` towards the light and the irradiance
        on a surface that faces it.
        """


def _per_channel(
    value: Float[Array, " channels"], points: Float[Array, "*points 3"]
) -> Float[Array, "*points channels"]:
    return jnp.broadcast_to(value, (*points.shape[:-1], *value.shape))


@record
class DirectionalLight(AbstractLight):
    r"""Parallel light from infinitely far away.

    **Attributes:**

    - `direction`: the way the light travels, any length but zero. Differentiable.
    - `irradiance`: on a surface that faces the light; pi on a white diffuser gives radiance 1.
      Differentiable.
    - `cast_shadows`: static.
    """

    direction: Float[Array, "3"] = eqx.field(converter=numbers)
    irradiance: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength: ClassVar[str] = "irradiance"
    cast_shadows: bool = eqx.field(static=True, default=True)

    def incidence(
        self, points: Float[Array, "*points 3"]
    ) -> tuple[Float[Array, "*points 3"], Float[Array, "*points channels"]]:
        wi = -self.direction / jnp.linalg.norm(self.direction)
        return jnp.broadcast_to(wi, points.shape), _per_channel(self.irradiance, points)


@record
class PointLight(AbstractLight):
    r"""Light from a point, falling off with the square of the distance.

    A point within 1e-6 mm of the light receives none: the limit diverges, so value and gradient are
    cut to zero there.

    **Attributes:**

    - `position`: mm. Differentiable.
    - `intensity`: power per solid angle; the irradiance is `intensity cos / d^2`, d in mm.
      Differentiable.
    - `cast_shadows`: static.
    """

    position: Float[Array, "3"] = eqx.field(converter=numbers)
    intensity: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength: ClassVar[str] = "intensity"
    cast_shadows: bool = eqx.field(static=True, default=True)

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
class GaussianBeam(AbstractLight):
    r"""A laser: parallel light whose power falls off as a Gaussian with the distance from its axis.
    It casts no shadows.

    **Attributes:**

    - `origin`: a point on the axis, mm. Differentiable.
    - `direction`: the way the light travels, any length but zero. Differentiable.
    - `power`: of the whole beam. Differentiable.
    - `variance`: per axis, mm^2. Differentiable.
    """

    origin: Float[Array, "3"] = eqx.field(converter=numbers)
    direction: Float[Array, "3"] = eqx.field(converter=numbers)
    power: Float[Array, " channels"] = eqx.field(converter=numbers)
    strength: ClassVar[str] = "power"
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


class StackedLights(eqx.Module):
    """Lights of one kind, their leaves stacked, and their places in the scene's tuple."""

    lights: AbstractLight
    places: tuple[int, ...] = eqx.field(static=True)

    def apart(self) -> list[AbstractLight]:
        """Return the lights one by one."""
        return [
            jax.tree.map(lambda leaf, i=i: leaf[i], self.lights) for i in range(len(self.places))
        ]


def stack_lights(lights: tuple[AbstractLight, ...]) -> list[StackedLights]:
    """Stack lights of equal kind, so that any number of them is computed by one loop."""
    kinds: dict[object, list[int]] = {}
    for place, light in enumerate(lights):
        kinds.setdefault(jax.tree.structure(light), []).append(place)
    return [
        StackedLights(
            jax.tree.map(lambda *leaves: jnp.stack(leaves), *[lights[i] for i in places]),
            tuple(places),
        )
        for places in kinds.values()
    ]


def sum_over_lights(
    groups: list[StackedLights],
    shares: Sequence[Array | None],
    contribution: Callable[[AbstractLight, Array | None], Array],
    start: Array,
) -> Array:
    """Add up the contributions of lights, one after the other; backward, each is recomputed.

    **Arguments:**

    - `shares`: for each group what of each light arrives, lights first; `None` for lights that cast
      no shadows.
    - `contribution`: of a light, and its share.
    - `start`: what they are added to.
    """

    @jax.checkpoint
    def add(total, light_and_share):
        return total + contribution(*light_and_share), None

    for group, share in zip(groups, shares, strict=True):
        start, _ = jax.lax.scan(add, start, (group.lights, share))
    return start
