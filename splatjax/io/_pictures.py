"""Maps: JPEG, PNG, TIFF and others, of 8 or 16 bits."""

import os
import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from ._color import srgb_to_linear
from ._files import existing_file
from ._room import check_room

_BYTES_PER_PIXEL = 80.0  # of three channels in double precision, while they are decoded


def read_color(path: str | os.PathLike[str], encoded: bytes | None = None) -> Float[np.ndarray, "height width 3"]:
    """Read an sRGB picture as linear light, row 0 at the top: from a file, or from what stands encoded within it."""
    return srgb_to_linear(_read(path, "RGB", encoded))


def read_vectors(path: str | os.PathLike[str]) -> Float[np.ndarray, "height width 3"]:
    """Read a normal map: values from -1 to 1, not decoded."""
    return _read(path, "RGB") * 2 - 1


def read_factor(path: str | os.PathLike[str]) -> Float[np.ndarray, "height width"]:
    """Read a gray picture: values from 0 to 1, not decoded."""
    return _read(path, "L")


def _read(path: str | os.PathLike[str], mode: str, encoded: bytes | None = None) -> Float[np.ndarray, "..."]:
    path = existing_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large pictures, for which there is room or not
            with Image.open(path if encoded is None else BytesIO(encoded)) as picture:
                width, height = picture.size
                size = f"a picture of {width} x {height} pixels"
                check_room(f"{path}: {size}", _BYTES_PER_PIXEL * width * height, "give a smaller one")
                return _values(picture, mode)
    except ValueError as error:
        raise error if str(error).startswith(f"{path}: ") else _unreadable(path, error) from None
    except Exception as error:  # each decoder of Pillow fails in its own way
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: Exception) -> ValueError:
    said = " ".join(str(error).split()) or type(error).__name__
    return ValueError(f"{path}: cannot be read as a picture ({said}); give a whole JPEG, PNG or TIFF")


def _values(picture: Image.Image, mode: str) -> Float[np.ndarray, "..."]:
    if picture.mode == "F":
        raise ValueError("its values are floating point, of which nothing says how they are encoded")
    if picture.mode.startswith("I"):  # 16 bits, which `convert` would clip
        gray = np.asarray(picture, np.float64) / 65535
        return gray if mode == "L" else np.repeat(gray[..., None], 3, axis=-1)
    return np.asarray(picture.convert(mode), np.float64) / 255
