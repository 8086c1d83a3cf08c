"""A frame with all its layers in one OpenEXR file."""

import errno
import json
import os
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import OpenEXR  # ty: ignore[import-not-found]

from splatjax.scene import Frame

from ._atomic import atomic_path
from ._files import existing_file
from ._room import check_room
from ._version import own_version

_REC709_D65 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
_WEIGHTS = "splatjax.weights.{}"
_SINGLE = "single_scattering"
_MANIFEST = "splatjax.manifest"
_VARIANCES, _HANDED_OVER, _OVERFLOW = (
    "splatjax.variances",
    "splatjax.handed_over",
    "splatjax.overflow",
)


def write_exr(
    path: str | os.PathLike[str],
    frame: Frame,
    *,
    variances: Sequence[float] | None = None,
    manifest: Mapping[str, Any] | None = None,
) -> None:
    r"""Write a frame with all its layers to one OpenEXR file, single precision, whole or not at
    all.

    | channels | what they are |
    | --- | --- |
    | `R G B A` | beauty, premultiplied, and coverage |
    | `Z` | depth, mm; inf where there is nothing |
    | `position.X Y Z`, `normal.X Y Z` | of the front surface, world space, mm |
    | `albedo.R G B`, `irradiance.R G B`, `diffuse.R G B`, `specular.R G B` | premultiplied |
    | `single_scattering.R G B` | premultiplied; only when the material has such a term |
    | `shadow.1`, `shadow.2`, ... | per light |
    | `diffusion.1.R G B`, ... | per Gaussian: `diffuse = sum_k weights_k diffusion.k` |

    Pictures of another number of channels than 3 have `beauty.1`, `beauty.2`, ..., `albedo.1`, ...
    instead of R G B. The header holds the weights of the Gaussians (`splatjax.weights.1`, ...: a
    value per channel), their variances (mm^2) when given, and the color space: linear, Rec. 709
    primaries, D65; and, as JSON in `splatjax.manifest`, what the picture was made of, when that is
    given (`read_manifest`).

    **Raises:** `FileNotFoundError` when the folder does not exist.
    """
    planes = {
        name: np.ascontiguousarray(np.asarray(plane, np.float32)) for name, plane in _planes(frame)
    }
    header: dict = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "software": f"splatjax {own_version()}",
        "comments": (
            "Linear light. Depth and position in mm; depth, position and normal are "
            "not premultiplied."
        ),
        _HANDED_OVER: _floats(frame.handed_over),
        _OVERFLOW: float(frame.overflow),
    }
    if frame.beauty.shape[-1] == 3:
        header |= {"chromaticities": _REC709_D65, "colorInteropID": "lin_rec709_scene"}
    header |= {
        _WEIGHTS.format(k): _floats(weights)
        for k, weights in enumerate(np.asarray(frame.weights), 1)
    }
    if variances is not None:
        header[_VARIANCES] = _floats(variances)
    if manifest is not None:
        header[_MANIFEST] = json.dumps(manifest)
    with atomic_path(path) as temporary, OpenEXR.File(header, planes) as file:
        try:
            file.write(str(temporary))
        except Exception as error:  # the package raises whatever its C++ side throws
            said = " ".join(str(error).replace(str(temporary), "").split())
            raise OSError(errno.EIO, said, str(temporary)) from None


def read_exr(path: str | os.PathLike[str]) -> Frame:
    r"""Read a frame that `write_exr` wrote: what was single precision comes back bit by bit.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read or lacks the
    layers of a frame.
    """
    path = Path(path)
    header, planes = _read(path)
    try:
        return _frame(header, planes)
    except KeyError as error:
        raise ValueError(
            f"{path}: lacks {error.args[0]}, so it is no frame; give a file written by write_exr"
        ) from error
    except (TypeError, ValueError) as error:
        said = " ".join(str(error).split())
        raise ValueError(
            f"{path}: has no weights as a frame has ({said}); give a file written by write_exr"
        ) from None


def read_manifest(path: str | os.PathLike[str]) -> dict[str, Any]:
    r"""Read what a picture was made of: versions, settings, material, as the command line writes
    it.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read or does not say
    it.
    """
    path = Path(path)
    header, _ = _read(path)
    try:
        found = json.loads(header[_MANIFEST])
    except (KeyError, TypeError, ValueError):
        found = None
    if not isinstance(found, dict):
        raise ValueError(
            f"{path}: does not say what it was made of; give a picture that `splatjax render` wrote"
        )
    return found


def read_picture(path: str | os.PathLike[str]) -> np.ndarray:
    r"""Read the colors of an OpenEXR file of any origin: R, G and B, or Y alone.

    **Returns:** [height, width, channels], as they stand in the file, in double precision.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read or has neither.
    """
    path = Path(path)
    _, planes = _read(path)
    for names in ("RGB", "Y"):
        if set(names) <= set(planes):
            with np.errstate(invalid="ignore"):  # of NaN that signals
                return np.stack([planes[name] for name in names], axis=-1).astype(np.float64)
    raise ValueError(f"{path}: has neither R, G and B nor Y; it has {', '.join(sorted(planes))}")


