"""The sRGB transfer function (IEC 61966-2-1), both ways."""

import numpy as np
from jaxtyping import Float


def srgb_to_linear(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Decode sRGB values in [0, 1] to linear light."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Encode linear light for an sRGB display; values beyond [0, 1] are clipped, NaN becomes 0."""
    shown = np.where(np.isnan(linear), 0.0, np.clip(linear, 0.0, 1.0))
    return np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
