"""Environments and lights from files, and TOML files that list pictures with cameras and lights."""

from pathlib import Path
from typing import Any

import numpy as np

from splatjax._records import check_values
from splatjax.inverse import KnownIntensity, Observation, UnknownColor, UnknownIntensity
from splatjax.scene import (
    AbstractLight,
    Camera,
    DirectionalLight,
    DiskLight,
    EnvironmentLight,
    GaussianBeam,
    PointLight,
    RectangleLight,
    SphereLight,
    SpotLight,
    even_directions,
    overcast_sky,
    studio,
    sun_and_sky,
)

from ._cameras import gltf_nodes
from ._files import (
    StrPath,
    atomic_path,
    check_units,
    existing_file,
    naming,
    plain_record,
    record_names,
    with_y_up,
)
from ._images import read_picture
from ._tables import Table, read_toml
from ._trimesh import one_sentence

PLACE = {"position", "target", "up", "fov", "near"}
_MOST_ROWS = 512  # largest number of rows of an environment
_INTENSITIES = {"known": KnownIntensity, "unknown": UnknownIntensity, "unknown color": UnknownColor}
ENVIRONMENTS = {"studio": studio, "overcast": overcast_sky, "sun": sun_and_sky}
_LIGHTS: dict[str, type[AbstractLight]] = {
    "directional": DirectionalLight,
    "point": PointLight,
    "spot": SpotLight,
    "beam": GaussianBeam,
    "rectangle": RectangleLight,
    "disk": DiskLight,
    "sphere": SphereLight,
    "environment": EnvironmentLight,
}
# For lights that may face a `target`: the field of the position, and the field that the target
# replaces.
_AIMED = {
    SpotLight: ("position", "direction"),
    GaussianBeam: ("origin", "direction"),
    RectangleLight: ("center", "edges"),
    DiskLight: ("center", "direction"),
}
_FACING = {"target", "width", "height"}
LIGHT_ENTRIES = {"kind", *_FACING}.union(*map(record_names, _LIGHTS.values()))


