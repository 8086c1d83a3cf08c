"""Environment lights from files."""

from typing import Any

import numpy as np

from splatjax.scene import EnvironmentLight

from ._files import StrPath, naming
from ._images import read_picture

_MOST_ROWS = 512


def load_environment(path: StrPath, **fields: Any) -> EnvironmentLight:
    r"""Read an environment light: a latitude-longitude map of OpenEXR, Radiance HDR or another
    format of floating-point numbers. Maps of more than 512 rows are halved, by averaging, while
    both sides are even, which hardly changes samples and highlights.

    **Arguments:** `fields`: the others of `EnvironmentLight`, by name.

    **Raises:** as `read_picture` does, and `ValueError` for a map that is not twice as wide as
    high, or has radiance that is negative or not finite.
    """
    image = read_picture(path)
    while len(image) > _MOST_ROWS and not np.any(np.mod(image.shape[:2], 2)):
        image = image.reshape(len(image) // 2, 2, image.shape[1] // 2, 2, -1).mean(axis=(1, 3))
    with naming(path):
        return EnvironmentLight(image.astype(np.float32), **fields)
