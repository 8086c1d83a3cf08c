"""Observed pictures, candidate pictures, the pixels that count, and the loss of their residuals."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, DTypeLike, Float

from splatjax._records import numbers, record, require, several, valid
from splatjax.scene import (
    AbstractLight,
    Camera,
    DirectionalLight,
    GaussianBeam,
    Material,
    Scene,
    Splats,
)

# Coverage above which a pixel shows only the body.
_FILLED = 0.999
# Assumed deviation of pictures without a deviation, relative to their brightness. Error bars do not
# depend on it.
_UNKNOWN_NOISE = 0.01


class AbstractIntensity(eqx.Module):
    """Unknown factors of all light of a picture, and the channels that share them."""

    @abc.abstractmethod
    def groups(self, channels: int) -> np.ndarray:
        """Return for each channel the index of its factor among those of the picture, or -1 if the
        factor is known to be 1.
        """


class KnownIntensity(AbstractIntensity):
    """The strengths of the lights are known."""

    def groups(self, channels: int) -> np.ndarray:
        return np.full(channels, -1)


class UnknownIntensity(AbstractIntensity):
    """One factor for all channels, for an unmeasured exposure under light of a known color."""

    def groups(self, channels: int) -> np.ndarray:
        return np.zeros(channels, int)


class UnknownColor(AbstractIntensity):
    """One factor per channel. Only the distribution of light over the picture then determines the
    material.
    """

    def groups(self, channels: int) -> np.ndarray:
        return np.arange(channels)


@record
class Observation(eqx.Module):
    r"""A picture of the body in linear light, with its camera, lights and noise.

    **Attributes:**

    - `picture`: linear radiance, like `Frame.beauty`; NaN where a pixel is unknown.
    - `camera`: the camera, with as many pixels as the picture.
    - `lights`: all lights of the picture.
    - `mask`: the pixels that count; `None` for all. Pixels that the body does not fill count only
      with a `BlackBackground`.
    - `deviation`: standard deviation of the noise, one number or one per pixel and channel. `None`:
      unknown and uniform; error bars are then computed from the residuals, and pictures have equal
      weight relative to their brightness.
    - `intensity`: `KnownIntensity()`, or the unknown factors of the strength of the lights.

    **Raises:** `ValueError` for pictures, masks and deviations whose size is not that of the
    camera, and for deviations that are not positive.
    """

    picture: Float[Array, "height width channels"] = eqx.field(
        converter=numbers, metadata={"linear": True}
    )
    camera: Camera
    lights: tuple[AbstractLight, ...] = eqx.field(converter=several)
    mask: Bool[Array, "height width"] | None = eqx.field(
        converter=lambda values: None if values is None else jnp.asarray(values, bool), default=None
    )
    deviation: Float[Array, "height width channels"] | None = eqx.field(
        converter=numbers, default=None, metadata=valid("positive", lambda x: x > 0)
    )
    intensity: AbstractIntensity = KnownIntensity()

    def __check_init__(self):
        size = self.camera.height, self.camera.width
        mask = getattr(self.mask, "shape", size)
        for name, pixels in (("picture", np.shape(self.picture)[:2] or size), ("mask", mask)):
            require(
                pixels == size,
                f"Observation.{name} has {' x '.join(map(str, pixels))} pixels, its camera "
                f"{size[0]} x {size[1]} (height, width)",
            )


@record
class Candidate(eqx.Module):
    """A picture that could be taken, with its name, camera and lights."""

    name: str = eqx.field(static=True)
    camera: Camera
    lights: tuple[AbstractLight, ...] = eqx.field(converter=several)
    intensity: AbstractIntensity = KnownIntensity()


def default_candidates(splats: Splats, camera: Camera, channels: int = 3) -> list[Candidate]:
    r"""Propose pictures that could be taken with a camera: parallel light from the front, left,
    right, above and behind, and a laser dot in the middle of the picture, as wide as a few splats.

    **Arguments:**

    - `splats`: the splats of the body, mm.
    - `camera`: the camera of all pictures.
    - `channels`: number of channels of the pictures.
    """
    right, down, forward = np.asarray(camera.rotation, float)
    directions = {
        "light from the front": forward,
        "light from the left": right + 0.3 * forward,
        "light from the right": -right + 0.3 * forward,
        "light from above": down + 0.3 * forward,
        "light from behind": -forward + 0.5 * down,
    }
    strength, eye = np.full(channels, np.pi), np.asarray(camera.position, float)
    squared_spacing = float(np.mean(splats.areas))
    # Aim at the splat nearest to the middle of the picture.
    to_splats = np.asarray(splats.centers, float) - eye
    spot = to_splats[np.argmax(to_splats @ forward / np.linalg.norm(to_splats, axis=1))]
    beam = GaussianBeam(eye, spot, strength * squared_spacing, 4 * squared_spacing)
    lights = {
        name: DirectionalLight(direction=direction, irradiance=strength)
        for name, direction in directions.items()
    } | {"a laser dot in the middle": beam}
    # Use the precision of the body instead of the default.
    lights = jax.tree.map(lambda leaf: leaf.astype(splats.centers.dtype), lights)
    return [Candidate(name, camera, light) for name, light in lights.items()]


class PicturedScene(eqx.Module):
    """The splats of a picture, its camera and its lights."""

    splats: Splats
    camera: Camera
    lights: tuple[AbstractLight, ...]

    def scene(self, material: Material) -> Scene:
        return Scene(self.splats, self.lights, material)


class AbstractLoss(eqx.Module):
    """The loss of a pixel, as a function of its residual in units of its deviation."""

    @abc.abstractmethod
    def root(self, residuals: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute the square root of the loss with the sign of the residual. Near zero it equals
        the residual.
        """


