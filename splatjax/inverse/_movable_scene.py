"""All movable parts of a scene: their coordinates, the moved scene, and the state of a fit."""

from collections.abc import Sequence

import equinox as eqx
import jax
from jaxtyping import Array, Float, PyTree

from splatjax.render import Plan
from splatjax.scene import Material, Splats

from ._observation import PicturedScene
from ._parts import AbstractPart

# Coordinates of each part; a tuple with one entry per picture if pictures do not share the part.
Coordinates = tuple[PyTree[Array], ...]


class MovableScene(eqx.Module):
    """The material, and the parts of the scene that may move."""

    material: Material
    parts: tuple[AbstractPart, ...]
    prepared: tuple[PyTree[Array], ...]

    @classmethod
    def of(
        cls, splats: Splats, material: Material, parts: Sequence[AbstractPart]
    ) -> "MovableScene":
        return cls(material, tuple(parts), tuple(part.prepared(splats) for part in parts))

    def start(self, pictured_scenes: Sequence[PicturedScene]) -> Coordinates:
        """Return the coordinates of the start: zeros."""
        return tuple(
            part.coordinates(pictured_scenes[0])
            if part.shared
            else tuple(part.coordinates(pictured) for pictured in pictured_scenes)
            for part in self.parts
        )

    def of_picture(self, x: Coordinates, number: int) -> Coordinates:
        """Select the coordinates that a picture depends on."""
        return tuple(
            coordinates if part.shared else coordinates[number]
            for part, coordinates in zip(self.parts, x, strict=True)
        )

    def of_all(self, pictures: Sequence[Coordinates]) -> Coordinates:
        """Combine the derivatives of all pictures: add the derivatives of shared parts."""
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
        """Compute the maps of parameters of the material, by name."""
        maps = {}
        for part, coordinates, prepared in zip(self.parts, x, self.prepared, strict=True):
            maps |= part.maps(coordinates, prepared)
        return maps


class FitState(eqx.Module):
    """The state of a fit after its last step.

    **Attributes:**

    - `x`: the coordinates of the next step.
    - `optimizer`: state of the optimizer; `None` for its initial state.
    - `plans`: plans of the pictures.
    - `expected`: means of the residuals of the priors; zero except in `randomized_fits`.
    """

    x: Coordinates
    optimizer: PyTree
    plans: list[Plan]
    expected: list[Array]
