"""Encoding of pictures for sRGB displays (IEC 61966-2-1), in 8 bits and as PNG."""

import io

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image


def linear_to_srgb(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Encode linear light for an sRGB display. Values outside [0, 1] are clipped, and NaN becomes
    0.
    """
    shown = np.where(np.isnan(linear), 0.0, np.clip(linear, 0.0, 1.0))
    return np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)


def srgb_to_linear(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Decode sRGB values in [0, 1] to linear light."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def to_display(
    values: Float[np.ndarray, "height width channels"], exposure: float = 0.0
) -> UInt8[np.ndarray, "height width channels"]:
    """Encode linear values of 1, 3 or 4 channels, as `splatjax.write_png` describes them.

    **Raises:** `ValueError` for another number of axes or channels, for integers, and for an
    exposure that is not finite.
    """
    values = np.asarray(values)
    if values.ndim != 3 or values.dtype.kind != "f":
        raise ValueError(
            f"a picture of shape {values.shape} and dtype {values.dtype} cannot be shown; give "
            "linear light, floating-point numbers [height, width, channels]"
        )
    values, channels = values.astype(np.float64), values.shape[-1]
    if channels not in (1, 3, 4):
        raise ValueError(
            f"a picture of {channels} channels cannot be shown; give 1, 3 or 4, or the wavelengths "
            "of the channels"
        )
    if not np.isfinite(exposure):
        raise ValueError(f"exposure is {exposure}; it must be a finite number of stops")
    color, alpha = values[..., :3], np.clip(values[..., 3:], 0, 1)
    if channels == 4:
        color = np.where(alpha > 0, color / np.where(alpha > 0, alpha, 1), 0)
    encoded = np.concatenate([linear_to_srgb(color * 2.0**exposure), alpha], axis=-1)
    return np.rint(255 * encoded).astype(np.uint8)


def png_of(image: UInt8[np.ndarray, "height width channels"]) -> bytes:
    """Encode an image as the bytes of a PNG file."""
    file = io.BytesIO()
    Image.fromarray(image[..., 0] if image.shape[-1] == 1 else image).save(file, format="PNG")
    return file.getvalue()
