"""A picture that was taken, and how."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, DTypeLike, Float

from splatjax._records import Numbers, check_values, numbers, record, several
from splatjax.scene import AbstractLight, Camera

_UNKNOWN_NOISE = 0.01
"""Deviation of pictures that come without one, as a fraction of their brightness: error bars do not
depend on it.
"""


class AbstractIntensity(eqx.Module):
    """Factors on all light of a picture: which channels share one that is to be found."""

    @abc.abstractmethod
    def groups(self, channels: int) -> np.ndarray:
        """Give, for each channel, the number of its factor among those of the picture; -1 where it
        is known to be 1.
        """


class KnownIntensity(AbstractIntensity):
    """The lights are as strong as they say."""

    def groups(self, channels: int) -> np.ndarray:
        return np.full(channels, -1)


class UnknownIntensity(AbstractIntensity):
    """One factor for all channels: an exposure that was not measured, under light of a known
    color.
    """

    def groups(self, channels: int) -> np.ndarray:
        return np.zeros(channels, int)


class UnknownColor(AbstractIntensity):
    """A factor for each channel. What then tells of the material is how the light is spread over
    the picture alone.
    """

    def groups(self, channels: int) -> np.ndarray:
        return np.arange(channels)


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


class Evidence(eqx.Module):
    """A picture in the precision of a computation.

    **Attributes:**

    - `picture`: 0 where it is unknown.
    - `deviation`: of its noise.
    - `known`: which pixels may count.
    - `relative_noise`: the deviation of a typical pixel over the brightness of the picture. Static.
    """

    picture: Float[Array, "height width channels"]
    deviation: Float[Array, "height width channels"]
    known: Bool[Array, "height width"]
    relative_noise: float = eqx.field(static=True)

    @classmethod
    def of(cls, observation: Observation, dtype: DTypeLike) -> "Evidence":
        picture = np.asarray(observation.picture, np.float64)
        known = np.all(np.isfinite(picture), axis=-1)
        if observation.mask is not None:
            known &= np.asarray(observation.mask)
        picture = np.where(known[..., None], picture, 0.0)
        brightness = float(np.sqrt(np.mean(picture[known] ** 2))) if known.any() else 0.0
        brightness = brightness or 1.0
        deviation = np.full(picture.shape, _UNKNOWN_NOISE * brightness)
        if observation.deviation is not None:
            deviation = np.asarray(observation.deviation, np.float64)
        arrays = jnp.asarray(picture, dtype), jnp.asarray(deviation, dtype), jnp.asarray(known)
        return cls(*arrays, relative_noise=float(np.median(deviation)) / brightness)


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
