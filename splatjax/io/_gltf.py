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

_LIGHTS = "KHR_lights_punctual"
_ROWS = 512  # of a picture, whose size glTF does not specify


def gltf_json(data: bytes) -> bytes:
    """Return the JSON of a glTF file, which GLB has as its first part."""
    is_binary = data[:4] == b"glTF"
    return data[20:][: int.from_bytes(data[12:16], "little")] if is_binary else data


def gltf_cameras(path: Path) -> Iterator[tuple[str, dict[str, Any], Float[np.ndarray, "4 4"]]]:
    """Yield name, lens and pose (camera to world; right, down and forward) of perspective cameras.
    Others are left out with a warning.
    """
    content = json.loads(gltf_json(path.read_bytes()))
    for node, matrix in _placed(content):
        if "camera" not in node:
            continue
        camera = content["cameras"][node["camera"]]
        name = node.get("name") or camera.get("name") or f"camera {node['camera']}"
        if camera["type"] != "perspective":
            warnings.warn(
                f"{path}: the camera {name!r} is {camera['type']}, and is left out", stacklevel=4
            )
            continue
        lens = camera["perspective"]
        width = max(1, round(_ROWS * lens.get("aspectRatio", 1.0)))
        focal = 0.5 * _ROWS / np.tan(0.5 * lens["yfov"])
        lens = {"w": width, "h": _ROWS, "fl_x": focal, "fl_y": focal}
        yield name, lens, matrix * [1, -1, -1, 1]


def load_lights(
    path: StrPath, *, mm_per_unit: float, up: str = "y", lux: float = 1.0
) -> tuple[AbstractLight, ...]:
    r"""Read the punctual lights of a glTF or GLB file (KHR_lights_punctual).

    A surface that faces a directional light of 1 lux receives the irradiance `lux`, and so does
    one that is 1 unit of length from a point light of 1 candela. `lux` 1 gives pictures in candela
    per square meter. Spot lights are read as point lights, with a warning.

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm; glTF prescribes meters (1000).
    - `up`: the file's upward axis, `"y"` or `"z"`; lights have +y up.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read, or has no lights.
    """
    path, lights = existing_file(path), []
    check_units(path, mm_per_unit, up)
    with one_sentence(path):
        content = json.loads(gltf_json(path.read_bytes()))
        for node, matrix in _placed(content):
            index = node.get("extensions", {}).get(_LIGHTS, {}).get("light")
            if index is None:
                continue
            light = content["extensions"][_LIGHTS]["lights"][index]
            kind, factor = light["type"], lux * light.get("intensity", 1.0)
            color = factor * np.asarray(light.get("color", [1.0, 1.0, 1.0]), float)
            place, way = with_y_up(np.stack([matrix[:3, 3], -matrix[:3, 2]]), up)
            if kind == "directional":
                lights.append(DirectionalLight(direction=way, irradiance=color))
                continue
            if kind == "spot":
                named = light.get("name", node.get("name", index))
                warnings.warn(
                    f"{path}: the light {named!r} is a spot, and is read as a point light, which "
                    "shines to all sides",
                    stacklevel=2,
                )
            intensity = mm_per_unit**2 * color
            lights.append(PointLight(position=mm_per_unit * place, intensity=intensity))
    if not lights:
        raise ValueError(f"{path}: has no lights of {_LIGHTS}; export it with its lights")
    return tuple(lights)


def _placed(content: dict[str, Any]) -> Iterator[tuple[dict[str, Any], Float[np.ndarray, "4 4"]]]:
    """Yield the nodes of the scene, with their transformations to the world."""
    nodes = content.get("nodes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [i for i in range(len(nodes)) if i not in children]
    if "scenes" in content:
        roots = content["scenes"][content.get("scene", 0)].get("nodes", [])
    pending = [(root, np.eye(4)) for root in reversed(roots)]
    for _ in range(len(nodes)):
        if not pending:
            return
        index, above = pending.pop()
        matrix = above @ _local(nodes[index])
        yield nodes[index], matrix
        pending += [(child, matrix) for child in reversed(nodes[index].get("children", []))]
    if pending:
        raise ValueError("a node is a child of itself, or of two nodes")


def _local(node: dict[str, Any]) -> Float[np.ndarray, "4 4"]:
    from trimesh.transformations import quaternion_matrix  # takes a second, so only here

    if "matrix" in node:
        return np.reshape(np.asarray(node["matrix"], float), (4, 4)).T
    x, y, z, w = node.get("rotation", [0, 0, 0, 1])
    local = quaternion_matrix([w, x, y, z])
    local[:3, :3] *= np.asarray(node.get("scale", [1, 1, 1]), float)
    local[:3, 3] = node.get("translation", [0, 0, 0])
    return local
