"""Scenes on the command line: cameras from files, contents of scene files, and a rough picture of a
scene.
"""

import functools
import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import splatjax as sj

from ._terminal import note

_OPAQUE = 4e-6  # mm^2, above the variance of `Material.opaque`
_note_once = functools.cache(note)


def camera_of(source: str, mm_per_unit: float, up: str, height: int, scale: float) -> sj.Camera:
    """Read a camera from FILE or FILE:NAME for a picture of a given height, and scale it with the
    body.
    """
    path, _, name = ("", "", "0") if Path(source).exists() else source.rpartition(":")
    camera = sj.io.load_camera(path or source, name or "0", mm_per_unit=mm_per_unit, up=up)
    return replace(sj.io.resized(camera, height), position=camera.position * scale)


def is_scene(path: Path) -> bool:
    """Return whether the suffix of a file is that of a scene, or of a picture whose manifest is a
    scene.
    """
    return path.suffix.lower() in (".toml", ".exr")


def scene_contents(
    options: Any,
    settings: sj.RenderSettings,
    folder: Path,
    material: sj.Material,
    lights: tuple[sj.scene.AbstractLight, ...],
    camera: sj.Camera,
    images: list[str] | None = None,
) -> dict[str, Any]:
    """Return the contents of a scene file in a folder, with references to the existing files of the
    body and of the images of the lights.

    **Arguments:**

    - `images`: an image for each light, by default the environment of the options.
    """
    if options.table is None:
        old, images = Path(), images or [options.environment_name or ""] * len(lights)
        body = {"file": str(options.splats)} if options.splats else {"bust": options.count}
        body |= {"up": options.up, "scale": options.scale, "albedo": options.albedo}
    else:
        old, body = options.table.folder, options.table.entries["splats"]
        images = [light.get("image", "") for light in options.table.entries["lights"]]

    def moved(name: str) -> str:
        return name if name in sj.io.ENVIRONMENTS else os.path.relpath(old / name, folder)

    names = ("file", "mesh", "albedo", "normal", "specular")
    body = body | {name: moved(body[name]) for name in names if isinstance(body.get(name), str)}
    tables = [
        sj.io.plain_light(light, moved(image)) for light, image in zip(lights, images, strict=True)
    ]
    g = sj.io.load_mean_cosine(options.material_source)
    return sj.io.plain_scene(body, material, camera, tables, settings, g)


def identified(path: Path) -> str:
    """Return the name and the fingerprint of a file."""
    return f"{path.name}, {sj.io.fingerprint(path)}"


def draw(
    scene: sj.Scene, camera: sj.Camera, settings: sj.RenderSettings, plan: sj.Plan, light=None
) -> sj.Frame:
    """Render a picture, and wait for it. The arguments are those of `sj.render`.

    **Raises:** `ValueError` if the plan's capacity is exceeded.
    """
    frame = jax.block_until_ready(sj.render(scene, camera, settings, plan, light=light))
    if not frame.overflow <= 0:
        raise ValueError(
            f"the plan's capacity is exceeded: {float(frame.overflow):.2f} times the capacity "
            "is needed"
        )
    return frame


def note_unresolved(
    frame: sj.Frame, scene: sj.Scene, kernel: Any, option: str, count: int | None
) -> None:
    """Print a note about layers that the splats do not resolve, and the number of splats that would
    resolve the widest of them, which `option` sets. The splats of the scene may be a part of the
    `count` splats of the frame, if given.
    """
    unresolved = np.asarray(frame.unresolved_fraction) > 0.5
    variances = np.asarray(scene.material.gaussians.variances)
    if np.max(variances) < _OPAQUE or not unresolved.any():
        return
    deviations = np.sqrt(variances)[unresolved]
    interval = np.asarray(kernel.interval(sj.diffusion.unevenness(scene.splats)))
    # Half of a layer is resolved if its variance is in the middle of the interval.
    count = count or scene.splats.count
    needed = count * np.mean(scene.splats.areas) * np.mean(interval**2) / deviations[-1] ** 2
    widths = ", ".join(f"{width:.3g}" for width in deviations)
    _note_once(
        "unresolved, because they are narrower than the splats: Gaussians of standard deviations "
        f"{widths} mm; about {float(f'{needed:.2g}'):,.0f} splats of this body ({option}) resolve "
        f"that of {deviations[-1]:.3g} mm"
    )


