"""The controls of a studio, and the changes of camera and lights that they specify."""

import dataclasses
from collections.abc import Hashable, Iterable

import jax.numpy as jnp
import numpy as np

from splatjax._records import Numbers
from splatjax.scattering import Skin
from splatjax.scene import AbstractLight, Camera, EnvironmentLight, Scene

LAYERS = ("beauty", "diffuse", "specular", "albedo", "irradiance", "shadow")
# The coefficients of a medium and the parameters of a skin that have sliders.
COEFFICIENTS = {"sigma_a": "absorption", "sigma_s_prime": "scattering"}
PIGMENTS = ("melanin", "blood", "oxygenation", "eumelanin", "bilirubin", "thickness", "scattering")
_HIGHEST = np.radians(89)  # largest latitude of a camera, so that its up direction is defined
_VERTICAL = 1e-3  # sine of the angle to the y axis below which a line of sight is vertical
# The fields of lights that hold points or directions.
_VECTORS = ("direction", "position", "origin", "center", "edges")


@dataclasses.dataclass(frozen=True)
class Controls:
    r"""A state of a studio: all values that its picture depends on and that may change in a
    `Session`.

    **Attributes:**

    - `eye`, `target`: position of the camera, and the point at which it looks, mm.
    - `sigma_a`, `sigma_s_prime`: coefficients per channel, 1/mm; empty for a material without a
      medium.
    - `g`: mean cosine of the medium's phase function.
    - `skin`: names and values of the parameters of a `Skin`; empty without a skin.
    - `eta`, `specular`, `roughness`: as in `Material`; the medium has the same `eta`.
    - `factors`: factor of the weights of each Gaussian.
    - `scale`: factor of all weights.
    - `turn`: rotation of the lights about the vertical axis, degrees.
    - `light_stops`: change of the power of each light, stops.
    - `layer`: one of `LAYERS`.
    - `exposure`: exposure of the picture, stops.

    **Raises:** `ValueError` for an unknown layer, and for `g` or factors out of range.
    """

    eye: tuple[float, ...]
    target: tuple[float, ...]
    sigma_a: tuple[float, ...]
    sigma_s_prime: tuple[float, ...]
    eta: float
    specular: float
    roughness: float
    g: float = 0.0
    skin: tuple[tuple[str, float], ...] = ()
    factors: tuple[float, ...] = ()
    scale: float = 1.0
    turn: float = 0.0
    light_stops: tuple[float, ...] = ()
    layer: str = "beauty"
    exposure: float = 0.0

    @classmethod
    def of(
        cls,
        scene: Scene,
        camera: Camera,
        target: Numbers,
        exposure: float,
        skin: Skin | None,
        g: float,
    ) -> "Controls":
        """Return the initial state."""
        material, medium = scene.material, scene.material.medium if skin is None else None
        return cls(
            eye=plain(camera.position),
            target=plain(target),
            sigma_a=() if medium is None else plain(medium.sigma_a),
            sigma_s_prime=() if medium is None else plain(medium.sigma_s_prime),
            eta=_rounded(material.eta),
            specular=_rounded(material.specular),
            roughness=_rounded(material.roughness),
            g=_rounded(g),
            skin=tuple((name, _rounded(getattr(skin, name))) for name in PIGMENTS if skin),
            factors=(1.0,) * len(material.gaussians.variances),
            light_stops=(0.0,) * len(scene.lights),
            exposure=exposure,
        )

    def __post_init__(self):
        if self.layer not in LAYERS:
            raise ValueError(f"layer is {self.layer!r}; give {', '.join(LAYERS)}")
        if not -1 < self.g < 1:
            raise ValueError(f"g is {self.g}; it must be between -1 and 1, both excluded")
        if min(self.scale, *self.factors, 0) < 0:
            raise ValueError(
                f"scale is {self.scale} and factors are {self.factors}; they must be at least 0"
            )

    @property
    def has_fitted_weights(self) -> bool:
        return {self.scale, *self.factors} == {1.0}

    @property
    def coefficients(self) -> Hashable:
        return self.sigma_a, self.sigma_s_prime, self.g, self.skin, self.eta

    def camera(self, first: Camera, start: "Controls") -> Camera:
        """Return the camera of the state: `first` in the view of the start; elsewhere `first` moved
        and turned, with +y up in the picture, or its own upward direction for a vertical view.
        """
        if np.allclose((self.eye, self.target), (start.eye, start.target)):
            return first
        offset = np.subtract(self.eye, self.target)
        is_vertical = np.hypot(offset[0], offset[2]) < _VERTICAL * np.linalg.norm(offset)
        up = -first.rotation[1] if is_vertical else (0.0, 1.0, 0.0)
        rotation = Camera.look_at(self.eye, self.target, up=up).rotation
        return dataclasses.replace(first, position=self.eye, rotation=rotation)


def plain(values: Numbers) -> tuple[float, ...]:
    return tuple(np.asarray(values, np.float64).tolist())


def _rounded(value: Numbers) -> float:
    return round(float(np.asarray(value)), 6)


def rotation_about_y(degrees: float) -> np.ndarray:
    """Return the rotation that turns +z towards +x."""
    turn = np.exp(1j * np.radians(degrees))
    return np.asarray([[turn.real, 0.0, turn.imag], [0.0, 1.0, 0.0], [-turn.imag, 0.0, turn.real]])


def orbited(place: np.ndarray, turn: float, rise: float) -> np.ndarray:
    """Rotate a camera around its target by angles in degrees, about the y axis and upwards.

    **Arguments:**

    - `place`: the position and the target of the camera.
    """
    offset = rotation_about_y(turn) @ (place[0] - place[1])
    distance, level = np.linalg.norm(offset), np.linalg.norm(offset[[0, 2]])
    latitude = np.arctan2(offset[1], level) + np.radians(rise)
    latitude = np.clip(latitude, -_HIGHEST, _HIGHEST)
    across = np.cos(latitude) / max(level, 1e-9 * distance)
    offset = distance * np.asarray([across * offset[0], np.sin(latitude), across * offset[2]])
    return np.asarray([place[1] + offset, place[1]])


def shifted(place: np.ndarray, across: float, down: float, camera: Camera) -> np.ndarray:
    """Move the place of a camera, its position and target, so that the picture shifts by fractions
    of its height.
    """
    right, below = np.asarray(camera.rotation)[:2]
    height = np.linalg.norm(place[0] - place[1]) / float(camera.focal_length)
    return place - height * (across * right + down * below)


def turned(lights: Iterable[AbstractLight], degrees: float) -> tuple[AbstractLight, ...]:
    """Turn lights about the y axis. A positive angle turns +z towards +x. The image of an
    environment turns about its own axis, also if its `directions` are fixed.

    **Raises:** `ValueError` for a light that has neither a direction nor a position.
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
    """Multiply the power of each light by 2 to the power of its stops."""
    return [
        dataclasses.replace(
            light, **{light.strength_field: getattr(light, light.strength_field) * 2.0**stop}
        )
        for light, stop in zip(lights, stops, strict=True)
    ]
