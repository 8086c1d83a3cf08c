"""Parts of a scene that may move, each in unbounded coordinates."""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from splatjax._records import check_values
from splatjax.scene import AbstractLight, Camera, Material, Scene, Splats

# An albedo moves between this and one less this: at 0 and 1 themselves the logit is infinite.
_BOUNDED = 1e-3


class PicturedScene(eqx.Module):
    """The splats of a picture, its camera and its lights."""

    splats: Splats
    camera: Camera
    lights: tuple[AbstractLight, ...]

    def scene(self, material: Material) -> Scene:
        return Scene(self.splats, self.lights, material)


class AbstractPart(eqx.Module):
    r"""A part that may move. Its coordinates count steps from its start, where they are zero.

    An optimizer sees coordinates in steps, so that one learning rate serves all parts: Adam at a
    rate of 1 moves each by up to one step at a time.

    **Attributes:** (of the class)

    - `shared`: whether all pictures share the part; else each has its own.
    """

    shared: ClassVar[bool] = False

    def __check_init__(self):
        for field in dataclasses.fields(self):
            check_values(
                f"{type(self).__name__}.{field.name}",
                getattr(self, field.name),
                "positive",
                lambda x: x > 0,
            )

    def prepared(self, splats: Splats) -> PyTree[Array]:
        """Compute data that depend only on the initial splats."""
        return None

    @abc.abstractmethod
    def coordinates(self, pictured: PicturedScene) -> PyTree[Array]:
        """Return the coordinates of the start: zeros. Raise `ValueError` without such a part."""

    @abc.abstractmethod
    def moved(
        self, pictured: PicturedScene, x: PyTree[Array], prepared: PyTree[Array]
    ) -> PicturedScene:
        """Apply coordinates to the part. Differentiable."""

    def prior(self, x: PyTree[Array], prepared: PyTree[Array]) -> Float[Array, ""] | float:
        """Compute the loss of the prior: squares of coordinates over their expected deviations."""
        return 0.0


class AlbedoMap(AbstractPart):
    r"""The albedo of every splat and channel, as a logit: it stays between 0 and 1.

        albedo = 1 / (1 + exp(-(logit(start) + step x)))

    **Attributes:** (static)

    - `step`: of the logit: 0.1 moves an albedo of 0.5 by 0.025.
    - `deviation`: expected distance of a logit from its start, one standard deviation of a normal
      prior. An invisible splat keeps its albedo; a hardly visible one nearly keeps it.

    Initial albedos are clamped to [0.001, 0.999].
    """

    shared = True
    step: float = eqx.field(static=True, default=0.1)
    deviation: float = eqx.field(static=True, default=3.0)

    def coordinates(self, pictured: PicturedScene) -> Float[Array, "splats channels"]:
        if pictured.splats.albedo is None:
            raise ValueError(
                "splats.albedo is None, and AlbedoMap needs a start; give a map, such as 0.5 "
                "everywhere"
            )
        return jnp.zeros_like(pictured.splats.albedo)

    def moved(
        self, pictured: PicturedScene, x: Float[Array, "splats channels"], prepared: None
    ) -> PicturedScene:
        start = jnp.clip(pictured.splats.albedo, _BOUNDED, 1 - _BOUNDED)
        albedo = jax.nn.sigmoid(jax.scipy.special.logit(start) + self.step * x)
        return eqx.tree_at(lambda s: s.splats.albedo, pictured, albedo)

    def prior(self, x: Float[Array, "splats channels"], prepared: None) -> Float[Array, ""]:
        return jnp.sum((self.step / self.deviation * x) ** 2)


class LightStrengths(AbstractPart):
    """The strength of each light of each picture, channel by channel, as a logarithm: of
    irradiance, intensity or power.

    **Attributes:** (static)

    - `step`: of the logarithm: 0.05 is 5%.
    """

    step: float = eqx.field(static=True, default=0.05)

    def coordinates(self, pictured: PicturedScene) -> tuple[Float[Array, " channels"], ...]:
        for light in pictured.lights:
            if not light.strength_field:
                raise ValueError(
                    f"{type(light).__name__}.strength_field names no field that LightStrengths "
                    "can change"
                )
        return tuple(
            jnp.zeros_like(getattr(light, light.strength_field)) for light in pictured.lights
        )

    def moved(self, pictured: PicturedScene, x, prepared) -> PicturedScene:
        def move(light: AbstractLight, steps: Array) -> AbstractLight:
            strength = getattr(light, light.strength_field) * jnp.exp(self.step * steps)
            return dataclasses.replace(light, **{light.strength_field: strength})

        return dataclasses.replace(pictured, lights=tuple(map(move, pictured.lights, x)))


class LightPlaces(AbstractPart):
    """The position of each light of each picture: directions rotate, and point lights and the
    origins of beams shift.

    **Attributes:** (static)

    - `turn`: a step of a direction, radians.
    - `shift`: a step of a position along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=0.02)
    shift: float = eqx.field(static=True, default=1.0)

    def coordinates(self, pictured: PicturedScene) -> tuple[dict[str, Float[Array, "3"]], ...]:
        return tuple(
            {
                name: jnp.zeros_like(getattr(light, name))
                for name in ("direction", "position", "origin")
                if hasattr(light, name)
            }
            for light in pictured.lights
        )

    def moved(self, pictured: PicturedScene, x, prepared) -> PicturedScene:
        def move(light: AbstractLight, steps: dict[str, Array]) -> AbstractLight:
            places = {
                name: rotation(self.turn * step) @ getattr(light, name)
                if name == "direction"
                else getattr(light, name) + self.shift * step
                for name, step in steps.items()
            }
            return dataclasses.replace(light, **places)

        return dataclasses.replace(pictured, lights=tuple(map(move, pictured.lights, x)))


class CameraPoses(AbstractPart):
    r"""Position and rotation of each camera, which rotates around the middle of the splats, and
    shifts.

    A rotation around the body changes the visible side, and a shift the position of the body in the
    picture. Rotations around the pinhole would be nearly equivalent to shifts.

    **Attributes:** (static)

    - `turn`: a step of the rotation vector, radians.
    - `shift`: a step along each axis, mm.
    """

    turn: float = eqx.field(static=True, default=2e-3)
    shift: float = eqx.field(static=True, default=0.2)

    def prepared(self, splats: Splats) -> Float[Array, "3"]:
        return jnp.mean(splats.centers, axis=0)

    def coordinates(self, pictured: PicturedScene) -> Float[Array, "2 3"]:
        return jnp.zeros((2, 3), pictured.camera.position.dtype)

    def moved(self, pictured: PicturedScene, x, prepared: Float[Array, "3"]) -> PicturedScene:
        middle, camera, turned = prepared, pictured.camera, rotation(self.turn * x[0])
        position = middle + turned @ (camera.position - middle) + self.shift * x[1]
        return eqx.tree_at(
            lambda s: (s.camera.position, s.camera.rotation),
            pictured,
            (position, camera.rotation @ turned.T),
        )


def rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    r"""Compute the rotation around a vector by its length, radians. Differentiable at 0, too.

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
