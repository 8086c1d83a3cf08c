"""Cameras of files: transforms.json of NeRF and instant-ngp, COLMAP, glTF, and OpenEXR."""

import json
import struct
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float
from PIL import Image

from splatjax.scene import Camera

from ._files import StrPath, check_units, existing_file, with_y_up
from ._gltf import gltf_cameras
from ._images import read_planes
from ._trimesh import one_sentence

Lens: TypeAlias = Mapping[str, Any]
"""Pixels: w, h, fl_x, fl_y, cx and cy, the last three optional; other entries are of distortion."""
_Found: TypeAlias = Iterator[tuple[str, Lens, Float[np.ndarray, "4 4"]]]
# Camera to world, from columns that point right, up and backward to right, down and forward.
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2", "is_fisheye")
_SQUARE = 1e-2  # pixels, at the edge of a picture, by which focal lengths may differ
_SHEAR = 1e-3  # relative difference of the scales of axes
# Models of COLMAP by their numbers, with their parameters; others have distortion.
_MODELS = {
    "SIMPLE_PINHOLE": ("fl_x", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("fl_x", "cx", "cy", "k1"),
    "RADIAL": ("fl_x", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
}
_UNDISTORT = "undistort the pictures first, such as by `colmap image_undistorter`"


def load_cameras(path: StrPath, *, mm_per_unit: float, up: str = "y") -> dict[str, Camera]:
    r"""Read the cameras of a file.

    | file | cameras |
    | --- | --- |
    | `transforms.json` | of NeRF, instant-ngp and nerfstudio, by `file_path` |
    | a folder with `cameras` and `images` | of COLMAP, `.txt` or `.bin`, by the names of images |
    | `.gltf`, `.glb` | perspective cameras, by the names of their nodes; 512 rows |
    | `.exr` | the camera that made a picture: `worldToCamera` and `worldToNDC` |

    **Arguments:**

    - `mm_per_unit`: length of the file's unit, mm. Reconstructions from pictures have an arbitrary
      unit, that of their splats or mesh.
    - `up`: the file's upward axis, `"y"` or `"z"`; cameras have +y up.

    **Returns:** cameras by name, in the order of the file.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read or has no camera,
    and for lenses with distortion and pixels that are not square.
    """
    path = Path(path)
    check_units(path, mm_per_unit, up)
    readers: dict[str, Callable[[Path], _Found]] = {
        ".json": _transforms,
        ".gltf": gltf_cameras,
        ".glb": gltf_cameras,
        ".exr": _picture,
    }
    path = path.parent if path.name in ("images.txt", "images.bin") else path
    reader = _colmap if path.is_dir() else readers.get(existing_file(path).suffix.lower())
    if reader is None:
        raise ValueError(
            f"{path}: is not a file of cameras; give transforms.json, glTF, OpenEXR, or a folder "
            "of COLMAP"
        )
    cameras: dict[str, Camera] = {}
    with one_sentence(path):
        for name, lens, pose in reader(path):
            name = f"{name} {len(cameras)}" if name in cameras else name
            cameras[name] = _camera(f"{path}: {name}", lens, pose, mm_per_unit, up)
    if not cameras:
        raise ValueError(f"{path}: has no perspective camera; export it with its cameras")
    return cameras


def _camera(
    where: str, lens: Lens, pose: Float[np.ndarray, "4 4"], mm_per_unit: float, up: str
) -> Camera:
    """Make a camera of a lens and a pose: camera to world, right, down and forward."""
    width, height = int(lens["w"]), int(lens["h"])
    focal_x, focal_y = float(lens["fl_x"]), float(lens.get("fl_y", lens["fl_x"]))
    middle = np.asarray([lens.get("cx", 0.5 * width), lens.get("cy", 0.5 * height)], float)
    bent = [f"{name} = {lens[name]}" for name in _DISTORTION if lens.get(name)]
    if bent:
        raise ValueError(f"{where}: its lens has distortion ({', '.join(bent)}); {_UNDISTORT}")
    if not abs(focal_x / focal_y - 1) * width < 2 * _SQUARE:
        raise ValueError(
            f"{where}: fl_x is {focal_x:g} and fl_y is {focal_y:g}, of pixels that are not "
            "square; reconstruct with one focal length, such as SIMPLE_PINHOLE, or resize the "
            "pictures"
        )
    left, scales, right = np.linalg.svd(pose[:3, :3])
    if not scales[0] < (1 + _SHEAR) * scales[2] or np.linalg.det(left @ right) < 0:
        raise ValueError(
            f"{where}: its axes {pose[:3, :3].tolist()} are sheared or mirrored; give a rotation"
        )
    position = mm_per_unit * with_y_up(pose[None, :3, 3], up)[0]
    rotation = with_y_up((left @ right).T, up)
    share = middle / [width, height]
    is_central = bool(np.all(share == 0.5))
    return Camera(
        position,
        rotation,
        focal_y / height,
        width,
        height,
        principal_point=None if is_central else share,
    )


def _transforms(path: Path) -> _Found:
    content = json.loads(path.read_text(encoding="utf-8"))
    for index, frame in enumerate(content["frames"]):
        lens, name = content | frame, frame.get("file_path", str(index))
        if not lens.keys() >= {"w", "h"}:
            lens["w"], lens["h"] = _picture_size(path, name)
        for focal, angle, size in (
            ("fl_y", "camera_angle_y", "h"),
            ("fl_x", "camera_angle_x", "w"),
        ):
            if focal not in lens and angle in lens:
                lens[focal] = 0.5 * lens[size] / np.tan(0.5 * lens[angle])
        if "FISHEYE" in (model := lens.get("camera_model", "")) or "EQUIRECT" in model:
            raise ValueError(f"{path}: camera_model is {model}; {_UNDISTORT}")
        yield name, lens, np.asarray(frame["transform_matrix"], float) @ _OPENGL


def _picture_size(path: Path, name: str) -> tuple[int, int]:
    files = [path.parent / f"{name}{suffix}" for suffix in ("", ".png", ".jpg")]
    for file in filter(Path.is_file, files):
        with Image.open(file) as picture:
            return picture.size
    raise ValueError(f"{path}: has no w and h, and {files[0]} is missing; add w and h in pixels")


def _colmap(path: Path) -> _Found:
    is_text = (path / "images.txt").exists()
    lenses, poses = (_colmap_text if is_text else _colmap_binary)(path)
    from trimesh.transformations import quaternion_matrix  # takes a second, so only here

    for name, camera, quaternion, translation in poses:
        to_camera = quaternion_matrix(quaternion)
        to_camera[:3, 3] = translation
        yield name, lenses[camera], np.linalg.inv(to_camera)


def _lens(path: Path, model: str, width: int, height: int, values: list[float]) -> Lens:
    if model not in _MODELS:
        raise ValueError(f"{path}: its camera model is {model}, with distortion; {_UNDISTORT}")
    return {"w": width, "h": height, **dict(zip(_MODELS[model], values, strict=True))}


def _colmap_text(path: Path) -> tuple[dict[int, Lens], list[tuple]]:
    def rows(name: str) -> list[str]:
        lines = existing_file(path / name).read_text(encoding="utf-8").split("\n")
        return [line for line in lines if not line.startswith("#")]

    lenses, poses = {}, []
    for line in filter(str.strip, rows("cameras.txt")):
        number, model, width, height, *values = line.split()
        lenses[int(number)] = _lens(path, model, int(width), int(height), [*map(float, values)])
    for line in filter(str.strip, rows("images.txt")[::2]):  # between them, lines of points
        _, *pose, camera, name = line.split(maxsplit=9)
        pose = [*map(float, pose)]
        poses.append((name.strip(), int(camera), pose[:4], pose[4:]))
    return lenses, poses


def _colmap_binary(path: Path) -> tuple[dict[int, Lens], list[tuple]]:
    def unpack(layout: str) -> tuple:
        return struct.unpack(f"<{layout}", file.read(struct.calcsize(f"<{layout}")))

    models, lenses, poses = list(_MODELS), {}, []
    file = BytesIO(existing_file(path / "cameras.bin").read_bytes())
    for _ in range(*unpack("Q")):
        number, model, width, height = unpack("iiQQ")
        model = models[model] if model in range(len(models)) else f"number {model}"
        values = unpack(f"{len(_MODELS.get(model, ()))}d")
        lenses[number] = _lens(path, model, width, height, [*values])
    data = existing_file(path / "images.bin").read_bytes()
    file = BytesIO(data)
    for _ in range(*unpack("Q")):
        _, *pose, camera = unpack("i7di")
        end = data.index(b"\0", file.tell())
        name = file.read(end - file.tell()).decode()
        file.seek(end + 1)
        poses.append((name, camera, pose[:4], pose[4:]))
        file.seek(24 * unpack("Q")[0], 1)
    return lenses, poses


def _picture(path: Path) -> _Found:
    planes, header, _ = read_planes(path)
    names = "worldToCamera", "worldToNDC"
    if not header.keys() >= set(names):
        raise ValueError(f"{path}: has no {' and '.join(names)}; write it with its camera")
    # Of row vectors: right, up and forward; and columns and rows over the size of the picture.
    to_camera, to_picture = (np.reshape(header[name], (4, 4)).astype(float) for name in names)
    lens = np.linalg.inv(to_camera) @ to_picture
    height, width = next(iter(planes.values())).shape
    size = np.asarray([width, height]) / lens[2, 3]
    (focal_x, focal_y), (x, y) = size * [lens[0, 0], -lens[1, 1]], size * lens[2, :2]
    values = {"w": width, "h": height, "fl_x": focal_x, "fl_y": focal_y, "cx": x, "cy": y}
    yield path.name, values, np.linalg.inv(np.diag([1, -1, 1, 1]) @ to_camera.T)
