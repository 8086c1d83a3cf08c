"""A picture that was taken, and how."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatjax._records import Numbers, check_values, numbers, record, several
from splatjax.scene import AbstractLight, Camera

from ._intensity import AbstractIntensity, KnownIntensity


def _to_mask(values: Numbers | None) -> Array | None:
    return None if values is None else jnp.asarray(values, bool)


@record
class Observation(eqx.Module):
    r"""A picture of the body, linear light, and how it was taken.

    **Attributes:**

    - `picture`: radiance, as `Frame.beauty`; NaN where a pixel is unknown.
    - `camera`: with as many pixels.
    - `lights`: all of them.
    - `mask`: which pixels count; `None` for all. Those that the body does not fill never do: the
      background is unknown.
    - `deviation`: standard deviation of the noise, for each pixel and channel or one number.
      `None`: it is unknown and the same in the whole picture; error bars then come from the
      residuals. Pictures without one count alike, each by its own brightness.
    - `intensity`: `KnownIntensity()`, or what is unknown of the strength of the lights.

    **Raises:** `ValueError` for pictures, masks and deviations of other sizes than the camera's,
    and for deviations that are not positive.
    """

    picture: Float[Array, "height width channels"] = eqx.field(converter=numbers)
    camera: Camera
    lights: tuple[AbstractLight, ...] = eqx.field(converter=several)
    mask: Bool[Array, "height width"] | None = eqx.field(converter=_to_mask, default=None)
    deviation: Float[Array, "height width channels"] | None = eqx.field(
        converter=numbers, default=None
    )
    intensity: AbstractIntensity = KnownIntensity()

    def __check_init__(self):
        size = self.camera.height, self.camera.width
        for name in ("picture", "mask"):
            value = getattr(self, name)
            if value is not None and value.shape[:2] != size:
                raise ValueError(
                    f"Observation.{name} has {value.shape[0]} x {value.shape[1]} pixels, its "
                    f"camera {size[0]} x {size[1]} (height, width)"
                )
        check_values("Observation.deviation", self.deviation, "positive", lambda x: x > 0)


def nothing_counts(number: int) -> ValueError:
    """Make the error for an observation without a pixel that counts."""
    return ValueError(
        f"no pixel of observations[{number}] counts: none is filled by the splats, left by the "
        "mask and of known color; check camera, mask and NaN"
    )


def check_channels(number: int, observation: Observation, channels: int, source: str) -> None:
    """Raise `ValueError` for a picture of another number of channels than its source has."""
    found = observation.picture.shape[2]
    if found != channels:
        raise ValueError(
            f"observations[{number}].picture has {found} channels, {source} has {channels}"
        )
