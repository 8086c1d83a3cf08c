"""Checks of the inputs of every picture, and warnings about unintended scenes."""

import functools
import warnings
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np

from splatjax._memory import check_memory
from splatjax._records import check_class, is_traced
from splatjax.scene import Camera, DiskLight, RectangleLight, Scene, Splats, lights_by_kind

# Lower bounds of a picture's memory: if they exceed the free memory, the picture does not fit.
BYTES_PER_SPLAT, BYTES_PER_PIXEL = 1000.0, 500.0
_SAMPLE = 4096  # largest number of splats, evenly chosen, used to estimate a body's shape
# Largest area-weighted normal sum of a closed body, divided by its area. The sum is 0.08 for an
# open neck and 0.5 for a hemisphere.
_OPEN = 0.15
_SOLID = 0.05  # least volume of a body (not a sheet), over that of a sphere of its area
# Scattering distance, mm, up to which a material is intentionally opaque (`Material.opaque`).
_OPAQUE = 2e-3
# Largest plausible body size, divided by the distance that light travels below the surface.
_RATIO = 1000.0


def check_scene(scene: Scene, camera: Camera, is_lit: bool = True) -> None:
    r"""Raise an error if channels disagree or memory does not suffice, and warn of likely causes
    of black or meaningless pictures: no light, inverted normals, a camera inside the body, a light
    that faces away from the body, and a body smaller than the distance that light travels in it,
    or a thousand times larger.

    For traced scenes, and scenes distributed over several processes, only the channels are checked.
    Each warning is shown once.

    **Arguments:**

    - `is_lit`: false if the irradiance is given and the lights are not used.

    **Raises:** `ValueError` for other objects, when the channels disagree, or the memory of the
    device does not suffice.
    """
    check_class("scene", scene, Scene)
    check_class("camera", camera, Camera)
    check_channels(scene)
    leaves = [leaf for leaf in jax.tree.leaves((scene, camera)) if isinstance(leaf, jax.Array)]
    if is_traced(leaves) or not all(leaf.is_fully_addressable for leaf in leaves):
        return
    count, pixels = scene.splats.count, camera.width * camera.height
    check_memory(
        f"a picture of {camera.width} x {camera.height} pixels with {count} splats",
        BYTES_PER_SPLAT * count + BYTES_PER_PIXEL * pixels,
        "take fewer pixels, thin the splats, or render them by render_streamed",
        _device_memory(scene.splats),
    )
    for message in _warnings(scene, camera, is_lit):
        _warn_once(message)


def check_shape(name: str, array: Any, shape: tuple[int, ...], remedy: str) -> None:
    """Raise `ValueError` for an array of another shape."""
    if array.shape != shape:
        raise ValueError(f"{name} has shape {list(array.shape)}, not {list(shape)}; {remedy}")


def check_planned(scenes: list[Scene], cameras: list[Camera]) -> None:
    """Raise `ValueError` for scenes and cameras that cannot share a plan."""
    for name, records, kind in (("scenes", scenes, Scene), ("cameras", cameras, Camera)):
        for each in records:
            check_class(name, each, kind)
    if not cameras or not scenes:
        raise ValueError(
            f"a plan needs at least one scene and one camera; got {len(scenes)} scenes and "
            f"{len(cameras)} cameras"
        )
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    if len(sizes) != 1:
        raise ValueError(f"cameras of one plan must have pictures of one size; got {sizes}")
    first = scenes[0]
    for i, scene in enumerate(scenes[1:], 1):
        if not eqx.tree_equal((first.splats, first.material), (scene.splats, scene.material)):
            raise ValueError(
                f"scenes of one plan may differ only in their lights, and scenes[{i}] has other "
                "splats or another material"
            )


@functools.cache
def _warn_once(message: str) -> None:
    """Warn once per message: Python's own record is reset whenever a library changes filters."""
    warnings.warn(message, stacklevel=4)


def _device_memory(splats: Splats) -> float | None:
    """Read the free memory of an accelerator; `None` on a CPU."""
    stats = next(iter(splats.centers.devices())).memory_stats()
    return None if not stats else float(stats["bytes_limit"] - stats["bytes_in_use"])


