"""Pictures that were taken, and how: a TOML file that names them, with cameras and lights."""

import math
import os
import tomllib
from pathlib import Path

import numpy as np

from splatjax.inverse import (
    AbstractIntensity,
    KnownIntensity,
    Observation,
    UnknownColor,
    UnknownIntensity,
)
from splatjax.scene import AbstractLight, Camera, DirectionalLight, GaussianBeam, PointLight

from ._exr import read_picture
from ._tables import Table, as_array

_INTENSITIES = {"known": KnownIntensity, "unknown": UnknownIntensity, "unknown color": UnknownColor}
_ENTRIES = {"file", "mask", "noise", "intensity", "camera", "lights"}
_LIGHTS = {
    "directional": {"direction", "irradiance", "cast_shadows"},
    "point": {"position", "intensity", "cast_shadows"},
    "beam": {"origin", "direction", "power", "variance"},
}


def read_observations(path: str | os.PathLike[str]) -> list[Observation]:
    r"""Read which pictures were taken, and how.

        [[pictures]]
        file = "left.exr"           # linear light: R, G and B, or Y; beside this file
        mask = "left_mask.exr"      # optional: pixels that are 0 do not count
        noise = 0.01                # optional: standard deviation over the picture's root mean
        square intensity = "known"         # or "unknown": one factor on its light is found; or
        "unknown color": one for each channel camera = { position = [0, 0, 500], target = [0, 0, 0],
        fov = 25 }      # mm, degrees (vertical); up = [0, 1, 0] [[pictures.lights]] kind =
        "directional"        # direction (the way it travels), irradiance; cast_shadows = true
        direction = [1, -0.3, -0.5] irradiance = [3.14, 3.14, 3.14]

    Other kinds of lights are "point" (`position` in mm, `intensity`, `cast_shadows`) and "beam"
    (`origin`, `direction`, `power`, `variance` in mm^2). Color is one number per channel.

    **Returns:** an `Observation` for each picture, in JAX's default precision.

    **Raises:** `ValueError` for a file that is none of these: what is wrong, and what would be
    right; `FileNotFoundError` for a picture that is missing.
    """
    path = Path(path)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(
            f"{path}: cannot be read ({error.strerror}); name a TOML file that lists pictures"
        ) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is no TOML file: {error}") from None
    found = tables.get("pictures")
    if set(tables) != {"pictures"} or not isinstance(found, list) or not found:
        raise ValueError(
            f"{path}: must hold one [[pictures]] or more, and nothing else; it has "
            f"{', '.join(sorted(tables)) or 'none'}"
        )
    return [
        _observation(path, number, Table(path, f"pictures {number}", each))
        for number, each in enumerate(found, 1)
    ]


def picture_paths(path: str | os.PathLike[str]) -> list[Path]:
    """Give the files that the observations of a file are read from, itself first."""
    path = Path(path)
    pictures = tomllib.loads(path.read_text(encoding="utf-8"))["pictures"]
    return [
        path,
        *(
            path.parent / each[name]
            for each in pictures
            for name in ("file", "mask")
            if name in each
        ),
    ]


def _observation(path: Path, number: int, table: Table) -> Observation:
    table.only(_ENTRIES)
    picture = _picture(path, table, "file")
    height, width, channels = picture.shape
    mask = deviation = None
    if "mask" in table.table:
        mask = np.any(_picture(path, table, "mask") > 0, axis=-1)
    if "noise" in table.table:
        share = table.number("noise", "positive", lambda x: x > 0, 0.01)
        known = picture[
            np.all(np.isfinite(picture), axis=-1)
            & (True if mask is None or mask.shape != (height, width) else mask)
        ]
        size = share * math.sqrt(np.mean(known**2)) if known.size else share
        deviation = as_array(np.full(picture.shape, size or share))
    camera = _camera(
        Table(path, f"pictures {number} camera", table.entry("camera", "a table")), width, height
    )
    lights = table.entry("lights", "one [[pictures.lights]] or more")
    if not isinstance(lights, list) or not lights:
        raise ValueError(
            f"{table.where} lights must be one [[pictures.lights]] or more; it is {lights!r}"
        )
    made = tuple(
        _light(Table(path, f"pictures {number} lights {i}", each), channels)
        for i, each in enumerate(lights, 1)
    )
    try:
        return Observation(as_array(picture), camera, made, mask, deviation, _intensity(table))
    except ValueError as error:
        raise ValueError(f"{table.where} {error}") from None


def _picture(path: Path, table: Table, name: str) -> np.ndarray:
    try:
        return read_picture(path.parent / _text(table, name))
    except OSError as error:
        raise FileNotFoundError(f"{table.where} {name}: {error}") from None


def _camera(table: Table, width: int, height: int) -> Camera:
    table.only({"position", "target", "up", "fov"})
    up = _vector(table, "up") if "up" in table.table else None
    fov = table.number("fov", "between 0 and 180 degrees", lambda x: 0 < x < 180, 25.0)
    position, target = _vector(table, "position"), _vector(table, "target")
    try:
        return Camera.look_at(position, target, up=up, fov=fov, width=width, height=height)
    except ValueError as error:
        raise ValueError(f"{table.where} {error}") from None


def _light(table: Table, channels: int) -> AbstractLight:
    kind = table.table.get("kind")
    if not isinstance(kind, str) or kind not in _LIGHTS:
        raise ValueError(f"{table.where} kind must be one of {', '.join(_LIGHTS)}; it is {kind!r}")
    table.only(_LIGHTS[kind] | {"kind"})
    shadows = table.table.get("cast_shadows", True)
    if not isinstance(shadows, bool):
        raise ValueError(f"{table.where} cast_shadows must be true or false; it is {shadows!r}")
    match kind:
        case "directional":
            return DirectionalLight(
                _vector(table, "direction", True), _color(table, "irradiance", channels), shadows
            )
        case "point":
            return PointLight(
                _vector(table, "position"), _color(table, "intensity", channels), shadows
            )
    variance = table.numbers("variance", "positive (mm^2)", lambda x: x > 0, channels=1)
    way = _vector(table, "direction", True)
    return GaussianBeam(
        _vector(table, "origin"), way, _color(table, "power", channels), as_array(variance)[0]
    )


def _intensity(table: Table) -> AbstractIntensity:
    found = table.table.get("intensity", "known")
    if not isinstance(found, str) or found not in _INTENSITIES:
        raise ValueError(
            f"{table.where} intensity must be one of {', '.join(_INTENSITIES)}; it is {found!r}"
        )
    return _INTENSITIES[found]()


def _vector(table: Table, name: str, points: bool = False):
    found = table.numbers(name, "three of them", lambda x: np.isfinite(x))
    if found.shape != (3,) or (points and not np.any(found)):
        raise ValueError(
            f"{table.where} {name} must be three numbers{', not all 0' if points else ''}; it is "
            f"{found.tolist()}"
        )
    return as_array(found)


def _color(table: Table, name: str, channels: int):
    found = table.numbers(name, "at least 0", lambda x: x >= 0, channels=channels)
    if found.shape != (channels,):
        raise ValueError(
            f"{table.where} {name} must be {channels} numbers, as its picture has channels; it is "
            f"{found.tolist()}"
        )
    return as_array(found)


def _text(table: Table, name: str) -> str:
    found = table.entry(name, "the name of an EXR file")
    if not isinstance(found, str):
        raise ValueError(f"{table.where} {name} must be the name of an EXR file; it is {found!r}")
    return found
