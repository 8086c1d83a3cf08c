"""Maps: JPEG, PNG, TIFF and others, of 8 or 16 bits."""

import os
import sys
import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageFile

from ._color import srgb_to_linear
from ._files import existing_file
from ._room import check_room

BYTES_PER_PIXEL = 80.0  # of three channels in double precision, while they are decoded
_GRAY = (0.299, 0.587, 0.114)  # Pillow's


def read_color(
    path: str | os.PathLike[str], encoded: bytes | None = None
) -> Float[np.ndarray, "height width 3"]:
    """Read an sRGB picture as linear light, row 0 at the top: from a file, or from what stands
    encoded within it.
    """
    return srgb_to_linear(_read(path, "RGB", encoded))


def read_vectors(path: str | os.PathLike[str]) -> Float[np.ndarray, "height width 3"]:
    """Read a normal map: values from -1 to 1, not decoded."""
    return _read(path, "RGB") * 2 - 1


def read_factor(path: str | os.PathLike[str]) -> Float[np.ndarray, "height width"]:
    """Read a gray picture: values from 0 to 1, not decoded."""
    return _read(path, "L")


def _read(
    path: str | os.PathLike[str], mode: str, encoded: bytes | None = None
) -> Float[np.ndarray, "..."]:
    path = existing_file(path)

    def opened() -> ImageFile.ImageFile:
        return Image.open(path if encoded is None else BytesIO(encoded))

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large pictures, for which there is room or not
            with opened() as picture:
                width, height = picture.size
                size = f"a picture of {width} x {height} pixels"
                check_room(
                    f"{path}: {size}", BYTES_PER_PIXEL * width * height, "give a smaller one"
                )
                _check_whole(picture)
                if not _of_16_bits(picture):
                    return _values(picture, mode)
                with opened() as again:
                    values = _deep_values(picture, again)
                    return values if mode == "RGB" else values @ np.asarray(_GRAY)
    except ValueError as error:
        raise error if str(error).startswith(f"{path}: ") else _unreadable(path, error) from None
    except Exception as error:  # each decoder of Pillow fails in its own way
        raise _unreadable(path, error) from None


def _check_whole(picture: ImageFile.ImageFile) -> None:
    """Refuse a TIFF whose strips end before it does: Pillow would leave the rest at 0."""
    if picture.format != "TIFF":
        return
    width, height = picture.size
    held: dict[str, int] = {}  # by raw mode: each channel may have strips of its own
    for tile in picture.tile:
        left, top, right, bottom = tile.extents or (0, 0, width, height)
        held[_raw_mode(tile.args)] = held.get(_raw_mode(tile.args), 0) + (right - left) * (
            bottom - top
        )
    least = min(held.values(), default=0)
    if least < width * height:
        raise ValueError(f"it holds {least} of {width} x {height} pixels")


def _unreadable(path: Path, error: Exception) -> ValueError:
    said = " ".join(str(error).split()) or type(error).__name__
    return ValueError(
        f"{path}: cannot be read as a picture ({said}); give a whole JPEG, PNG or TIFF"
    )


def _values(picture: Image.Image, mode: str) -> Float[np.ndarray, "..."]:
    if picture.mode == "F":
        raise ValueError(
            "its values are floating point, of which nothing says how they are encoded"
        )
    if picture.mode.startswith("I"):  # 16 bits, which `convert` would clip
        gray = np.asarray(picture, np.float64) / 65535
        return gray if mode == "L" else np.repeat(gray[..., None], 3, axis=-1)
    return np.asarray(picture.convert(mode), np.float64) / 255


def _of_16_bits(picture: ImageFile.ImageFile) -> bool:
    """Whether Pillow would pass over the lower half of a picture's 16 bits, as it does where there
    are several channels.

    Of gray with alpha it knows one order of bytes alone, so that its lower half is passed over.
    """
    raw = [_raw_mode(tile.args) for tile in picture.tile]
    return not picture.mode.startswith("I") and any(
        ";16" in each and each.startswith("RGB") for each in raw
    )


def _deep_values(
    picture: ImageFile.ImageFile, again: ImageFile.ImageFile
) -> Float[np.ndarray, "height width 3"]:
    """Read a picture of 16 bits twice: the upper bytes, and the lower ones as if they were upper
    ones in the other order.
    """
    swapped = {"B": "L", "L": "B", "N": "B" if sys.byteorder == "little" else "L"}
    for i, tile in enumerate(again.tile):
        raw = _raw_mode(tile.args)
        other = raw[:-1] + swapped[raw[-1]]
        again.tile[i] = tile._replace(
            args=(other, *tile.args[1:]) if isinstance(tile.args, tuple) else other
        )
    upper, lower = (np.asarray(each.convert("RGB"), np.float64) for each in (picture, again))
    return (256 * upper + lower) / 65535


def _raw_mode(arguments: object) -> str:
    return str(arguments[0] if isinstance(arguments, tuple) and arguments else arguments)
