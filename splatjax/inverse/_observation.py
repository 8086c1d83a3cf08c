"""A picture that was taken, and how."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from splatjax.scene import AbstractLight, Camera

from ._intensity import AbstractIntensity, KnownIntensity


class Observation(eqx.Module):
    r"""A picture of the body, linear light, and how it was taken.

    **Attributes:**

    - `picture`: radiance, as `Frame.beauty`; NaN where a pixel is not known.
    - `camera`: with as many pixels.
    - `lights`: all of them.
    - `mask`: which pixels count; `None` for all. Those that the body does not fill never do: what
      is behind it is not known.
    - `deviation`: standard deviation of the noise, as the picture. `None`: it is unknown and the
      same in the whole picture; error bars then come from what the model leaves over. Pictures
      without one count alike, each by its own brightness.
    - `intensity`: `KnownIntensity()`, or what is to be found of the lights' strength.

    **Raises:** `ValueError` for pictures, masks and deviations of other sizes than the camera's,
    and for deviations that are not positive.
    """

    picture: Float[Array | np.ndarray, "height width channels"]
    camera: Camera
    lights: tuple[AbstractLight, ...]
    mask: Bool[Array | np.ndarray, "height width"] | None = None
    deviation: Float[Array | np.ndarray, "height width channels"] | None = None
    intensity: AbstractIntensity = KnownIntensity()

    def __check_init__(self):
        size = self.camera.height, self.camera.width
        for name in ("picture", "mask", "deviation"):
            value = getattr(self, name)
            if value is not None and value.shape[:2] != size:
                raise ValueError(
                    f"{name} has {value.shape[0]} x {value.shape[1]} pixels, camera {size[0]} x "
                    f"{size[1]} (down, across)"
                )
        if self.deviation is not None and not np.all(np.asarray(self.deviation) > 0):
            raise ValueError(
                f"deviation must be positive; its least is {float(np.min(self.deviation)):g}"
            )


def nothing_counts(number: int) -> ValueError:
    """Say that no pixel of an observation tells anything."""
    return ValueError(
        f"no pixel of observations[{number}] counts: the splats fill none that its mask leaves and "
        "whose color is known; "
        "check camera, mask and NaN"
    )
