"""Pictures for the screen: PNG, and WebP where they move."""

import itertools
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from PIL import Image

from splatjax.scene import Frame

from ._atomic import atomic_path
from ._images import linear_to_srgb


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
    values = np.asarray(picture.beauty if isinstance(picture, Frame) else picture, np.float64)
    channels = values.shape[-1]
    if channels not in (1, 3, 4):
        raise ValueError(
            f"{path}: a picture of {channels} channels has no colors to show; convert it to 1, 3 "
            "or 4 channels"
        )
    if not np.isfinite(exposure):
        raise ValueError(f"{path}: exposure is {exposure}; it must be a finite number of stops")
    color, alpha = values[..., :3], np.clip(values[..., 3:], 0, 1)
    if channels == 4:
        color = np.where(alpha > 0, color / np.where(alpha > 0, alpha, 1), 0)
    encoded = np.concatenate([linear_to_srgb(color * 2.0**exposure), alpha], axis=-1)
    image = np.rint(255 * encoded).astype(np.uint8)
    with atomic_path(path) as temporary:
        Image.fromarray(image[..., 0] if channels == 1 else image).save(temporary, format="PNG")


def write_animation(
    path: str | os.PathLike[str],
    frames: Sequence[str | os.PathLike[str]],
    *,
    frames_per_second: float = 24.0,
) -> None:
    r"""Join pictures to one animated WebP file that begins again for ever, whole or not at all.

    Nothing is lost: it has the frames' own colors. Every browser plays it.

    **Arguments:**

    - `frames`: PNG files, in their order: one at least, all of one size.
    - `frames_per_second`: from 0.1 to 60; browsers slow down what is faster.

    **Raises:** `ValueError` for no frames, frames of several sizes, and a speed out of range;
    `OSError` when a frame cannot be read, or the folder does not exist.
    """
    if not frames or not 0.1 <= frames_per_second <= 60:
        raise ValueError(
            f"{path}: {len(frames)} frames at {frames_per_second:g} per second cannot be shown; "
            "give one at least, and a number from 0.1 to 60"
        )
    # Whole milliseconds, but every frame begins when it should.
    begins = [round(1000 * i / frames_per_second) for i in range(len(frames) + 1)]
    durations = [end - begin for begin, end in itertools.pairwise(begins)]
    options = {"save_all": True, "duration": durations, "loop": 0, "lossless": True}
    with atomic_path(path) as temporary:
        _Film(frames).save(temporary, format="WEBP", **options)


class _Film(Image.Image):
    """Files as one picture of many frames, so that one at a time is in memory."""

    def __init__(self, frames: Sequence[str | os.PathLike[str]]):
        super().__init__()
        self._frames, self.n_frames = frames, len(frames)
        self.seek(0)

    def seek(self, frame: int) -> None:
        with Image.open(self._frames[frame]) as image:
            image.load()
            if self.size not in ((0, 0), image.size):
                raise ValueError(
                    f"{self._frames[frame]}: is {image.size} pixels, but the first is {self.size}; "
                    "give one size"
                )
            self.im, self._mode, self._size = image.im, image.mode, image.size
