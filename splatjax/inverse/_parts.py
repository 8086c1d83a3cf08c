"""Parts of a scene that may move, each in coordinates that know no bounds."""

import abc
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from splatjax.scene import AbstractLight, Camera, DirectionalLight, GaussianBeam, PointLight, Splats

_BOUNDED = 1e-3
"""An albedo moves between this and one less this: at 0 and 1 themselves the logit is infinite."""


class Shot(eqx.Module):
    """A camera and the lights of its picture."""

    camera: Camera
    lights: tuple[AbstractLight, ...]


class AbstractPart(eqx.Module):
    r"""What may move. Its coordinates count steps from where it starts: there they are all zero.

    An optimizer sees coordinates in steps, so that one learning rate serves all parts: Adam at a
    rate of 1 moves each by up to one step at a time.
    """

    def __check_init__(self):
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not value > 0:
                raise ValueError(
                    f"{type(self).__name__}.{field.name} must be positive; got {value:g}"
                )


class AbstractBodyPart(AbstractPart):
    """A part of the body, which all pictures share."""

    @abc.abstractmethod
    def check(self, splats: Splats) -> None:
        """Raise `ValueError` for splats that do not have the part."""

    def prepared(self, splats: Splats) -> PyTree[Array]:
        """Give what is found once, of the splats at the start."""
        del splats

    @abc.abstractmethod
    def coordinates(self, splats: Splats) -> PyTree[Array]:
        """Give the coordinates of the start: zeros."""

    @abc.abstractmethod
    def moved(self, splats: Splats, x: PyTree[Array], prepared: PyTree[Array]) -> Splats:
        """Give the splats at coordinates. Differentiable."""

    @abc.abstractmethod
    def unlikely(self, x: PyTree[Array], prepared: PyTree[Array]) -> Float[Array, ""]:
        """Give what the prior adds to the loss: squares of the coordinates over what they are
        expected to be.
        """


class AbstractShotPart(AbstractPart):
    """A part of how pictures were taken: each has its own."""

    @abc.abstractmethod
    def coordinates(self, shot: Shot) -> PyTree[Array]:
        """Give the coordinates of the start: zeros."""

    @abc.abstractmethod
    def moved(self, shot: Shot, x: PyTree[Array], middle: Float[Array, "3"]) -> Shot:
        """Give camera and lights at coordinates; `middle` is that of the body, mm.
        Differentiable.
        """


class AlbedoMap(AbstractBodyPart):
    r"""The albedo of every splat and channel, as a logit: it stays between 0 and 1.

        albedo = 1 / (1 + exp(-(logit(start) + step x)))

    **Attributes:** (static)

    - `step`: of the logit: 0.1 moves an albedo of 0.5 by 0.025.
    - `deviation`: how far from the start a logit is expected, one standard deviation of a normal
      prior. A splat that no picture tells of stays where it started; one of which they tell next to
      nothing stays near.

    Albedos that start below 0.001 or above 0.999 start there.
    """

    step: float = eqx.field(static=True, default=0.1)
    deviation: float = eqx.field(static=True, default=3.0)

    def check(self, splats: Splats) -> None:
        if splats.albedo is None:
            raise ValueError(
                "splats.albedo is None, and AlbedoMap has nothing to move: start from a map, 0.5 "
                "everywhere for one"
            )

    def coordinates(self, splats: Splats) -> Float[Array, "splats channels"]:
        assert splats.albedo is not None
        return jnp.zeros_like(splats.albedo)

    def moved(self, splats: Splats, x: Float[Array, "splats channels"], prepared: None) -> Splats:
        del prepared
        assert splats.albedo is not None
        start = jax.scipy.special.logit(jnp.clip(splats.albedo, _BOUNDED, 1 - _BOUNDED))
        return eqx.tree_at(lambda s: s.albedo, splats, jax.nn.sigmoid(start + self.step * x))

    def unlikely(self, x: Float[Array, "splats channels"], prepared: None) -> Float[Array, ""]:
        del prepared
        return jnp.sum((self.step / self.deviation * x) ** 2)


