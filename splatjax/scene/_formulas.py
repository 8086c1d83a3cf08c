"""Analytic environments: sums of spherical harmonics, and images of a studio, an overcast sky, and
a sky with the sun.
"""

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import Numbers, as_floats, numbers, record, require

from ._environment import (
    EnvironmentLight,
    PrefilteredEnvironment,
    even_directions,
    pixel_directions,
    prefilter,
)
from ._lights import AbstractExtendedLight, AbstractHighlight, AbstractLightSample, DistantStratum
from ._scene import rotation_towards

_ROWS = 64  # height of the map used for highlights
# Softboxes: azimuth and elevation in degrees, half width and half height divided by distance, and
# radiance.
_SOFTBOXES = (
    (-30.0, 35.0, 0.5, 0.6, (3.9, 3.65, 3.3)),
    (75.0, 5.0, 0.6, 0.9, (0.33, 0.38, 0.48)),
    (150.0, 25.0, 0.25, 0.9, (7.0, 7.4, 8.0)),
)
_ZENITH, _HORIZON, _SUN = (0.12, 0.22, 0.48), (0.45, 0.5, 0.55), (2.4, 2.2, 1.9)
_CONCENTRATION = 1500.0  # concentration of the sun's light, spread over about 3 degrees


@record
class HarmonicLight(AbstractExtendedLight):
    r"""Distant light from all directions, as a sum of spherical harmonics.

    The light is sampled by `count` evenly spread directions, whose visibility is valid for all
    coefficients (`splatjax.transfer`, `splatjax.relighting_basis`). A picture is linear in the
    coefficients, because the highlight and the layer `shadow` use the visibility of uniform light.

    **Attributes:**

    - `coefficients`: coefficients of the radiance in `spherical_harmonics`, in world space. The
      radiance may be negative in some directions, for example for a small sun with few harmonics.
      Differentiable.
    - `count`, `cast_shadows`: as of `EnvironmentLight`.

    **Raises:** `ValueError` unless the number of coefficients is a square: 1, 4, 9, 16, 25, ...
    """

    coefficients: Float[Array, "harmonics channels"] = eqx.field(converter=numbers)

    def __check_init__(self):
        harmonics = getattr(self.coefficients, "shape", (1,))[0]
        require(
            harmonics and math.isqrt(harmonics) ** 2 == harmonics,
            f"HarmonicLight.coefficients has {harmonics} rows; give (order + 1)^2: 1, 4, 9, 16 or "
            "25",
        )

    @classmethod
    def of(cls, environment: EnvironmentLight, order: int = 4, **settings) -> "HarmonicLight":
        """Project a rotated environment onto the harmonics up to an order. Differentiable in every
        field of the environment.

        **Arguments:** `settings` are `count` and `cast_shadows`.
        """
        radiance = environment.radiance()
        directions, solid_angles = pixel_directions(len(radiance), radiance.dtype)
        harmonics = spherical_harmonics(directions @ environment.to_world().T, order)
        return cls(jnp.einsum("hwb,hwc,hw->bc", harmonics, radiance, solid_angles), **settings)

    def with_channels(self, channels: int) -> "HarmonicLight":
        harmonics, given = self.coefficients.shape
        if given != 1:
            return self
        repeated = jnp.broadcast_to(self.coefficients, (harmonics, channels))
        return dataclasses.replace(self, coefficients=repeated)

    def radiance(self, directions: Float[Array, "*points 3"]) -> Float[Array, "*points channels"]:
        """Compute the radiance from world directions, which are unit vectors."""
        order = math.isqrt(len(self.coefficients)) - 1
        return spherical_harmonics(directions, order) @ self.coefficients

    @jit_unless_traced
    def stacked_samples(self) -> AbstractLightSample:
        directions = jnp.asarray(even_directions(self.count), self.coefficients.dtype)
        irradiance = 4 * jnp.pi / self.count * self.radiance(directions)
        return jax.vmap(eqx.Partial(HarmonicStratum, cast_shadows=self.cast_shadows))(
            -directions, irradiance
        )

    def highlight(self) -> AbstractHighlight:
        dtype = self.coefficients.dtype
        image = self.radiance(pixel_directions(_ROWS, dtype)[0])
        return PrefilteredEnvironment(prefilter(image), jnp.eye(3, dtype=dtype))


class HarmonicStratum(DistantStratum):
    """A direction of a `HarmonicLight`, with radiance of either sign. All directions have the same
    weight.
    """

    def weight(self, irradiance: Float[Array, "*points channels"]) -> Float[Array, "*points"]:
        return jnp.ones_like(irradiance[..., 0])


