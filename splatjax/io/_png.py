"""Pictures for the screen."""

import os
from pathlib import Path

import numpy as np
from jaxtyping import Float
from PIL import Image

from splatjax.scene import Frame

from ._atomic import atomic_path
from ._color import linear_to_srgb


def write_png(
    path: str | os.PathLike[str],
    picture: Frame | Float[np.ndarray, "height width channels"],
    *,
    exposure: float = 0.0,
) -> None:
    r"""Write a picture for an sRGB display, 8 bits, whole or not at all.

    **Arguments:**

    - `picture`: a frame, whose beauty over black is shown; or linear values of 1 (gray), 3 (RGB) or
      4 channels (RGB premultiplied by the alpha that follows, which is written as PNG wants it: not
      premultiplied, encoded color).
    - `exposure`: in stops: the values are multiplied by `2^exposure` before they are encoded. What
      exceeds 1 is clipped.

    **Raises:** `ValueError` for another number of channels or an exposure that is not finite,
    `FileNotFoundError` when the folder does not exist.
    """
    path = Path(path)
    values = np.asarray(picture.beauty if isinstance(picture, Frame) else picture, np.float64)
    channels = values.shape[-1]
    if channels not in (1, 3, 4):
        raise ValueError(
            f"{path}: a picture of {channels} channels has no colors to show; convert it to 1, 3 "
            "or 4 channels"
        )
    if not np.isfinite(exposure):
        raise ValueError(f"{path}: exposure is {exposure}; it must be a finite number of stops")
    color, alpha = (
        (values[..., :3], np.clip(values[..., 3:], 0, 1)) if channels == 4 else (values, None)
    )
    if alpha is not None:
        color = np.where(alpha > 0, color / np.where(alpha > 0, alpha, 1), 0)
    encoded = linear_to_srgb(color * 2.0**exposure)
    if alpha is not None:
        encoded = np.concatenate([encoded, alpha], axis=-1)
    image = Image.fromarray(
        np.rint(encoded * 255).astype(np.uint8).squeeze(-1) if channels == 1 else _bytes(encoded)
    )
    with atomic_path(path) as temporary:
        image.save(temporary, format="PNG")


def _bytes(encoded: np.ndarray) -> np.ndarray:
    return np.rint(encoded * 255).astype(np.uint8)