class SquaredLoss(AbstractLoss):
    """Squared loss, which is right for normal noise but sensitive to highlights outside the
    model.
    """

    def root(self, residuals: Float[Array, "..."]) -> Float[Array, "..."]:
        return residuals


@record
class HuberLoss(AbstractLoss):
    r"""A loss that is quadratic for small residuals and linear, `2 bend |r|`, for large ones.

        loss(r) = 2 b^2 (sqrt(1 + r^2 / b^2) - 1)

    **Attributes:**

    - `bend`: residual at the transition, in deviations; positive. Static.

    **Raises:** `ValueError` for a bend that is not positive.

    **Source:** Huber 1964; Charbonnier et al. 1997 (this smooth form).
    """

    bend: float = eqx.field(
        static=True, default=2.0, metadata=valid("positive (deviations)", lambda x: x > 0)
    )

    def root(self, residuals: Float[Array, "..."]) -> Float[Array, "..."]:
        return residuals * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (residuals / self.bend) ** 2)))


class AbstractBackground(eqx.Module):
    """The choice of the pixels that count by their coverage."""

    @abc.abstractmethod
    def counts(self, coverage: Float[Array, "height width"]) -> Float[Array, "height width"]:
        """Return 1 for pixels that count, 0 for others, as a constant for differentiation."""


class UnknownBackground(AbstractBackground):
    """An unknown background. Pixels that the body does not fill do not count, so silhouettes give
    no information.
    """

    def counts(self, coverage: Float[Array, "height width"]) -> Float[Array, "height width"]:
        return (coverage > _FILLED).astype(coverage.dtype)


class BlackBackground(AbstractBackground):
    """A black background. All pixels count, and the outline of the body gives most of the
    information about the pose of a camera.
    """

    def counts(self, coverage: Float[Array, "height width"]) -> Float[Array, "height width"]:
        return jnp.ones_like(coverage)


class Evidence(eqx.Module):
    """A picture in the precision of a computation.

    **Attributes:**

    - `picture`: radiance; 0 where it is unknown.
    - `deviation`: standard deviation of the noise.
    - `known`: pixels that may count.
    - `relative_noise`: deviation of a typical pixel divided by the brightness of the picture.
    """

    picture: Float[Array, "height width channels"]
    deviation: Float[Array, "height width channels"]
    known: Bool[Array, "height width"]
    relative_noise: Float[Array, ""]

    @classmethod
    def of(cls, observation: Observation, dtype: DTypeLike) -> "Evidence":
        picture = np.asarray(observation.picture, np.float64)
        mask = np.all(np.isfinite(picture), axis=-1)
        if observation.mask is not None:
            mask &= np.asarray(observation.mask)
        picture = np.where(mask[..., None], picture, 0.0)
        brightness = (float(np.sqrt(np.mean(picture[mask] ** 2))) if mask.any() else 0.0) or 1.0
        deviation = (
            np.full(picture.shape, _UNKNOWN_NOISE * brightness)
            if observation.deviation is None
            else np.asarray(observation.deviation, np.float64)
        )
        return cls(
            jnp.asarray(picture, dtype),
            jnp.asarray(deviation, dtype),
            jnp.asarray(mask),
            jnp.asarray(np.median(deviation) / brightness, dtype),
        )

    def counted(
        self, coverage: Float[Array, "height width"], background: AbstractBackground
    ) -> Float[Array, "height width"]:
        """Return 1 for pixels that count, and 0 for others."""
        return jnp.where(self.known, background.counts(coverage), 0.0)

    def residuals(
        self,
        picture: Float[Array, "height width channels"],
        counted: Float[Array, "height width"],
        loss: AbstractLoss,
    ) -> Float[Array, "height width channels"]:
        """Compute residuals whose squares are the losses. They are 0 where a pixel does not
        count.
        """
        residuals = (picture - self.picture) / self.deviation
        return loss.root(jnp.where(counted[..., None] > 0, residuals, 0.0))


def check_channels(observations: Sequence[Observation], channels: int, source: str) -> None:
    """Raise `ValueError` for a picture that does not have the number of channels of the source."""
    for i, observation in enumerate(observations):
        count = observation.picture.shape[2]
        require(
            count == channels,
            f"observations[{i}].picture has {count} channels, {source} has {channels}",
        )


def check_counted(counted: Sequence[Float[Array, "height width"]]) -> None:
    """Raise `ValueError` for an observation without a pixel that counts."""
    for i, pixels in enumerate(counted):
        require(
            np.any(pixels),
            f"no pixel of observations[{i}] counts, because none is covered by the splats, kept by "
            "the mask and finite; check camera, mask and NaN",
        )


def compared(
    pictures: Sequence[Float[Array, "_ _ channels"]],
    counted: Sequence[Float[Array, "_ _"]],
    evidence: Sequence[Evidence],
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return the pictures and their residuals, with NaN where pixels do not count."""
    rendered = tuple(
        np.where(np.asarray(pixels)[..., None] > 0, picture, np.nan)
        for picture, pixels in zip(pictures, counted, strict=True)
    )
    return rendered, tuple(
        picture - np.asarray(observed.picture)
        for picture, observed in zip(rendered, evidence, strict=True)
    )
