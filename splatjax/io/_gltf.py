"""The nodes of a glTF scene that trimesh leaves out: cameras, and lights of KHR_lights_punctual."""

import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from splatjax.scene import AbstractLight, DirectionalLight, PointLight

from ._files import StrPath, check_units, existing_file, with_y_up
from ._trimesh import one_sentence

_ROWS = 512  # of a picture, whose size glTF does not specify
_LIGHTS = "KHR_lights_punctual"


def gltf_nodes(
    path: Path, kind: str
) -> Iterator[tuple[str, dict[str, Any], Float[np.ndarray, "4 4"]]]:
    """Yield name, contents and transformation to the world of all nodes with a camera or light."""
    from trimesh.transformations import quaternion_matrix, translation_matrix  # takes a second

    data = path.read_bytes()
    is_binary = data[:4] == b"glTF"
    content = json.loads(data[20:][: int.from_bytes(data[12:16], "little")] if is_binary else data)

    def part(of: dict[str, Any]) -> dict[str, Any]:
        return of if kind == "camera" else of.get("extensions", {}).get(_LIGHTS, {})

    def place(index: int, above: np.ndarray) -> Iterator[tuple[str, dict[str, Any], np.ndarray]]:
        node = content["nodes"][index]
        x, y, z, w = node.get("rotation", (0, 0, 0, 1))
        moved = translation_matrix(node.get("translation", (0, 0, 0)))
        turned = moved @ quaternion_matrix([w, x, y, z]) @ np.diag([*node.get("scale", [1] * 3), 1])
        given = np.reshape(node.get("matrix", turned.T), (4, 4)).T
        if kind in part(node):
            found = part(content)[f"{kind}s"][part(node)[kind]]
            yield node.get("name", f"{kind} {index}"), found, above @ given
        for child in node.get("children", ()):
            yield from place(child, above @ given)

    for root in content["scenes"][content.get("scene", 0)].get("nodes", ()):
        yield from place(root, np.eye(4))


def gltf_cameras(path: Path) -> Iterator[tuple[str, dict[str, Any], Float[np.ndarray, "4 4"]]]:
    """Yield name, lens and pose (camera to world; right, down and forward) of perspective cameras.
    Others are left out with a warning.
    """
    for name, camera, matrix in gltf_nodes(path, "camera"):
        if camera["type"] == "perspective":
            lens = camera["perspective"]
            focal, width = 0.5 * _ROWS / np.tan(0.5 * lens["yfov"]), lens.get("aspectRatio", 1.0)
            size = {"w": round(_ROWS * width), "h": _ROWS}
            yield name, {"fl_x": focal, **size}, matrix * [1, -1, -1, 1]
        else:
            left_out = f"the camera {name!r} is {camera['type']}, and is left out"
            warnings.warn(f"{path}: {left_out}", stacklevel=2)


def load_lights(
    path: StrPath, *, mm_per_unit: float, up: str = "y", lux: float = 1.0
) -> list[AbstractLight]:
    r"""Read the punctual lights of a glTF or GLB file (KHR_lights_punctual).

    A surface that faces a directional light of 1 lux receives the irradiance `lux`, and so does
    one that is 1 unit of length from a point light of 1 candela: with `lux` 1, pictures are in
    candela per square meter. Spot lights are read as point lights, with a warning.

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm; glTF prescribes meters (1000).
    - `up`: the file's upward axis, `"y"` or `"z"`; lights have +y up.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read.
    """
    path, lights = existing_file(path), []
    check_units(path, mm_per_unit, up)
    with one_sentence(path):
        for name, light, matrix in gltf_nodes(path, "light"):
            color = np.asarray(light.get("color", (1, 1, 1))) * lux * light.get("intensity", 1)
            place, way = with_y_up(np.stack([matrix[:3, 3], -matrix[:3, 2]]), up)
            if light["type"] == "directional":
                lights.append(DirectionalLight(direction=way, irradiance=color))
            else:
                intensity = mm_per_unit**2 * color
                lights.append(PointLight(position=mm_per_unit * place, intensity=intensity))
            if light["type"] == "spot":
                read_as = f"the light {name!r} is a spot, and is read as a point light"
                warnings.warn(f"{path}: {read_as}", stacklevel=2)
    return lights
