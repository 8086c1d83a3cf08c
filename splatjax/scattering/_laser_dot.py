"""From a photograph of a laser dot to the profile it shows."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._tabulated import Tabulated

_CORE = 0.2
"""Share of the peak above which pixels tell where the center is."""

_LEAST_PIXELS = 12
"""Of a ring: with fewer, its scatter says little about the error of its mean."""


class LaserDot(eqx.Module):
    r"""What a photograph of a laser dot says about a flat material.

    **Attributes:**

    - `profile`: means over rings, 1/mm^2. What the camera saw: the material's profile convolved
      with the beam's.
    - `deviation`: standard errors of these means, 1/mm^2.
    - `center`: of the dot, pixels: x to the right and y down, from the upper left corner of the
      picture.
    """

    profile: Tabulated
    deviation: Float[Array, "samples channels"]
    center: Float[Array, "2"]


def measure_laser_dot(
    image: Float[np.ndarray, "height width channels"] | Float[Array, "height width channels"],
    mm_per_pixel: float,
    *,
    power: float | Float[np.ndarray, " channels"],
    center: tuple[float, float] | None = None,
    saturation: float | None = None,
    largest: float | None = None,
    step: float = 1.0,
) -> LaserDot:
    r"""Measure the profile that a photograph of a laser dot shows: means over rings, with their
    standard errors.

    The picture is taken from straight above, with a long lens, of a flat and homogeneous piece; a
    dark frame is subtracted, and specular reflection kept away from the camera. Exitance is `pi`
    times radiance.

    **Arguments:**

    - `image`: linear radiance.
    - `mm_per_pixel`: on the surface, positive.
    - `power`: that enters the material, positive, for all channels or for each: in W if the image
      is in W/(mm^2 sr). It scales the profile, and with it the total reflectance.
    - `center`: x and y in pixels; by default the centroid of the pixels above a fifth of the peak.
    - `saturation`: value from which on a pixel is not to be trusted; a ring with such a pixel is
      left out.
    - `largest`: radius of the last ring, mm; by default that of the largest circle inside the
      picture.
    - `step`: width of a ring, pixels, at least 1.

    **Returns:** a `LaserDot`. A ring's radius is the root mean square of its pixels', as the middle
    of a profile is flat; the scatter that the slope across it makes is taken out of its standard
    error. Rings of fewer than twelve pixels are joined to the next.

    **Raises:** `ValueError` for pixels that are not finite, a length or power that is not positive,
    a center outside of the picture, and if fewer than two rings are left.
    """
    pixels = np.asarray(image, np.float64)
    entering = np.broadcast_to(np.asarray(power, np.float64), pixels.shape[2:])
    if not np.all(np.isfinite(pixels)):
        y, x = np.argwhere(~np.isfinite(pixels).all(axis=2))[0]
        raise ValueError(f"image: pixel {x}, {y} is not finite; mend it or crop it away")
    for name, value, least in (
        ("mm_per_pixel", mm_per_pixel, 0),
        ("step", step, 1 - 1e-9),
        ("power", entering.min(), 0),
    ):
        if not value > least:
            raise ValueError(
                f"{name} must be {'at least 1 pixel' if name == 'step' else 'positive'}; got "
                f"{value:g}"
            )
    height, width = pixels.shape[:2]
    x0, y0 = _centroid(pixels) if center is None else center
    inside = min(x0, y0, width - x0, height - y0)
    if not inside > 0:
        raise ValueError(
            f"center {x0:g}, {y0:g} is outside of the picture of {width} x {height} pixels"
        )
    y, x = np.mgrid[:height, :width] + 0.5
    radius = np.hypot(x - x0, y - y0)
    last = inside if largest is None else min(largest / mm_per_pixel, inside)
    rings = _rings(radius[radius <= last], step)
    values = pixels[radius <= last] * (np.pi / entering)
    distrusted = (
        np.zeros(len(values), bool)
        if saturation is None
        else (pixels[radius <= last] >= saturation).any(axis=1)
    )

    squared, samples = radius[radius <= last] ** 2, []
    for ring in rings:
        if not distrusted[ring].any():
            mean, error = _mean(values[ring], squared[ring])
            samples.append((mm_per_pixel * np.sqrt(squared[ring].mean()), mean, error))
    if len(samples) < 2:
        raise ValueError(
            f"a profile needs at least two rings; {len(samples)} of {len(rings)} are inside and "
            "not saturated"
        )
    dtype = jnp.result_type(float)
    radii, means, errors = (
        jnp.asarray(np.stack(each), dtype) for each in zip(*samples, strict=True)
    )
    return LaserDot(Tabulated(radii, means), errors, jnp.asarray([x0, y0], dtype))


def _centroid(pixels: np.ndarray) -> tuple[float, float]:
    light = pixels.sum(axis=2)
    light = np.where(light > _CORE * light.max(), light, 0.0)
    y, x = np.mgrid[: light.shape[0], : light.shape[1]] + 0.5
    return float((light * x).sum() / light.sum()), float((light * y).sum() / light.sum())


def _rings(radius: np.ndarray, step: float) -> list[np.ndarray]:
    """Give the indices of the pixels of each ring, from the center; rings too small to have a
    scatter are joined.
    """
    order = np.argsort(radius, kind="stable")
    edges = np.searchsorted(radius[order], np.arange(step, radius.max() + step, step))
    rings, begin = [], 0
    for end in edges:
        if end - begin >= _LEAST_PIXELS:
            rings.append(order[begin:end])
            begin = end
    return rings


def _mean(values: np.ndarray, squared_radius: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Give the mean of each channel and its standard error, with the slope across the ring taken
    out.
    """
    mean, offset = values.mean(axis=0), squared_radius - squared_radius.mean()
    slope = offset @ (values - mean) / max(offset @ offset, np.finfo(float).tiny)
    left = values - mean - offset[:, None] * slope
    free = max(len(values) - 2, 1)
    return mean, np.sqrt((left * left).sum(axis=0) / free / len(values))
