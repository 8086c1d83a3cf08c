"""Pictures that were taken, and how: a TOML file that names them, with cameras and lights."""

import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from splatjax.inverse import KnownIntensity, Observation, UnknownColor, UnknownIntensity
from splatjax.scene import AbstractLight, Camera, DirectionalLight, GaussianBeam, PointLight

from ._files import naming
from ._images import read_picture
from ._tables import AT_LEAST_0, FINITE, POSITIVE, Rule, Table, read_toml

_INTENSITIES = {"known": KnownIntensity, "unknown": UnknownIntensity, "unknown color": UnknownColor}
_ENTRIES = ("file", "mask", "noise", "intensity", "camera", "lights")
_CAMERA = ("position", "target", "up", "fov")
_LIGHTS = {
    "directional": (DirectionalLight, ("direction", "irradiance", "cast_shadows")),
    "point": (PointLight, ("position", "intensity", "cast_shadows")),
    "beam": (GaussianBeam, ("origin", "direction", "power", "variance")),
}
_DIRECTION: Rule = ("finite, not all 0", lambda x: np.isfinite(x).all() and np.any(x))
_LIGHT_ENTRIES = {"kind"}.union(*(names for _, names in _LIGHTS.values()))
_VECTORS = {"direction": _DIRECTION, "position": FINITE, "origin": FINITE}
_FOV: Rule = ("between 0 and 180 (degrees)", lambda x: (x > 0) & (x < 180))


def read_observations(path: str | os.PathLike[str]) -> list[Observation]:
    r"""Read which pictures were taken, and how.

        [[pictures]]
        file = "left.exr"           # linear light: R, G and B, or Y; beside this file
        mask = "left_mask.exr"      # optional: pixels that are 0 do not count
        noise = 0.01                # optional: standard deviation over the root mean square
        intensity = "known"         # or "unknown": one factor on its light is found;
                                    # or "unknown color": one for each channel
        camera = { position = [0, 0, 500], target = [0, 0, 0], fov = 25 }  # mm, degrees (vertical)
        [[pictures.lights]]
        kind = "directional"        # direction (the way it travels), irradiance; cast_shadows
        direction = [1, -0.3, -0.5]
        irradiance = [3.14, 3.14, 3.14]

    A camera may have `up`. Other kinds of lights are "point" (`position` in mm, `intensity`,
    `cast_shadows`) and "beam" (`origin`, `direction`, `power`, `variance` in mm^2). Color is one
    number per channel, or one for all.

    **Returns:** an `Observation` for each picture, in JAX's default precision.

    **Raises:** `ValueError` for a file that is none of these: what is wrong, and what would be
    right; `FileNotFoundError` for a picture that is missing.
    """
    path = Path(path)
    file = Table(path, "", read_toml(path, "name one that lists pictures"), ["pictures"])
    return [_observation(table) for table in file.tables("pictures", _ENTRIES)]


def picture_paths(path: str | os.PathLike[str]) -> list[Path]:
    """Return the files that the observations of a file are read from, itself first."""
    path = Path(path)
    pictures = read_toml(path, "name one that lists pictures")["pictures"]
    names = [each[name] for each in pictures for name in ("file", "mask") if name in each]
    return [path, *(path.parent / name for name in names)]


def _observation(table: Table) -> Observation:
    picture = _picture(table, "file")
    height, width, channels = picture.shape
    mask = deviation = None
    if "mask" in table.entries:
        mask = np.any(_picture(table, "mask") > 0, axis=-1)
    if "noise" in table.entries:
        known = np.all(np.isfinite(picture), axis=-1)
        known &= True if mask is None or mask.shape != known.shape else mask
        size = np.sqrt(np.mean(np.square(picture[known]))) if known.any() else 0.0
        deviation = jnp.full(picture.shape, table.numbers("noise", POSITIVE, ()) * (size or 1.0))
    given = table.table("camera", _CAMERA)
    view: dict[str, Any] = {
        name: given.numbers(name, FINITE, (3,), fill=False)
        for name in ("position", "target", "up")
        if name != "up" or name in given.entries
    }
    view["fov"] = float(given.numbers("fov", _FOV, (), 25.0))
    with naming(given.where):
        camera = Camera.look_at(
            view.pop("position"), view.pop("target"), **view, width=width, height=height
        )
    lights = tuple(_light(each, channels) for each in table.tables("lights", _LIGHT_ENTRIES))
    intensity = _INTENSITIES[table.one_of("intensity", _INTENSITIES, "known")]()
    with naming(table.where):
        return Observation(jnp.asarray(picture, float), camera, lights, mask, deviation, intensity)


def _picture(table: Table, name: str) -> np.ndarray:
    file = table.entries.get(name)
    if not isinstance(file, str):
        raise ValueError(f"{table.where} {name} must be the name of an EXR file; it is {file!r}")
    with naming(f"{table.where} {name}"):
        return read_picture(table.path.parent / file)


def _light(table: Table, channels: int) -> AbstractLight:
    light, names = _LIGHTS[table.one_of("kind", _LIGHTS)]
    table, values = Table(table.path, table.name, table.entries, ("kind", *names)), {}
    for name in names:
        if name == "cast_shadows":
            values[name] = table.one_of(name, (True, False), True)
        elif name in _VECTORS:
            values[name] = table.numbers(name, _VECTORS[name], (3,), fill=False)
        else:
            shape = () if name == "variance" else (channels,)
            values[name] = table.numbers(name, AT_LEAST_0, shape)
    return light(**values)
