"""Pictures that move."""

import itertools
import os
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from ._atomic import atomic_path


def write_animation(
    path: str | os.PathLike[str],
    frames: Sequence[str | os.PathLike[str]],
    *,
    frames_per_second: float = 24.0,
) -> None:
    r"""Join pictures to one animated WebP file that begins anew for ever, whole or not at all.

    Nothing is lost: it has the frames' own colors. Every browser plays it.

    **Arguments:**

    - `frames`: PNG files, in their order: one at least, all of one size.
    - `frames_per_second`: from 0.1 to 60; browsers slow down what is faster.

    **Raises:** `ValueError` for no frames, frames of several sizes, and a speed out of range;
    `OSError` when a frame cannot be read, or the folder does not exist.
    """
    path = Path(path)
    if not frames:
        raise ValueError(f"{path}: an animation needs a frame")
    if not 0.1 <= frames_per_second <= 60:
        raise ValueError(
            f"{path}: {frames_per_second:g} frames per second cannot be shown; give a number from "
            "0.1 to 60"
        )
    # Whole milliseconds, but every frame begins when it should.
    begins = [round(1000 * i / frames_per_second) for i in range(len(frames) + 1)]
    durations = [end - begin for begin, end in itertools.pairwise(begins)]
    film = _Film(frames)
    with atomic_path(path) as temporary:
        film.save(
            temporary, format="WEBP", save_all=True, duration=durations, loop=0, lossless=True
        )


class _Film(Image.Image):
    """Files as one picture of many frames, so that one at a time is in memory."""

    def __init__(self, frames: Sequence[str | os.PathLike[str]]):
        super().__init__()
        self._frames = frames
        self.n_frames = len(frames)
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
