"""Scenes of the command line: cameras from files, and the contents of scene files."""

import os
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import splatjax as sj

from ._terminal import option_name

_BESIDE = {"splats", "output", "background", "exposure", "half", "quiet", "host", "port"}


def camera_of(source: str, mm_per_unit: float, up: str, height: int, scale: float) -> sj.Camera:
    """Read a camera from FILE or FILE:NAME, for a picture of given height, and scale it with the
    body.
    """
    path, _, name = ("", "", "0") if Path(source).exists() else source.rpartition(":")
    camera = sj.io.load_camera(path or source, name or "0", mm_per_unit=mm_per_unit, up=up)
    return replace(sj.io.resized(camera, height), position=camera.position * scale)


def is_scene(path: Path) -> bool:
    """Return whether a file is, by its suffix, a scene, or a picture whose manifest is a scene."""
    return path.suffix.lower() in (".toml", ".exr")


def check_alone(options: Any) -> None:
    """Raise `ValueError` for an option that the scene's file specifies."""
    for field in fields(options):
        value = getattr(options, field.name)
        if field.name not in _BESIDE and field.default not in (value, MISSING):
            raise ValueError(
                f"{option_name(field.name)} is {value}, and {options.splats} describes the whole "
                "scene; change the file, or leave the option out"
            )


def scene_of_options(options: Any, images: str | list[str], *record: Any) -> dict[str, Any]:
    """Return the contents of a scene's file, from options and the images of lights; `record` is as
    for `scene_in_folder`.
    """
    body = {"file": str(options.splats)} if options.splats else {"bust": options.count}
    body |= {"up": options.up, "scale": options.scale, "albedo": options.albedo}
    g = sj.io.load_mean_cosine(options.material)
    return scene_in_folder(Path(), body, images, g, *record)


def scene_of_file(table: Any, *record: Any) -> dict[str, Any]:
    """Return the contents of a scene's file, from the table of another file; `record` as above."""
    images = [light.get("image", "") for light in table.entries["lights"]]
    g = sj.io.load_mean_cosine(sj.io.material_of_scene(table))
    return scene_in_folder(table.folder, table.entries["splats"], images, g, *record)


def scene_in_folder(
    old: Path,
    body: dict[str, Any],
    images: str | list[str],
    g: float,
    settings: sj.RenderSettings,
    folder: Path,
    material: sj.Material,
    lights: tuple[sj.scene.AbstractLight, ...],
    camera: sj.Camera,
) -> dict[str, Any]:
    """Return the contents of a scene's file in a folder. The files of the body and the images, one
    for each light or one for all, are named relative to an old folder; `g` is the material's mean
    cosine.
    """

    def moved(name: str) -> str:
        return name if name in sj.io.ENVIRONMENTS else os.path.relpath(old / name, folder)

    body = body | {key: moved(body[key]) for key in ("file", "mesh") if key in body}
    images = [images] * len(lights) if isinstance(images, str) else images
    tables = [
        sj.io.plain_light(light, moved(image)) for light, image in zip(lights, images, strict=True)
    ]
    return sj.io.plain_scene(body, material, camera, tables, settings, g)
