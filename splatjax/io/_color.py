"""The sRGB transfer function (IEC 61966-2-1), both ways."""

import numpy as np
from jaxtyping import Float


def srgb_to_linear(encoded: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Decode sRGB values in [0, 1] to linear light, as float64.

    The pictures that come here are millions of values of 8 or 16 bits, so a table of 65,536 decoded
    levels serves them all; between its levels it is interpolated.
    """
    import colour  # takes 2 s, so only where a color is read

    levels = np.linspace(0.0, 1.0, 65536)
    return np.interp(encoded, levels, colour.cctf_decoding(levels, function="sRGB"))


def linear_to_srgb(linear: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Encode linear light for an sRGB display; values beyond [0, 1] are clipped, NaN becomes 0.

    Written out: every picture for the screen would wait for `colour`, which gives the same.
    """
    shown = np.where(np.isnan(linear), 0.0, np.clip(linear, 0.0, 1.0))
    return np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055)
