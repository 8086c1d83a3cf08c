"""Frames with all layers, and their cameras, as OpenEXR."""

import errno
import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
import OpenEXR  # ty: ignore[import-not-found]

from splatjax.scene import Camera, Frame

from ._files import StrPath, atomic_path, naming
from ._images import read_planes

_REC709_D65 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_WEIGHTS, _VARIANCES, _MANIFEST = "splatjax.weights.", "splatjax.variances", "splatjax.manifest"
_SINGLE = "single_scattering"
_LARGEST_HALF = 65504.0


def write_exr(
    path: StrPath,
    frame: Frame,
    *,
    variances: Sequence[float] | None = None,
    manifest: Mapping[str, Any] | None = None,
    camera: Camera | None = None,
    half: bool = False,
) -> None:
    r"""Write a frame and all its layers to an OpenEXR file, single precision, completely or not at
    all.

    | channels | what they are |
    | --- | --- |
    | `R G B A` | beauty, premultiplied, and coverage |
    | `Z` | depth, mm; inf where there is nothing |
    | `position.X Y Z`, `normal.X Y Z` | of the front surface, world space, mm |
    | `albedo.R G B`, `irradiance.R G B`, `diffuse.R G B`, `specular.R G B` | premultiplied |
    | `single_scattering.R G B` | premultiplied; only when the material has such a term |
    | `shadow1.Y`, `shadow2.Y`, ... | per light |
    | `diffusion1.R G B`, ... | per Gaussian: `diffuse = sum_k weights_k diffusion_k` |

    Pictures of another number of channels than 3 have `beauty.1`, `beauty.2`, ..., `albedo.1`, ...
    instead of R G B. The header contains the weights of the Gaussians (`splatjax.weights.1`, ...: a
    value per channel), their variances (mm^2) if given, the color space (linear, Rec. 709
    primaries, D65), and, if given, the settings of the picture as JSON in `splatjax.manifest`
    (`read_manifest`).

    **Arguments:**

    - `camera`: of the picture, written as `worldToCamera` (right, up and forward, mm) and
      `worldToNDC` (column and row over the size of the picture), which `load_cameras` reads. Both
      are of row vectors: `[x y z 1] M`, divided by the last entry.
    - `half`: write half precision, except for depth and position.

    **Raises:** `FileNotFoundError` when the folder does not exist.
    """
    from splatjax import __version__  # known when the whole package is imported

    gaussians, channels = frame.weights.shape
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": f"splatjax {__version__}",
        "comments": "Linear light; mm. Depth, position and normal are not premultiplied.",
        "splatjax.unresolved_fraction": _floats(frame.unresolved_fraction),
        "splatjax.overflow": float(frame.overflow),
        **{f"{_WEIGHTS}{k}": _floats(row) for k, row in enumerate(np.asarray(frame.weights), 1)},
    }
    if channels == 3:
        header |= {"chromaticities": _REC709_D65, "colorInteropID": "lin_rec709_scene"}
    if variances is not None:
        header[_VARIANCES] = _floats(variances)
    if manifest is not None:
        header[_MANIFEST] = json.dumps(manifest)
    if camera is not None:
        header |= _matrices(camera)
    planes: dict[str, np.ndarray] = {}
    has_single = frame.single_scattering is not None
    for field, names in _layout(channels, len(frame.shadow), gaussians, has_single).items():
        values = np.asarray(getattr(frame, field), np.float32)
        if field != "shadow" and names.ndim:
            values = np.moveaxis(values, -1, names.ndim - 1)
        values = np.ascontiguousarray(values.reshape(-1, *frame.coverage.shape))
        if half and field not in ("depth", "position"):
            values = np.clip(values, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16)
        planes |= dict(zip(names.ravel(), values, strict=True))
    with atomic_path(path) as temporary, OpenEXR.File(header, planes) as file:
        try:
            file.write(str(temporary))
        except Exception as error:  # the package raises whatever its C++ side throws
            reason = " ".join(str(error).replace(str(temporary), "").split())
            raise OSError(errno.EIO, reason, str(temporary)) from None


def read_exr(path: StrPath) -> Frame:
    r"""Read a frame that `write_exr` wrote; single precision is restored exactly.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read or lacks the
    layers of a frame.
    """
    planes, header, _ = read_planes(path)
    channels = 3 if "R" in planes else sum(name.startswith("beauty.") for name in planes)
    gaussians = sum(name.startswith(_WEIGHTS) for name in header)
    lights = sum(name.startswith("shadow") for name in planes)
    has_single = any(name.startswith(_SINGLE) for name in planes)
    try:
        weights = [header[f"{_WEIGHTS}{k}"] for k in range(1, gaussians + 1)]
        arrays = {
            "weights": np.reshape(weights, (gaussians, channels)),
            "unresolved_fraction": np.reshape(header["splatjax.unresolved_fraction"], gaussians),
            "overflow": np.reshape(header["splatjax.overflow"], ()),
        }
        for field, names in _layout(channels, lights, gaussians, has_single).items():
            values = np.asarray([planes[name] for name in names.ravel()])
            values = values.reshape(*names.shape, *planes["A"].shape)
            arrays[field] = values if field == "shadow" else np.moveaxis(values, names.ndim - 1, -1)
    except (KeyError, ValueError) as error:
        raise ValueError(
            f"{path}: lacks {' '.join(str(error).split())}, so it is not a frame; give a file "
            "written by write_exr"
        ) from None
    return Frame(**{name: jnp.asarray(array, jnp.float32) for name, array in arrays.items()})


def read_manifest(path: StrPath) -> dict[str, Any]:
    r"""Read the manifest of a picture, as the command line records it: settings, material.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read or has no such
    record.
    """
    _, header, _ = read_planes(path)
    if not isinstance(header.get(_MANIFEST), str):
        remedy = "give a picture that `splatjax render` wrote"
        raise ValueError(f"{path}: has no record of its settings; {remedy}")
    with naming(path):
        return json.loads(header[_MANIFEST])


def _layout(channels: int, lights: int, gaussians: int, has_single: bool) -> dict[str, np.ndarray]:
    """Name the planes of each field of a frame: arrays of the field's other axes than height and
    width.
    """

    def colors(layer: str) -> list[str]:
        return [f"{layer}.{k}" for k in ("RGB" if channels == 3 else range(1, channels + 1))]

    color = ["albedo", "irradiance", "diffuse", "specular", *([_SINGLE] if has_single else [])]
    layout: dict[str, Any] = {
        "beauty": list("RGB") if channels == 3 else colors("beauty"),
        "coverage": "A",
        "depth": "Z",
        **{layer: [f"{layer}.{axis}" for axis in "XYZ"] for layer in ("position", "normal")},
        **{layer: colors(layer) for layer in color},
        "shadow": [f"shadow{k}.Y" for k in range(1, lights + 1)],
        "layers": np.reshape(
            [colors(f"diffusion{k}") for k in range(1, gaussians + 1)], (gaussians, channels)
        ),
    }
    return {field: np.asarray(names) for field, names in layout.items()}


def _matrices(camera: Camera) -> dict[str, np.ndarray]:
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
    matrices = {"worldToCamera": to_camera, "worldToNDC": to_camera @ to_picture}
    return {name: matrix.astype(np.float32) for name, matrix in matrices.items()}


def _floats(values: Any) -> list[float]:
    return [float(value) for value in np.asarray(values, np.float32)]