class LightStrengths(AbstractShotPart):
    """How strong each light of each picture is, channel by channel, as a logarithm: of irradiance,
    intensity or power.

    **Attributes:** (static)

    - `step`: of the logarithm: 0.05 is 5%.
    """

    step: float = eqx.field(static=True, default=0.05)

    def coordinates(self, shot: Shot) -> tuple[Float[Array, " channels"], ...]:
        return tuple(
            jnp.zeros_like(getattr(light, _of(light, _STRENGTHS))) for light in shot.lights
        )

    def moved(
        self, shot: Shot, x: tuple[Float[Array, " channels"], ...], middle: Float[Array, "3"]
    ) -> Shot:
        del middle
        lights = []
        for light, its in zip(shot.lights, x, strict=True):
            name = _of(light, _STRENGTHS)
            lights.append(_with(light, name, getattr(light, name) * jnp.exp(self.step * its)))
        return Shot(shot.camera, tuple(lights))


class LightPlaces(AbstractShotPart):
    """Where each light of each picture is: directions turn, and point lights and the origins of
    beams shift.

    **Attributes:** (static)

    - `turn`: a step of a direction, radians.
    - `shift`: a step of a position along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=0.02)
    shift: float = eqx.field(static=True, default=1.0)

    def coordinates(self, shot: Shot) -> tuple[dict[str, Float[Array, "3"]], ...]:
        return tuple(
            {name: jnp.zeros_like(getattr(light, name)) for name in _of(light, _PLACES)}
            for light in shot.lights
        )

    def moved(
        self, shot: Shot, x: tuple[dict[str, Float[Array, "3"]], ...], middle: Float[Array, "3"]
    ) -> Shot:
        del middle
        lights = []
        for light, its in zip(shot.lights, x, strict=True):
            for name in _of(light, _PLACES):
                place = getattr(light, name)
                to = (
                    rotation(self.turn * its[name]) @ place
                    if name == "direction"
                    else place + self.shift * its[name]
                )
                light = _with(light, name, to)
            lights.append(light)
        return Shot(shot.camera, tuple(lights))


class CameraPoses(AbstractShotPart):
    r"""Where each camera is and which way it looks: it turns around the middle of the splats, and
    shifts.

    Turning around the body and not around the pinhole, a turn changes what is seen of it, and a
    shift where it is in the picture: the two are not mistaken for each other.

    **Attributes:** (static)

    - `turn`: a step of the rotation vector, radians.
    - `shift`: a step along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=2e-3)
    shift: float = eqx.field(static=True, default=0.2)

    def coordinates(self, shot: Shot) -> Float[Array, "2 3"]:
        return jnp.zeros((2, 3), shot.camera.position.dtype)

    def moved(self, shot: Shot, x: Float[Array, "2 3"], middle: Float[Array, "3"]) -> Shot:
        camera, turned = shot.camera, rotation(self.turn * x[0])
        position = middle + turned @ (camera.position - middle) + self.shift * x[1]
        pose = position, camera.rotation @ turned.T
        return Shot(eqx.tree_at(lambda c: (c.position, c.rotation), camera, pose), shot.lights)


def rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    r"""Give the rotation around a vector by its length, radians. Differentiable, also where there
    is none.

        R = 1 + sin(t) / t [v] + (1 - cos t) / t^2 [v]^2,   t = |v|

    **Source:** Rodrigues 1840.
    """
    squared = jnp.sum(vector * vector)
    near = squared < 1e-2
    t = jnp.sqrt(jnp.where(near, 1.0, squared))
    first = jnp.where(
        near, 1 - squared / 6 * (1 - squared / 20 * (1 - squared / 42)), jnp.sin(t) / t
    )
    second = jnp.where(
        near, 0.5 - squared / 24 * (1 - squared / 30 * (1 - squared / 56)), (1 - jnp.cos(t)) / t**2
    )
    x, y, z = vector
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack(row) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))])
    return jnp.eye(3, dtype=vector.dtype) + first * cross + second * (cross @ cross)


def _with(light: AbstractLight, name: str, value: Array) -> AbstractLight:
    return eqx.tree_at(lambda each: getattr(each, name), light, value)


def _of(light: AbstractLight, names: dict):
    if type(light) not in names:
        known = ", ".join(kind.__name__ for kind in names)
        raise ValueError(
            f"what may move of a {type(light).__name__} is not known; of these it is: {known}"
        )
    return names[type(light)]


_STRENGTHS = {DirectionalLight: "irradiance", PointLight: "intensity", GaussianBeam: "power"}
_PLACES = {
    DirectionalLight: ("direction",),
    PointLight: ("position",),
    GaussianBeam: ("direction", "origin"),
}