def load_environment(path: StrPath, **fields: Any) -> EnvironmentLight:
    r"""Read an environment light from a latitude-longitude map in OpenEXR, Radiance HDR or another
    floating-point format. Maps of more than 512 rows are repeatedly halved by averaging while both
    sides are even, with little effect on samples and highlights.

    **Arguments:** `fields`: the other fields of `EnvironmentLight`, by name.

    **Raises:** as `read_picture` does, and `ValueError` for a map that is not twice as wide as
    high, or has negative or non-finite radiance.
    """
    image = read_picture(path)
    while len(image) > _MOST_ROWS and not np.any(np.mod(image.shape[:2], 2)):
        image = image.reshape(len(image) // 2, 2, image.shape[1] // 2, 2, -1).mean(axis=(1, 3))
    with naming(path):
        return EnvironmentLight(image.astype(np.float32), **fields)


def write_image(path: StrPath, image: Any) -> None:
    """Write the image of an environment to an EXR file, atomically."""
    import OpenImageIO as oiio  # 17 MB, so imported only here

    with atomic_path(path) as temporary:
        oiio.ImageBuf(np.asarray(image, np.float32)).write(str(temporary))


def load_lights(
    path: StrPath, *, mm_per_unit: float, up: str = "y", lux: float = 1.0
) -> list[AbstractLight]:
    r"""Read the punctual lights of a glTF or GLB file (KHR_lights_punctual).

    A surface that faces a directional light of 1 lux receives the irradiance `lux`, and so does a
    surface at 1 unit of length from a point or spot light of 1 candela. With `lux=1`, pictures are
    in candela per square meter.

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm; glTF prescribes meters (1000).
    - `up`: the file's upward axis, `"y"` or `"z"`; lights have +y up.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file cannot be read or `lux` is not
    positive.
    """
    path, lights = existing_file(path), []
    check_units(path, mm_per_unit, up)
    check_values("lux", lux, "positive", lambda x: x > 0)
    with one_sentence(path):
        for _, light, matrix in gltf_nodes(path, "light"):
            color = np.asarray(light.get("color", (1, 1, 1))) * lux * light.get("intensity", 1)
            place, direction = with_y_up(np.stack([matrix[:3, 3], -matrix[:3, 2]]), up)
            position, intensity = mm_per_unit * place, mm_per_unit**2 * color
            if light["type"] == "directional":
                lights.append(DirectionalLight(direction=direction, irradiance=color))
            elif light["type"] == "spot":
                cone = {"innerConeAngle": 0.0, "outerConeAngle": np.pi / 4} | light.get("spot", {})
                angles = np.degrees([cone["innerConeAngle"], cone["outerConeAngle"]])
                lights.append(SpotLight(position, direction, intensity, *angles))
            else:
                lights.append(PointLight(position=position, intensity=intensity))
    return lights


def read_observations(path: StrPath) -> list[Observation]:
    r"""Read a list of pictures with their cameras and lights.

        [[pictures]]
        file = "left.exr"           # linear light, R, G and B or Y; path relative to this file
        mask = "left_mask.exr"      # optional: pixels that are 0 do not count
        noise = 0.01                # optional: standard deviation / root mean square
        intensity = "known"         # or "unknown": fit one factor of the light;
                                    # or "unknown color": fit one factor per channel
        camera = { position = [0, 0, 500], target = [0, 0, 0], fov = 25 }  # mm, degrees (vertical)
        [[pictures.lights]]
        kind = "directional"        # direction (in which light travels), irradiance; cast_shadows
        direction = [1, -0.3, -0.5]
        irradiance = [3.14, 3.14, 3.14]

    A camera may have `up` and `near` (mm). Other kinds of lights are "point" (`position` in mm,
    `intensity`, `cast_shadows`), "spot" (a point light with `direction`, `inner_angle` and
    `outer_angle` in degrees), "beam" (`origin`, `direction`, `power`, `variance` in mm^2),
    "rectangle" (`center`, `radiance`, `edges`), "disk" (`center`, `radiance`, `direction`,
    `radius`), "sphere" (`center`, `radiance`, `radius`; all three `cast_shadows`) and "environment"
    (`image`: studio, overcast, sun, or a file; `rotation`, `strength`, `up`). Instead of
    `direction`, a spot, beam or disk may have a `target`, the point that it faces; instead of
    `edges`, a rectangle may have `target`, `width` and `height`. A color is one number per channel,
    or one for all.

    **Returns:** an `Observation` for each picture, in JAX's default precision.

    **Raises:** `ValueError` for invalid content, with the fault and the remedy; `FileNotFoundError`
    for a missing picture.
    """
    path = Path(path)
    file = Table(path, "", read_toml(path, "name one that lists pictures"), ["pictures"])
    entries = ("file", "mask", "noise", "intensity", "camera", "lights")
    return [_observation(table) for table in file.tables("pictures", entries)]


def picture_paths(path: StrPath) -> list[Path]:
    """Return the path of a file of observations, followed by the paths of the files that it
    lists: pictures, masks and images of environments.
    """
    path = Path(path)
    pictures = read_toml(path, "name one that lists pictures")["pictures"]
    return [path] + [
        path.parent / table[name]
        for entry in pictures
        for table in (entry, *entry["lights"])
        for name in ("file", "mask", "image")
        if name in table and table[name] not in ENVIRONMENTS
    ]


def _observation(table: Table) -> Observation:
    picture = table.make(read_picture, table.folder / table.text("file"))
    mask = deviation = None
    if "mask" in table.entries:
        mask = np.any(table.make(read_picture, table.folder / table.text("mask")) > 0, axis=-1)
    if "noise" in table.entries:
        noise = table.numbers("noise")
        table.make(check_values, "noise", noise, "positive", lambda x: x > 0)
        counted = np.all(np.isfinite(picture), axis=-1)
        counted &= True if mask is None or mask.shape != counted.shape else mask
        size = np.sqrt(np.mean(np.square(picture[counted]))) if counted.any() else 0.0
        deviation = noise * (size or 1.0)
    height, width, channels = picture.shape
    return table.make(
        Observation,
        picture,
        look_at(table.table("camera", PLACE), width, height),
        tuple(light_of(light, channels) for light in table.tables("lights", LIGHT_ENTRIES)),
        mask,
        deviation,
        _INTENSITIES[table.one_of("intensity", _INTENSITIES, "known")](),
    )


def look_at(table: Table, width: int, height: int) -> Camera:
    """Make a camera from a table with position, target, up and field of view."""
    lens = {name: table.number(name) for name in ("fov", "near") if name in table.entries}
    return table.make(
        Camera.look_at,
        table.vector("position"),
        table.vector("target"),
        up=table.vector("up", [0.0, 1.0, 0.0]),
        **{"fov": 25.0, "width": width, "height": height} | lens,
    )


def plain_light(light: AbstractLight, image: str) -> dict[str, Any]:
    """Convert a light to a table. `image` is the file name of an environment's image.

    **Raises:** `ValueError` for a kind of light that a file cannot store.
    """
    kinds = {record: kind for kind, record in _LIGHTS.items()}
    if type(light) not in kinds:
        raise ValueError(
            f"a file cannot store a {type(light).__name__}; give lights of kinds "
            f"{', '.join(_LIGHTS)}"
        )
    given = dict[str, Any]()
    if isinstance(light, EnvironmentLight):
        given["image"], directions = image, light.directions
        if directions is not None:
            even = even_directions(len(directions)).astype(directions.dtype)
            given["directions"] = len(even) if np.array_equal(directions, even) else directions
    return {"kind": kinds[type(light)]} | plain_record(light, **given)


def light_of(table: Table, channels: int, in_gray: bool = False) -> AbstractLight:
    """Make a light with the channels of a picture from a table. `in_gray`, or one channel, converts
    its image to gray.
    """
    light = _LIGHTS[table.one_of("kind", _LIGHTS)]
    names, given = {"kind", *record_names(light)}, dict[str, Any]()
    if "target" in table.entries and light in _AIMED:
        place, aim = _AIMED[light]
        center, target = table.vector(place), table.vector("target")
        given[aim] = target - center
        names = names - {aim} | {"target"}
        if light is RectangleLight:
            names |= _FACING
            size = table.number("width"), table.number("height")
            given[aim] = table.make(RectangleLight.facing, center, target, *size, 1.0).edges
    table = table.only(names)
    if light is EnvironmentLight:
        image = _environment_image(table)
        in_gray = in_gray or channels == 1
        given["image"] = image.mean(axis=-1, keepdims=True) if in_gray else image
        count = table.entries.get("directions")
        if not isinstance(count, list | None):
            given["directions"] = even_directions(table.whole("directions"))
    strength = table.numbers(light.strength_field, 1.0)
    table.make(check_values, light.strength_field, strength, "at least 0", lambda x: x >= 0)
    table.expect(
        strength.size in (1, channels),
        f"{light.strength_field} is {strength.tolist()}, for a picture of {channels} channels; "
        "give one number, or one for each channel",
    )
    return table.record(light, **given).with_channels(channels)


def _environment_image(table: Table) -> Any:
    image = table.text("image")
    if Path(image).suffix:
        return table.make(load_environment, table.folder / image).image
    return ENVIRONMENTS[table.one_of("image", ENVIRONMENTS)]()
