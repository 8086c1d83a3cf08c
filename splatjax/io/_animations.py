"""Writing of animations as WebP."""

from collections.abc import Sequence

import numpy as np
from PIL import Image

from ._files import StrPath, atomic_path, check_suffix, expect


def write_animation(
    path: StrPath, frames: Sequence[StrPath], *, frames_per_second: float = 24.0
) -> None:
    r"""Write pictures as a lossless, endlessly repeating WebP animation, atomically.

    **Arguments:**

    - `frames`: PNG files in order, at least one, all of equal size.
    - `frames_per_second`: from 0.1 to 60; browsers slow down faster animations.

    **Raises:** `ValueError` for a suffix other than `.webp`, without frames, for unequal sizes, and
    for a speed out of range; `OSError` if a frame cannot be read or the folder does not exist.
    """
    check_suffix(path, ".webp")
    expect(
        frames and 0.1 <= frames_per_second <= 60,
        path,
        f"{len(frames)} frames at {frames_per_second:g} per second; give at least one frame, and "
        "0.1 to 60 per second",
    )
    # Round the start times of frames to milliseconds, so that rounding errors do not add up.
    begins = [round(1000 * i / frames_per_second) for i in range(len(frames) + 1)]
    options = {"save_all": True, "duration": np.diff(begins).tolist(), "loop": 0, "lossless": True}
    with atomic_path(path) as temporary:
        _Film(frames).save(temporary, format="WEBP", **options)


class _Film(Image.Image):
    """A picture of many frames that are files, with only one frame in memory at a time."""

    def __init__(self, frames: Sequence[StrPath]):
        super().__init__()
        self._frames, self.n_frames = frames, len(frames)
        self.seek(0)

    def seek(self, frame: int) -> None:
        with Image.open(self._frames[frame]) as image:
            image.load()
            expect(
                self.size in ((0, 0), image.size),
                self._frames[frame],
                f"is {image.size} pixels, and the first is {self.size}; give all the same size",
            )
            self.im, self._mode, self._size = image.im, image.mode, image.size
