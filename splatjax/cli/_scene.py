"""Scenes of the command line: a camera from a file, and a scene in the manifest of a picture."""

import os
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import splatjax as sj

from ._terminal import option_name

# Of scenes, and of pictures whose manifest is one.
SCENE_FILES = (".toml", ".exr")
_BESIDE = {"splats", "output", "background", "exposure", "half", "quiet"}


def camera_of(source: str, mm_per_unit: float, up: str, height: int, scale: float) -> sj.Camera:
    """Read FILE or FILE:NAME; the picture has a height, and lengths are scaled with the body."""
    path, _, name = ("", "", "0") if Path(source).exists() else source.rpartition(":")
    camera = sj.io.load_camera(path or source, name or "0", mm_per_unit=mm_per_unit, up=up)
    return replace(sj.io.resized(camera, height), position=camera.position * scale)


def check_alone(options: Any) -> None:
    """Raise `ValueError` for an option that a scene's file contains."""
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name not in _BESIDE and field.default not in (value, MISSING):
            raise ValueError(
                f"{option_name(field.name)} is {value}, and {options.splats} describes the whole "
                "scene; change the file, or leave the option out"
            )


def scene_record(
    options: Any,
    folder: Path,
    material: sj.Material,
    lights: tuple[sj.scene.AbstractLight, ...],
    camera: sj.Camera,
) -> dict[str, Any]:
    """Return a scene as its file in a folder would be."""

    def beside(path: Path | str) -> str:
        return os.path.relpath(path, folder)

    body = {"file": beside(options.splats)} if options.splats else {"bust": options.count}
    image = options.environment_name or ""
    image = image if image in sj.io.ENVIRONMENTS else beside(image or ".")
    return sj.io.plain_scene(
        body | {"up": options.up, "scale": options.scale, "albedo": options.albedo},
        material,
        camera,
        [sj.io.plain_light(light, image) for light in lights],
        options.settings,
    )
