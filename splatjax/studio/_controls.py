"""What can be turned in a studio."""

import dataclasses
from collections.abc import Hashable, Iterable

import jax.numpy as jnp
import numpy as np

from splatjax.scene import AbstractLight, EnvironmentLight

LAYERS = ("beauty", "diffuse", "specular", "albedo", "irradiance", "shadow")
SURFACE = ("eta", "specular", "roughness")
# What a medium and a skin are changed by, and derivatives are taken in.
COEFFICIENTS = {"sigma_a": "absorption", "sigma_s_prime": "scattering"}
PIGMENTS = ("melanin", "blood", "oxygenation", "eumelanin", "bilirubin", "thickness", "scattering")
# Fields of lights that are points or directions.
_VECTORS = ("direction", "position", "origin", "center", "edges")


@dataclasses.dataclass(frozen=True)
class Controls:
    r"""A state of a studio: all that the picture depends on, besides what a `Session` is made of.

    **Attributes:**

    - `eye`, `target`: of the camera, mm.
    - `sigma_a`, `sigma_s_prime`: per channel, 1/mm; empty for a material without a medium.
    - `skin`: names and values of a `Skin`; empty without one.
    - `eta`, `specular`, `roughness`: as those of a `Material`; `eta` is the medium's too.
    - `scale`: factor on the weights.
    - `turn`: of the lights about the vertical axis, degrees.
    - `light_stops`: of each light, by which it is brighter; each doubles it.
    - `layer`: one of `LAYERS`.
    - `exposure`: stops.
    """

    eye: tuple[float, ...]
    target: tuple[float, ...]
    sigma_a: tuple[float, ...]
    sigma_s_prime: tuple[float, ...]
    eta: float
    specular: float
    roughness: float
    skin: tuple[tuple[str, float], ...] = ()
    scale: float = 1.0
    turn: float = 0.0
    light_stops: tuple[float, ...] = ()
    layer: str = "beauty"
    exposure: float = 0.0

    @property
    def coefficients(self) -> Hashable:
        return self.sigma_a, self.sigma_s_prime, self.skin, self.eta


def rotation_about_y(degrees: float) -> np.ndarray:
    """Return the rotation that turns +z towards +x."""
    turn = np.exp(1j * np.radians(degrees))
    return np.asarray([[turn.real, 0.0, turn.imag], [0.0, 1.0, 0.0], [-turn.imag, 0.0, turn.real]])


def turned(lights: Iterable[AbstractLight], degrees: float) -> tuple[AbstractLight, ...]:
    """Turn lights about the y axis: a positive angle turns +z towards +x. Of an environment with
    fixed `directions` the image turns, about its own axis.

    **Raises:** `ValueError` for a light that has neither direction nor place.
    """

    def turn(light: AbstractLight) -> AbstractLight:
        if isinstance(light, EnvironmentLight):
            return dataclasses.replace(light, rotation=light.rotation + degrees)
        vectors = {
            name: value @ jnp.asarray(rotation_about_y(degrees).T, value.dtype)
            for name, value in vars(light).items()
            if name in _VECTORS
        }
        if not vectors:
            raise ValueError(f"{type(light).__name__} cannot be turned; give an EnvironmentLight")
        return dataclasses.replace(light, **vectors)

    return tuple(map(turn, lights)) if degrees else tuple(lights)


def brightened(lights: Iterable[AbstractLight], stops: Iterable[float]) -> list[AbstractLight]:
    """Double the power of each light by its number of stops."""
    return [
        dataclasses.replace(
            light, **{light.strength_field: getattr(light, light.strength_field) * 2.0**stop}
        )
        for light, stop in zip(lights, stops, strict=True)
    ]