def _warnings(scene: Scene, camera: Camera, is_lit: bool) -> Iterator[str]:
    """Yield a warning for each likely mistake in a scene."""
    # A light without a field for its strength counts as one.
    strengths = [np.asarray(getattr(light, light.strength_field, 1.0)) for light in scene.lights]
    if is_lit and not any(map(np.any, strengths)):
        yield "the scene has no light, and the picture will be black; add one to Scene.lights"
    if scene.splats.count == 0:
        return
    step = -(-scene.splats.count // _SAMPLE)
    centers, normals, areas = (
        np.asarray(field)[::step].astype(np.float64)
        for field in (scene.splats.centers, scene.splats.normals, scene.splats.areas)
    )
    for number, light in enumerate(scene.lights, 1):
        if (
            is_lit
            and isinstance(light, RectangleLight | DiskLight)
            and np.all((centers - np.asarray(light.center)) @ np.cross(*light.axes()) < 0)
        ):
            yield (
                f"light {number}, a {type(light).__name__}, shines away from the body; "
                "turn it around"
            )
    areas = areas * (scene.splats.count / len(areas))
    area = max(np.sum(areas), np.finfo(float).tiny)
    is_closed = np.linalg.norm(areas @ normals) < _OPEN * area
    middle = areas @ centers / area
    volume = areas @ np.sum(normals * (centers - middle), axis=1) / 3
    sphere = area**1.5 / (6 * np.sqrt(np.pi))
    if is_closed and volume < -_SOLID * sphere:
        yield (
            "the normals of the splats point into the body, so its surface is seen and lit "
            "from behind; turn them around"
        )
    elif is_closed and _winding_number(centers, normals, areas, camera) > 0.5:
        yield "the camera is inside the body and sees its surface from behind; move it outside"
    gaussians = scene.material.gaussians
    variances, weights = (
        np.asarray(x, np.float64) for x in (gaussians.variances, gaussians.weights)
    )
    if np.all(weights.sum(axis=0) > 0):
        reach = np.sqrt(np.max(variances @ weights / weights.sum(axis=0)))
        size = np.linalg.norm(np.ptp(centers, axis=0))
        if reach > _OPAQUE and not 1 < size / reach < _RATIO:
            yield (
                f"the size of the body is {size:.3g} mm, and light travels {reach:.3g} mm "
                "below its surface; check the units (mm), or scale the body by Splats.scaled"
            )


def _winding_number(centers, normals, areas, camera: Camera) -> float:
    """Compute the winding number of splats around a point: 1 inside a closed body, 0 outside."""
    offsets = centers - np.asarray(camera.position, np.float64)
    squared = np.maximum(np.sum(offsets * offsets, axis=1), np.finfo(float).tiny)
    cosines = np.sum(normals * offsets, axis=1) / np.sqrt(squared)
    # The solid angle of a splat is at most half of all directions.
    angles = np.minimum(areas / squared, 2 * np.pi)
    return float(cosines @ angles) / (4 * np.pi)


def in_one_dtype(scene: Scene, *trees):
    """Cast every float to the dtype of the splats' centers, once."""
    dtype = scene.splats.centers.dtype

    def cast(leaf):
        return leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf

    return jax.tree.map(cast, (scene, *trees))


def check_channels(scene: Scene) -> None:
    """Raise `ValueError` unless albedo and lights match the material's channels, and the weight
    factors match its Gaussians and are used without single scattering.
    """
    gaussians, channels = scene.material.gaussians.weights.shape
    counts, factors = {}, scene.splats.weights
    if factors is not None:
        counts["splats.weights"] = factors.shape[2]
        if factors.shape[1] != gaussians:
            raise ValueError(
                f"splats.weights has factors on {factors.shape[1]} Gaussians, scene.material has "
                f"{gaussians}; give both the same number, or weights=None"
            )
        if scene.material.single_scattering is not None:
            raise ValueError(
                "scene.material has single scattering, and splats.weights no factor on it; give "
                "one with single_scattering=None, or weights=None"
            )
    if scene.splats.albedo is not None:
        counts["splats.albedo"] = scene.splats.albedo.shape[1]
    point = jax.ShapeDtypeStruct((1, 3), scene.splats.centers.dtype)
    for group in lights_by_kind(scene.lights):
        for i, sample in dict(group).items():  # one of each light
            counts[f"lights[{i}]"] = eqx.filter_eval_shape(
                lambda sample, x: sample.incidence(x)[1], sample, point
            ).shape[1]
    for name, count in counts.items():
        if count != channels:
            raise ValueError(
                f"{name} has {count} channels, material.gaussians.weights has {channels}; "
                "give both the same number"
            )
