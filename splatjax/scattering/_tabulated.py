"""Measured profiles: from tables, and from photographs of a laser dot."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import Numbers, check_values, numbers, record, valid
from splatjax.gaussians import AbstractProfile

# Pixels brighter than this fraction of the peak determine the center.
_CORE = 0.2

# Least number of pixels in a ring; fewer do not determine the error of the mean.
_LEAST_PIXELS = 12


@record
class Tabulated(AbstractProfile):
    r"""A profile given by a table: linear between its radii, constant below the first and 0 beyond
    the last.

    Light beyond the last radius counts only if `total` is given. Integrals, including those of a
    fit, are sums over the given radii. Differentiable in values, radii, `r`, and the total.

    **Attributes:**

    - `radii`: mm, at least two, ascending, not negative.
    - `values`: 1/mm^2, one row per radius. Noise may make them negative.
    - `deviation`: standard errors of the values, in the same shape, or None if unknown. Derivatives
      treat them as constants.
    - `total`: the total reflectance of each channel; None to integrate the table.

    **Raises:** `ValueError` for radii that do not ascend, for values that are not finite, and for
    shapes that do not match.
    """

    radii: Float[Array, " samples"] = eqx.field(
        converter=numbers, metadata=valid("at least 0 (mm)", lambda x: x >= 0)
    )
    values: Float[Array, "samples channels"] = eqx.field(
        converter=numbers, metadata=valid("numbers (1/mm^2)")
    )
    deviation: Float[Array, "samples channels"] | None = eqx.field(
        converter=numbers,
        default=None,
        metadata=valid("at least 0 (1/mm^2)", lambda x: x >= 0),
    )
    total: Float[Array, " channels"] | None = eqx.field(converter=numbers, default=None)

    def __check_init__(self):
        check_values(
            "the number of Tabulated.radii", len(self.radii), "at least 2", lambda x: x >= 2
        )
        check_values(
            "the steps of Tabulated.radii",
            jnp.diff(self.radii),
            "positive (mm), with strictly ascending radii",
            lambda x: x > 0,
        )

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii_"]) -> Float[Array, "*radii_ channels"]:
        flat = r.reshape(-1)
        columns = [jnp.interp(flat, self.radii, column, right=0.0) for column in self.values.T]
        return jnp.stack(columns, axis=-1).reshape(*r.shape, -1)

    def without(self, profile: AbstractProfile) -> "Tabulated":
        """Subtract another profile, such as single scattering, to fit what remains."""
        if profile.singular:
            requirement = (
                f"above 0, because {type(profile).__name__} is infinite at r = 0; leave that "
                "row out"
            )
            check_values("Tabulated.radii", self.radii, requirement, lambda x: x > 0)
        total = None if self.total is None else self.total - profile.total_reflectance()
        return Tabulated(self.radii, self.values - profile(self.radii), self.deviation, total)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        """Return `total` if it is given; otherwise compute `2 pi` times the integral of `r R(r)`,
        exactly for linear interpolation.
        """
        if self.total is not None:
            return self.total
        a, b = self.radii[:-1], self.radii[1:]
        starts = ((b - a) * (2 * a + b) / 6) @ self.values[:-1]
        ends = ((b - a) * (a + 2 * b) / 6) @ self.values[1:]
        return 2 * jnp.pi * (0.5 * self.radii[0] ** 2 * self.values[0] + starts + ends)

    @jit_unless_traced
    def length_scale(self) -> Float[Array, " channels"]:
        """Return the radius of the table, mm, within which half of the integral of `r |R|` lies."""
        rings = self.radii * jnp.diff(self.radii, append=self.radii[-1:])
        within = jnp.cumsum(jnp.abs(self.values) * rings[:, None], axis=0)
        index = jnp.argmax(within >= 0.5 * within[-1][None], axis=0)
        return jnp.maximum(self.radii[index], self.radii[1])

    def known_radii(self) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
        """Return the radii and the weights of the trapezoidal rule. The first weight includes the
        interval from 0 to the first radius.
        """
        steps = jnp.diff(self.radii)
        weights = 0.5 * (jnp.append(steps, 0.0) + jnp.insert(steps, 0, self.radii[0]))
        return self.radii, weights


class LaserDot(eqx.Module):
    r"""The measurement of a laser dot on a flat material.

    **Attributes:**

    - `profile`: means over rings and their standard errors, 1/mm^2: the profile of the material
      convolved with that of the beam.
    - `center`: center of the dot in pixels from the upper left corner of the picture: x to the
      right, y down.
    """

    profile: Tabulated
    center: Float[Array, "2"]


def measure_laser_dot(
    image: Float[np.ndarray, "height width *channels"] | Float[Array, "height width *channels"],
    mm_per_pixel: float,
    *,
    power: Numbers,
    center: tuple[float, float] | None = None,
    saturation: float | None = None,
    largest: float | None = None,
    step: float = 1.0,
) -> LaserDot:
    r"""Measure the profile in a photograph of a laser dot by averaging over rings.

    Photograph a flat and homogeneous sample from straight above with a long lens, without specular
    reflection, and subtract a dark frame. The exitance is taken as `pi` times the radiance.

    **Arguments:**

    - `image`: linear radiance, of several channels or gray.
    - `mm_per_pixel`: width of a pixel on the surface, mm, positive.
    - `power`: power that enters the material, positive, one number or one per channel; in W if the
      image is in W/(mm^2 sr). The profile and its total reflectance are inversely proportional to
      it.
    - `center`: x and y in pixels; by default the centroid of the pixels brighter than a fifth of
      the peak.
    - `saturation`: the value at which pixels saturate; rings with a saturated pixel are omitted.
    - `largest`: radius of the last ring, mm; by default that of the largest circle inside the
      picture.
    - `step`: width of a ring, pixels, at least 1.

    **Returns:** a `LaserDot`. The radius of a ring is the root mean square over its pixels, because
    a profile is flat at its center. The standard error excludes the variation due to the slope
    across the ring. Rings of fewer than twelve pixels are merged with the next.

    **Raises:** `ValueError` for pixels that are not finite or all black, for a length or power that
    is not positive, for a center outside the picture, and if fewer than two rings remain.
    """
    pixels = np.asarray(image, np.float64).reshape(*np.shape(image)[:2], -1)
    entering = np.broadcast_to(np.asarray(power, np.float64), pixels.shape[2:])
    check_values("image", pixels, "finite; crop such pixels", lambda x: x == x)
    check_values("mm_per_pixel", mm_per_pixel, "positive", lambda x: x > 0)
    check_values("power", entering, "positive", lambda x: x > 0)
    check_values("largest", largest, "positive (mm)", lambda x: x > 0)
    check_values("step", step, "at least 1 pixel", lambda x: x >= 1 - 1e-9)
    height, width = pixels.shape[:2]
    y, x = np.mgrid[:height, :width] + 0.5
    light = pixels.sum(axis=2)
    check_values("the brightest pixel of image", light.max(), "positive", lambda x: x > 0)
    core = np.where(light > _CORE * light.max(), light, 0.0)
    centroid = [float((core * coordinate).sum() / core.sum()) for coordinate in (x, y)]
    x0, y0 = centroid if center is None else center
    inside = min(x0, y0, width - x0, height - y0)
    if not inside > 0:
        raise ValueError(
            f"center {x0:g}, {y0:g} is outside of the picture of {width} x {height} pixels; "
            "give x and y in pixels"
        )
    radius = np.hypot(x - x0, y - y0)
    last = inside if largest is None else min(largest / mm_per_pixel, inside)
    within = radius <= last
    values, squared = pixels[within] * (np.pi / entering), radius[within] ** 2
    is_saturated = (pixels[within] >= (np.inf if saturation is None else saturation)).any(axis=1)
    rings = _rings(radius[within], step)
    samples = [
        (mm_per_pixel * np.sqrt(squared[ring].mean()), *_mean(values[ring], squared[ring]))
        for ring in rings
        if not is_saturated[ring].any()
    ]
    check_values(
        f"the rings, of {len(rings)}, that are not saturated",
        len(samples),
        "at least 2 for a profile",
        lambda x: x >= 2,
    )
    return LaserDot(
        Tabulated(*map(np.stack, zip(*samples, strict=True))),
        jnp.asarray([x0, y0], jnp.result_type(float)),
    )


def _rings(radius: np.ndarray, step: float) -> list[np.ndarray]:
    """Collect the indices of the pixels of each ring, from the center outwards, and merge small
    rings.
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
    """Compute the mean of each channel and its standard error, without the slope across the
    ring.
    """
    mean, offset = values.mean(axis=0), squared_radius - squared_radius.mean()
    slope = offset @ (values - mean) / max(offset @ offset, np.finfo(float).tiny)
    residual = values - mean - offset[:, None] * slope
    free = max(len(values) - 2, 1)
    return mean, np.sqrt((residual * residual).sum(axis=0) / free / len(values))