def spherical_harmonics(
    directions: Float[Array, "*points 3"], order: int
) -> Float[Array, "*points harmonics"]:
    r"""Evaluate the real spherical harmonics up to an order.

    The harmonics are orthonormal over the sphere; the index of `Y_lm` is `l (l + 1) + m`. The pole
    is +z, and the first band is `sqrt(3 / (4 pi)) (y, z, x)`.

    **Arguments:**

    - `directions`: unit vectors. Differentiable.

    **Returns:** `(order + 1)^2` values.

    **Source:** Sloan 2008, "Stupid Spherical Harmonics (SH) Tricks", without the Condon-Shortley
    phase.
    """
    x, y, z = jnp.unstack(directions, axis=-1)
    rows: list = [None] * (order + 1) ** 2
    cosine, sine, start = jnp.ones_like(x), jnp.zeros_like(x), math.sqrt(0.25 / math.pi)
    for m in range(order + 1):
        before, legendre = jnp.zeros_like(x), jnp.full_like(x, start)
        for band in range(m, order + 1):
            if band > m:
                back = math.sqrt(((band - 1) ** 2 - m * m) / (4 * (band - 1) ** 2 - 1))
                scale = math.sqrt((4 * band * band - 1) / (band * band - m * m))
                before, legendre = legendre, scale * (z * legendre - back * before)
            middle = band * (band + 1)
            rows[middle - m] = legendre * sine
            rows[middle + m] = legendre * cosine
        # sqrt(2) for both signs of m
        start *= math.sqrt((2 * m + 3) / (2 * m + 2)) * (math.sqrt(2) if m == 0 else 1)
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
    return jnp.stack(rows, axis=-1)


@jit_unless_traced
def studio(height: int = 64) -> Float[Array, "height width 3"]:
    """Make a dark studio with a large softbox in front towards -x, a weak one towards +x, and a
    strip behind.

    **Arguments:**

    - `height`: height of the image, which is twice as wide.

    **Returns:** radiance. The irradiance on a surface that faces the large softbox is about pi.
    """
    directions, image = pixel_directions(height)[0], jnp.full(3, 0.04)[None, None]
    for azimuth, elevation, half_width, half_height, radiance in _SOFTBOXES:
        axes = rotation_towards(_towards(azimuth, elevation), jnp.asarray([0.0, 1.0, 0.0]))
        x, y, along = (jnp.tensordot(directions, axis, 1) for axis in axes)
        edge = jnp.maximum(jnp.abs(x) / half_width, jnp.abs(y) / half_height)
        shown = jax.nn.sigmoid(20 * (1 - edge / jnp.maximum(along, 1e-3)))
        image = image + shown[..., None] * jnp.asarray(radiance)[None, None]
    return image


@jit_unless_traced
def overcast_sky(height: int = 64) -> Float[Array, "height width 3"]:
    """Make the CIE overcast sky, `L = L_zenith (1 + 2 sin(elevation)) / 3`, over a ground with
    albedo 0.2.

    **Returns:** radiance. The irradiance on a horizontal surface is pi.

    **Source:** Moon and Spencer 1942, "Illumination from a non-uniform sky".
    """
    sine = pixel_directions(height)[0][..., 1:2]
    return jnp.tile(jnp.where(sine > 0, 3 / 7 * (1 + 2 * sine), 0.2), 3)


def sun_and_sky(
    elevation: Numbers = 35.0, azimuth: Numbers = -40.0, height: int = 128
) -> Float[Array, "height width 3"]:
    """Make a blue sky, paler at the horizon and around the sun, over a gray ground.

    **Arguments:**

    - `elevation`, `azimuth`: direction of the sun, degrees; azimuth 0 is +z and 90 is +x. A sun
      below the horizon emits no light. Differentiable.

    **Returns:** radiance. The sun's irradiance on a surface that faces it is about 2.2.
    """
    directions, solid_angles = pixel_directions(height)
    zenith, horizon, sun = (jnp.asarray(rgb)[None, None] for rgb in (_ZENITH, _HORIZON, _SUN))
    to_sun = jnp.tensordot(directions, _towards(azimuth, elevation), 1)[..., None] - 1
    rise = jnp.sqrt(jnp.maximum(directions[..., 1:2], 1e-4))
    sky = horizon + (zenith - horizon) * rise + 0.5 * horizon * jnp.exp(6 * to_sun)
    nearest = jax.lax.stop_gradient(jnp.max(to_sun))  # cancels in the normalized disk
    disk = jnp.exp(_CONCENTRATION * (to_sun - nearest))
    disk = disk / jnp.sum(disk * solid_angles[..., None])
    disk = jnp.where(as_floats(elevation) > 0, disk, 0.0)
    return jnp.where(directions[..., 1:2] > 0, sky, 0.12) + disk * sun


def _towards(azimuth: Numbers, elevation: Numbers) -> Float[Array, "3"]:
    """Compute the unit vector towards an azimuth and elevation in degrees."""
    turn, rise = (jnp.deg2rad(as_floats(degrees)) for degrees in (azimuth, elevation))
    across = jnp.cos(rise)
    return jnp.stack([jnp.sin(turn) * across, jnp.sin(rise), jnp.cos(turn) * across])
