"""Movable parts of a scene in unbounded coordinates (albedo, lights and cameras), and the scene
with all its movable parts.
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from splatjax._records import check_values, require
from splatjax.scene import AbstractLight, Material, Splats, rotation_by

from ._observation import PicturedScene

# Least distance of initial values from 0 and 1, where logits are infinite.
BOUNDED = 1e-3
_PLACES = ("direction", "position", "origin", "center")  # fields of lights

# Coordinates of each part, as a tuple with one entry per picture if pictures do not share the part.
Coordinates = tuple[PyTree[Array], ...]


class AbstractPart(eqx.Module):
    r"""A part that may move. Its coordinates are zero at the start, and are in units of its steps.

    **Attributes:** (of the class)

    - `shared`: whether all pictures share the part; otherwise each picture has its own.
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

    def check_material(self, material: Material) -> None:
        """Raise `ValueError` for a material that does not match the part."""

    def prepared(self, splats: Splats) -> PyTree[Array]:
        """Compute data that depend only on the initial splats."""
        return None

    @abc.abstractmethod
    def coordinates(self, pictured: PicturedScene) -> PyTree[Array]:
        """Return the initial coordinates, zeros. Raise `ValueError` if the scene lacks the part."""

    @abc.abstractmethod
    def moved(
        self, pictured: PicturedScene, x: PyTree[Array], prepared: PyTree[Array]
    ) -> PicturedScene:
        """Apply coordinates to the part. Differentiable."""

    def prior_residuals(self, x: PyTree[Array], prepared: PyTree[Array]) -> PyTree[Array]:
        """Divide coordinates by their expected deviations. Under the prior, the results are
        independent with mean 0 and deviation 1. Linear; `None` without a prior.
        """
        return None

    def maps(self, x: PyTree[Array], prepared: PyTree[Array]) -> dict[str, Float[Array, " splats"]]:
        """Compute the maps of material parameters of the part, by name."""
        return {}