def rough_picture(
    scene: sj.Scene, samples: Sequence[Any], camera: sj.Camera, exposure: float, side: int
) -> list:
    """Draw the centers of splats as matte points under samples of the lights, by NumPy without
    compilation. The longer side has at most `side` pixels, fewer for few splats, and the height is
    even. Return rows of red, green and blue up to 255.
    """
    scene, camera, lights = jax.device_get((scene, camera, samples))
    # A subset of millions of splats suffices.
    splats = jax.tree.map(lambda leaf: leaf[:: 1 + len(leaf) // 2**19], scene.splats)
    lengths = np.asarray([camera.width, camera.height])
    side = max(2, min(side, 0.5 * splats.count**0.5))  # so that few pixels lack a splat
    size = 2 * np.maximum(np.rint(side / 2 * lengths / lengths.max()), 1).astype(int)
    albedo = 1.0 if splats.albedo is None else splats.albedo
    color = (albedo * scene.material.gaussians.weights.sum(axis=0) / np.pi) * sum(
        _irradiance(light, splats) for light in lights
    )
    color = sj.io.picture_to_rgb(color, scene.material.wavelengths)
    local = (splats.centers - camera.position) @ camera.rotation.T
    # Draw splats that face the camera from far to near, so that nearer splats cover farther ones.
    order = np.argsort(-local[:, 2])
    order = order[np.sum(local * (splats.normals @ camera.rotation.T), axis=1)[order] < 0]
    middle = size * np.asarray(camera.principal_pixel) / lengths
    place = camera.focal_length * size[1] * local[:, :2] / local[:, 2:] + middle
    column, row = np.clip(place, 0, size - 1)[order].astype(int).T
    picture = np.zeros((size[1], size[0], 3))
    picture[row, column] = color[order]
    return np.rint(255 * sj.io.linear_to_srgb(picture * 2.0**exposure)).astype(int).tolist()


def _irradiance(light: Any, splats: sj.Splats) -> np.ndarray:
    """Compute the irradiance of splats by a sample of a light, without shadows, by NumPy."""
    strength = getattr(light, light.strength_field)
    axis: Any = getattr(light, "direction", getattr(light, "normal", None))
    offset = splats.centers - getattr(light, "position", getattr(light, "origin", 0.0))
    squared = np.maximum(np.sum(offset**2, axis=1, keepdims=True), 1e-12)
    path, cosine = offset / np.sqrt(squared), 1.0
    if axis is not None:
        axis = axis / np.linalg.norm(axis)
        cosine = path @ axis[:, None]
    if hasattr(light, "position"):
        angles = [getattr(light, "outer_angle", 90.0), getattr(light, "inner_angle", 0.0)]
        strength = strength / squared * np.interp(cosine, np.cos(np.radians(angles)), [0, 1])
    else:
        path = axis[None]
    if hasattr(light, "variance"):
        squared = np.sum(np.cross(offset, axis) ** 2, axis=1, keepdims=True)
        exponent = -squared / (2 * light.variance)
        strength = strength * np.exp(exponent) / (2 * np.pi * light.variance)
    return np.maximum(-np.sum(path * splats.normals, axis=1, keepdims=True), 0) * strength


def direction_to(azimuth: float, elevation: float) -> np.ndarray:
    """Compute the unit vector towards an azimuth and elevation in degrees."""
    azimuth, elevation = math.radians(azimuth), math.radians(elevation)
    across = math.cos(elevation)
    return np.asarray([math.sin(azimuth) * across, math.sin(elevation), math.cos(azimuth) * across])