def _read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    existing_file(path)
    said: list[str] = []
    try:
        with _overheard(said):
            with OpenEXR.File(str(path), header_only=True) as file:
                header = dict(file.header())
            low, high = (np.asarray(corner, np.int64) for corner in header["dataWindow"])
            pixels, channels = float(np.prod(high - low + 1)), len(header["channels"])
            check_room(
                f"{path}: a picture of {pixels:.3g} pixels and {channels} channels",
                12.0 * pixels * channels,
                "give less",
            )
            with OpenEXR.File(str(path), separate_channels=True) as file:
                planes = {
                    name: np.array(channel.pixels) for name, channel in file.channels().items()
                }
        if said:
            raise ValueError
    except (
        Exception
    ) as error:  # the package raises whatever its C++ side throws, or says it and goes on without
        if str(error).startswith(f"{path}: a picture"):
            raise
        reason = " ".join((said[0] if said else str(error)).replace(f"{path}: ", "").split())
        raise ValueError(
            f"{path}: cannot be read as OpenEXR ({reason}); it is cut short or of another format"
        ) from None
    if len({plane.shape for plane in planes.values()}) != 1:
        raise ValueError(
            f"{path}: has channels of several sizes, which are not read here; write all in full"
        )
    return header, planes


@contextmanager
def _overheard(said: list[str]) -> Generator[None, None, None]:
    """Take down what the package's C++ side prints, and writes to the standard error of the
    process.
    """
    sys.stderr.flush()
    with tempfile.TemporaryFile() as heard, redirect_stdout(StringIO()) as printed:
        kept = os.dup(2)
        try:
            os.dup2(heard.fileno(), 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            heard.seek(0)
            lines = (
                heard.read().decode("utf-8", "replace").splitlines()
                + printed.getvalue().splitlines()
            )
            said.extend(line for line in lines if line.strip())


def _floats(values) -> list[float]:
    return [float(value) for value in np.asarray(values, np.float32)]


def _names(layer: str, channels: int) -> list[str]:
    return (
        [f"{layer}.{letter}" for letter in "RGB"]
        if channels == 3
        else [f"{layer}.{k}" for k in range(1, channels + 1)]
    )


def _beauty_names(channels: int) -> list[str]:
    return list("RGB") if channels == 3 else _names("beauty", channels)


def _planes(frame: Frame) -> Iterator[tuple[str, np.ndarray]]:
    channels = frame.beauty.shape[-1]

    def split(names, picture):
        return zip(names, np.moveaxis(np.asarray(picture), -1, 0), strict=True)

    yield from split(_beauty_names(channels), frame.beauty)
    yield "A", np.asarray(frame.coverage)
    yield "Z", np.asarray(frame.depth)
    for layer in ("position", "normal"):
        yield from split([f"{layer}.{axis}" for axis in "XYZ"], getattr(frame, layer))
    for layer in ("albedo", "irradiance", "diffuse", "specular"):
        yield from split(_names(layer, channels), getattr(frame, layer))
    if frame.single_scattering is not None:
        yield from split(_names(_SINGLE, channels), frame.single_scattering)
    for number, shadow in enumerate(np.asarray(frame.shadow), 1):
        yield f"shadow.{number}", shadow
    for number, picture in enumerate(np.asarray(frame.layers), 1):
        yield from split(_names(f"diffusion.{number}", channels), picture)


def _frame(header: dict, planes: dict[str, np.ndarray]) -> Frame:
    colored = "R" in planes
    channels = 3 if colored else _count(lambda k: f"beauty.{k}" in planes)
    if channels == 0:
        raise KeyError("R, G, B")
    gaussians = _count(lambda k: _WEIGHTS.format(k) in header)
    lights = _count(lambda k: f"shadow.{k}" in planes)
    shape = planes["A"].shape

    def picture(names):
        return np.stack([planes[name] for name in names], axis=-1)

    def stacked(pictures, *each):
        return np.stack(pictures) if pictures else np.zeros((0, *each), np.float32)

    weights = [np.asarray(header[_WEIGHTS.format(k)], np.float32) for k in range(1, gaussians + 1)]
    layers = [picture(_names(f"diffusion.{k}", channels)) for k in range(1, gaussians + 1)]
    arrays = {
        "beauty": picture(_beauty_names(channels)),
        "coverage": planes["A"],
        "depth": planes["Z"],
        **{
            layer: picture([f"{layer}.{axis}" for axis in "XYZ"])
            for layer in ("position", "normal")
        },
        **{
            layer: picture(_names(layer, channels))
            for layer in ("albedo", "irradiance", "diffuse", "specular")
        },
        "shadow": stacked([planes[f"shadow.{k}"] for k in range(1, lights + 1)], *shape),
        "layers": stacked(layers, *shape, channels),
        "weights": stacked(weights, channels),
        "handed_over": np.asarray(header[_HANDED_OVER], np.float32),
        "overflow": np.asarray(header[_OVERFLOW], np.float32),
    }
    if _names(_SINGLE, channels)[0] in planes:
        arrays[_SINGLE] = picture(_names(_SINGLE, channels))
    return Frame(**{name: jnp.asarray(array) for name, array in arrays.items()})


def _count(exists: Callable[[int], bool]) -> int:
    number = 0
    while exists(number + 1):
        number += 1
    return number