class AlbedoMap(AbstractPart):
    r"""The albedo of every splat and channel, as a logit so that it stays between 0 and 1.

        albedo = 1 / (1 + exp(-(logit(start) + step x)))

    **Attributes:** (static)

    - `step`: change of the logit per step: 0.1 moves an albedo of 0.5 by 0.025.
    - `deviation`: standard deviation of the normal prior of a logit about its start. An invisible
      splat keeps its albedo, and a hardly visible splat nearly keeps it.

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

    def moved(self, pictured: PicturedScene, x, prepared) -> PicturedScene:
        start = jax.scipy.special.logit(jnp.clip(pictured.splats.albedo, BOUNDED, 1 - BOUNDED))
        return eqx.tree_at(
            lambda s: s.splats.albedo, pictured, jax.nn.sigmoid(start + self.step * x)
        )

    def prior_residuals(self, x: Float[Array, "splats channels"], prepared: None):
        return self.step / self.deviation * x


class LightStrengths(AbstractPart):
    """The logarithm of the strength (irradiance, intensity or power) of each light in each picture,
    per channel.

    **Attributes:** (static)

    - `step`: change of the logarithm per step; 0.05 is 5%.
    """

    step: float = eqx.field(static=True, default=0.05)

    def coordinates(self, pictured: PicturedScene) -> tuple[Float[Array, " channels"], ...]:
        for light in pictured.lights:
            require(
                light.strength_field,
                f"{type(light).__name__}.strength_field names no field that LightStrengths can "
                "change",
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
    """The position or direction of each light in each picture. Directions rotate; point lights, the
    origins of beams and the centers of area lights shift.

    **Attributes:** (static)

    - `turn`: rotation of a direction per step, radians.
    - `shift`: shift of a position along each axis per step, mm.
    """

    turn: float = eqx.field(static=True, default=0.02)
    shift: float = eqx.field(static=True, default=1.0)

    def coordinates(self, pictured: PicturedScene) -> tuple[dict[str, Float[Array, "3"]], ...]:
        return tuple(
            {name: jnp.zeros_like(getattr(light, name)) for name in _PLACES if hasattr(light, name)}
            for light in pictured.lights
        )

    def moved(self, pictured: PicturedScene, x, prepared) -> PicturedScene:
        def move(light: AbstractLight, steps: dict[str, Array]) -> AbstractLight:
            places = {
                name: rotation_by(self.turn * step) @ getattr(light, name)
                if name == "direction"
                else getattr(light, name) + self.shift * step
                for name, step in steps.items()
            }
            return dataclasses.replace(light, **places)

        return dataclasses.replace(pictured, lights=tuple(map(move, pictured.lights, x)))


class CameraPoses(AbstractPart):
    r"""The pose of each camera, which rotates around the center of the splats and shifts.

    A rotation around the body changes the visible side; a shift changes the position of the body in
    the picture. Rotations around the pinhole would be nearly equivalent to shifts.

    **Attributes:** (static)

    - `turn`: change of the rotation vector per step, radians.
    - `shift`: shift along each axis per step, mm.
    """

    turn: float = eqx.field(static=True, default=2e-3)
    shift: float = eqx.field(static=True, default=0.2)

    def prepared(self, splats: Splats) -> Float[Array, "3"]:
        return jnp.mean(splats.centers, axis=0)

    def coordinates(self, pictured: PicturedScene) -> Float[Array, "2 3"]:
        return jnp.zeros((2, 3), pictured.camera.position.dtype)

    def moved(self, pictured: PicturedScene, x, prepared: Float[Array, "3"]) -> PicturedScene:
        middle, camera, turned = prepared, pictured.camera, rotation_by(self.turn * x[0])
        position = middle + turned @ (camera.position - middle) + self.shift * x[1]
        return eqx.tree_at(
            lambda s: (s.camera.position, s.camera.rotation),
            pictured,
            (position, camera.rotation @ turned.T),
        )


class MovableScene(eqx.Module):
    """The material and the movable parts of a scene."""

    material: Material
    parts: tuple[AbstractPart, ...]
    prepared: tuple[PyTree[Array], ...]

    @classmethod
    def of(
        cls, splats: Splats, material: Material, parts: Sequence[AbstractPart]
    ) -> "MovableScene":
        return cls(material, tuple(parts), tuple(part.prepared(splats) for part in parts))

    def start(self, pictured_scenes: Sequence[PicturedScene]) -> Coordinates:
        """Return the initial coordinates, zeros. Raise `ValueError` for a part that has none."""
        start = tuple(
            part.coordinates(pictured_scenes[0])
            if part.shared
            else tuple(part.coordinates(pictured) for pictured in pictured_scenes)
            for part in self.parts
        )
        for part, coordinates in zip(self.parts, start, strict=True):
            name = type(part).__name__
            require(
                jax.tree.leaves(coordinates), f"parts: no picture has what {name} changes; omit it"
            )
        return start

    def of_picture(self, x: Coordinates, number: int) -> Coordinates:
        """Select the coordinates that a picture depends on."""
        return tuple(
            coordinates if part.shared else coordinates[number]
            for part, coordinates in zip(self.parts, x, strict=True)
        )

    def of_all(self, pictures: Sequence[Coordinates]) -> Coordinates:
        """Combine the derivatives of all pictures, and add those of shared parts."""
        return tuple(
            jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), *derivatives)
            if part.shared
            else derivatives
            for part, derivatives in zip(self.parts, zip(*pictures, strict=True), strict=True)
        )

    def moved(self, pictured: PicturedScene, x: Coordinates) -> PicturedScene:
        for part, coordinates, prepared in zip(self.parts, x, self.prepared, strict=True):
            pictured = part.moved(pictured, coordinates, prepared)
        return pictured

    def prior_residuals(self, x: Coordinates) -> list[Array]:
        """Divide the coordinates of all parts with a prior by their expected deviations."""
        return jax.tree.leaves(
            [
                part.prior_residuals(group, prepared)
                for part, coordinates, prepared in zip(self.parts, x, self.prepared, strict=True)
                for group in ((coordinates,) if part.shared else coordinates)
            ]
        )

    def maps(self, x: Coordinates) -> dict[str, Float[Array, " splats"]]:
        """Compute the maps of material parameters, by name."""
        maps = {}
        for part, coordinates, prepared in zip(self.parts, x, self.prepared, strict=True):
            maps |= part.maps(coordinates, prepared)
        return maps
