"""Cameras from files: transforms.json of NeRF and instant-ngp, COLMAP, and glTF."""

import json
import struct
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from splatjax.scene import Camera

from ._files import StrPath, check_units, existing_file, expect, with_y_up
from ._trimesh import one_sentence

_Pose: TypeAlias = Float[np.ndarray, "4 4"]
_Lens: TypeAlias = Mapping[str, Any]
_Found: TypeAlias = Iterator[tuple[str, _Lens, _Pose]]
# Cameras: number, model, width, height, parameters; images: quaternion, translation, camera, name.
_Rows: TypeAlias = tuple[Sequence[Sequence[Any]], Sequence[Sequence[Any]]]
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2", "is_fisheye")
_DISTORTED = "with distortion; undistort the pictures first, such as by `colmap image_undistorter`"
_SQUARE = 1e-2  # largest error at the edge of a picture due to unequal focal lengths, pixels
_ROWS = 512  # rows of the picture, because glTF does not specify its size
_LIGHTS = "KHR_lights_punctual"
_SHEAR = 1e-3  # relative difference of the scales of axes
# COLMAP's models with their parameters, in the order of its model numbers; all other models have
# distortion.
_MODELS = {
    "SIMPLE_PINHOLE": ("fl_x", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("fl_x", "cx", "cy", "k1"),
    "RADIAL": ("fl_x", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
}


def load_cameras(path: StrPath, *, mm_per_unit: float, up: str = "y") -> dict[str, Camera]:
    r"""Read the cameras of a file.

    | file | cameras |
    | --- | --- |
    | `transforms.json` | of NeRF, instant-ngp and nerfstudio, by `file_path` |
    | a folder of COLMAP | `cameras` and `images`, `.txt` or `.bin`, by the names of images |
    | `.gltf`, `.glb` | perspective cameras, by the names of their nodes; 512 rows |

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm. Reconstructions from pictures have an arbitrary
      unit, shared by their splats or mesh.
    - `up`: the file's upward axis, `"y"` or `"z"`; cameras have +y up.

    **Returns:** cameras by name, in the order of the file.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file cannot be read or has no camera,
    and for lenses with distortion, pixels that are not square, or axes that are not orthogonal.
    """
    path, cameras = Path(path), {}
    check_units(path, mm_per_unit, up)
    kind = "folder" if path.is_dir() else existing_file(path).suffix.lower()
    readers = {"folder": _colmap, ".json": _transforms, ".gltf": _gltf, ".glb": _gltf}
    expect(
        kind in readers,
        path,
        "is not a file of cameras; give transforms.json, glTF, or a folder of COLMAP",
    )
    with one_sentence(path):
        for name, lens, pose in readers[kind](path):
            name = f"{name} {len(cameras)}" if name in cameras else name
            cameras[name] = _camera(f"{path}: {name}", lens, pose, mm_per_unit, up)
    expect(cameras, path, "has no perspective camera; export it with its cameras")
    return cameras


def load_camera(path: StrPath, name: str = "0", *, mm_per_unit: float, up: str = "y") -> Camera:
    """Read one camera of a file (see `load_cameras`), given by its name or its number from 0."""
    cameras = load_cameras(path, mm_per_unit=mm_per_unit, up=up)
    names = {str(number): key for number, key in enumerate(cameras)} | {n: n for n in cameras}
    expect(
        name in names,
        path,
        f"has no camera {name!r}; give one of its {len(cameras)} names "
        f"({', '.join([*cameras][:3])}, ...), or a number from 0",
    )
    return cameras[names[name]]


def resized(camera: Camera, height: int) -> Camera:
    """Return a camera with another number of rows and a proportional number of columns."""
    return replace(camera, width=round(camera.width * height / camera.height), height=height)


def _camera(where: str, lens: _Lens, pose: _Pose, mm_per_unit: float, up: str) -> Camera:
    """Make a camera from a lens and a pose, the transformation from the axes right, down and
    forward to the world.

    The lens has the entries of instant-ngp: w, h, fl_x, fl_y, cx and cy in pixels, the last three
    optional.
    """
    model = lens.get("camera_model", "PINHOLE")
    bent = [f"{name} = {lens[name]}" for name in _DISTORTION if lens.get(name)]
    expect(
        model in _MODELS and not bent,
        where,
        f"its lens is {', '.join([model, *bent])}, {_DISTORTED}",
    )
    expect(
        lens.keys() >= {"w", "h", "fl_x"},
        where,
        f"has only {', '.join(lens)}; add w, h and fl_x, in pixels",
    )
    width, height, focal_x = int(lens["w"]), int(lens["h"]), lens["fl_x"]
    focal_y = lens.get("fl_y", focal_x)
    expect(
        abs(focal_x / focal_y - 1) * width < 2 * _SQUARE,
        where,
        f"fl_x is {focal_x:g} and fl_y is {focal_y:g}, so pixels are not square; "
        "reconstruct with one focal length, such as SIMPLE_PINHOLE",
    )
    expect(np.isfinite(pose).all(), where, f"its pose {pose.tolist()} must be finite; correct it")
    left, scales, right = np.linalg.svd(pose[:3, :3])
    expect(
        scales[0] < (1 + _SHEAR) * scales[2] and np.linalg.det(left @ right) > 0,
        where,
        f"its axes {pose[:3, :3].tolist()} are sheared or mirrored; give a rotation",
    )
    axes, place = with_y_up((left @ right).T, up), with_y_up(pose[None, :3, 3], up)[0]
    point = np.asarray([lens.get("cx", width / 2) / width, lens.get("cy", height / 2) / height])
    return Camera(
        mm_per_unit * place,
        axes,
        focal_y / height,
        width,
        height,
        principal_point=None if np.all(point == 0.5) else point,
    )


def _transforms(path: Path) -> _Found:
    content = json.loads(path.read_text(encoding="utf-8"))
    for index, frame in enumerate(content["frames"]):
        lens = content | frame
        if lens.keys() >= {"w", "camera_angle_x"}:
            lens.setdefault("fl_x", 0.5 * lens["w"] / np.tan(0.5 * lens["camera_angle_x"]))
        # The axes of the file are right, up and back.
        pose = np.asarray(frame["transform_matrix"], float) * [1, -1, -1, 1]
        yield frame.get("file_path", str(index)), lens, pose


def _colmap(path: Path) -> _Found:
    from trimesh.transformations import quaternion_matrix  # takes a second

    is_binary = (path / "images.bin").exists() and not (path / "images.txt").exists()
    cameras, images = (_colmap_binary if is_binary else _colmap_text)(path)
    lenses = {}
    for number, model, width, height, *values in cameras:
        parameters = zip(_MODELS.get(model, ()), map(float, values), strict=False)
        lenses[int(number)] = {"camera_model": model, "w": width, "h": height, **dict(parameters)}
    for *pose, camera, name in images:
        place = np.asarray(pose, float)
        to_camera = quaternion_matrix(place[:4])
        to_camera[:3, 3] = place[4:]
        yield name, lenses[int(camera)], np.linalg.inv(to_camera)


def _colmap_text(path: Path) -> _Rows:
    cameras = [line.split() for line in _lines(path / "cameras.txt")]
    # Every other line lists the points of an image.
    return cameras, [line.split(maxsplit=9)[1:] for line in _lines(path / "images.txt")[::2]]


def _colmap_binary(path: Path) -> _Rows:
    cameras, images, models = [], [], [*_MODELS]
    data, at = existing_file(path / "cameras.bin").read_bytes(), 8
    for _ in range(*struct.unpack_from("<Q", data)):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        expect(
            0 <= model < len(models),
            path / "cameras.bin",
            f"its lens is COLMAP's model {model}, {_DISTORTED}",
        )
        values = struct.unpack_from(f"<{len(_MODELS[models[model]])}d", data, at + 24)
        cameras.append((number, models[model], width, height, *values))
        at += 24 + 8 * len(values)
    data, at = (path / "images.bin").read_bytes(), 8
    for _ in range(*struct.unpack_from("<Q", data)):
        _, *pose, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        images.append((*pose, camera, data[at + 64 : end].decode()))
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
    return cameras, images


def _lines(path: Path) -> list[str]:
    text = existing_file(path).read_text(encoding="utf-8").rstrip()
    return [line for line in text.split("\n") if not line.startswith("#")]


def _gltf(path: Path) -> _Found:
    for name, camera, matrix in gltf_nodes(path, "camera"):
        if camera["type"] == "perspective":
            lens = camera["perspective"]
            pixels = {
                "fl_x": 0.5 * _ROWS / np.tan(0.5 * lens["yfov"]),
                "w": round(_ROWS * lens.get("aspectRatio", 1.0)),
                "h": _ROWS,
            }
            yield name, pixels, matrix * [1, -1, -1, 1]
        else:
            warnings.warn(
                f"{path}: the camera {name!r} is {camera['type']}, and is omitted", stacklevel=2
            )


def gltf_nodes(path: Path, kind: str) -> _Found:
    """Yield the name, contents and transformation to the world of each node with a camera or
    light.
    """
    from trimesh.transformations import quaternion_matrix, translation_matrix  # takes a second

    data = path.read_bytes()
    is_binary = data[:4] == b"glTF"
    content = json.loads(data[20:][: int.from_bytes(data[12:16], "little")] if is_binary else data)

    def part(of: dict[str, Any]) -> dict[str, Any]:
        return of if kind == "camera" else of.get("extensions", {}).get(_LIGHTS, {})

    def place(index: int, above: np.ndarray) -> _Found:
        node = content["nodes"][index]
        x, y, z, w = node.get("rotation", (0, 0, 0, 1))
        moved = translation_matrix(node.get("translation", (0, 0, 0)))
        turned = moved @ quaternion_matrix([w, x, y, z]) @ np.diag([*node.get("scale", [1] * 3), 1])
        local = np.reshape(node.get("matrix", turned.T), (4, 4)).T
        if kind in part(node):
            entry = part(content)[f"{kind}s"][part(node)[kind]]
            yield node.get("name", f"{kind} {index}"), entry, above @ local
        for child in node.get("children", ()):
            yield from place(child, above @ local)

    for root in content["scenes"][content.get("scene", 0)].get("nodes", ()):
        yield from place(root, np.eye(4))


def camera_matrices(camera: Camera) -> dict[str, np.ndarray]:
    """Return the matrices of a camera for row vectors, as RenderMan defines them."""
    rotation, position = np.asarray(camera.rotation, float), np.asarray(camera.position, float)
    to_camera = np.eye(4)
    to_camera[:3, :3] = rotation.T * [1, -1, 1]
    to_camera[3, :3] = -position @ to_camera[:3, :3]
    size = np.asarray([camera.width, camera.height])
    focal = float(camera.focal_length) * camera.height / size
    to_picture = np.diag([*focal * [1, -1], 1.0, 0.0])
    to_picture[2, :2] = np.asarray(camera.principal_pixel, float) / size
    to_picture[2:, 2:] = [[1, 1], [-camera.near, 0]]  # depth from 0 at the near plane to 1
    return {
        "worldToCamera": to_camera.astype(np.float32),
        "worldToNDC": (to_camera @ to_picture).astype(np.float32),
    }
