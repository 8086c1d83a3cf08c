"""Images for `EnvironmentLight` by formula: a studio, an overcast sky, a sky with the sun."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import Numbers, as_floats

from ._environment import pixel_directions

# Softboxes: azimuth and elevation in degrees, half of width and height over distance, radiance.
_SOFTBOXES = (
    (-30.0, 35.0, 0.5, 0.6, (3.9, 3.65, 3.3)),
    (75.0, 5.0, 0.6, 0.9, (0.33, 0.38, 0.48)),
    (150.0, 25.0, 0.25, 0.9, (7.0, 7.4, 8.0)),
)
_ZENITH, _HORIZON, _SUN = (0.12, 0.22, 0.48), (0.45, 0.5, 0.55), (2.4, 2.2, 1.9)
_CONCENTRATION = 1500.0  # of the sun, whose light is spread over some 3 degrees


@jit_unless_traced
def studio(height: int = 64) -> Float[Array, "height width 3"]:
    """Make a dark studio with a large softbox in front on the side of -x, a weak one on the side of
    +x, and a strip behind.

    **Arguments:**

    - `height`: of the image, which is twice as wide.

    **Returns:** radiance; the irradiance of a surface that faces the large softbox is about pi.
    """
    directions, image = pixel_directions(height)[0], jnp.full(3, 0.04)[None, None]
    for azimuth, elevation, half_width, half_height, radiance in _SOFTBOXES:
        axes = _frame(azimuth, elevation)
        x, y, along = (jnp.tensordot(directions, axis, 1) for axis in axes)
        edge = jnp.maximum(jnp.abs(x) / half_width, jnp.abs(y) / half_height)
        shown = jax.nn.sigmoid(20 * (1 - edge / jnp.maximum(along, 1e-3)))
        image = image + shown[..., None] * jnp.asarray(radiance)[None, None]
    return image


@jit_unless_traced
def overcast_sky(height: int = 64) -> Float[Array, "height width 3"]:
    """Make the overcast sky of the CIE, `L = L_zenith (1 + 2 sin(elevation)) / 3`, over a ground
    that reflects a fifth.

    **Returns:** radiance; the irradiance of a horizontal surface is pi.

    **Source:** Moon and Spencer 1942, "Illumination from a non-uniform sky".
    """
    sine = pixel_directions(height)[0][..., 1:2]
    return jnp.tile(jnp.where(sine > 0, 3 / 7 * (1 + 2 * sine), 0.2), 3)


def sun_and_sky(
    elevation: Numbers = 35.0, azimuth: Numbers = -40.0, height: int = 128
) -> Float[Array, "height width 3"]:
    """Make a blue sky, paler at the horizon and around the sun, over a gray ground.

    **Arguments:**

    - `elevation`, `azimuth`: of the sun, degrees; azimuth 0 is +z, 90 is +x. A sun below the
      horizon gives no light. Differentiable.

    **Returns:** radiance; a surface that faces the sun receives about 2.2 from it.
    """
    directions, solid_angles = pixel_directions(height)
    zenith, horizon, sun = (jnp.asarray(rgb)[None, None] for rgb in (_ZENITH, _HORIZON, _SUN))
    to_sun = jnp.tensordot(directions, _frame(azimuth, elevation)[2], 1)[..., None] - 1
    rise = jnp.sqrt(jnp.maximum(directions[..., 1:2], 1e-4))
    sky = horizon + (zenith - horizon) * rise + 0.5 * horizon * jnp.exp(6 * to_sun)
    disk = jnp.exp(_CONCENTRATION * (to_sun - jnp.max(to_sun)))
    disk = disk / jnp.sum(disk * solid_angles[..., None])
    disk = jnp.where(as_floats(elevation) > 0, disk, 0.0)
    return jnp.where(directions[..., 1:2] > 0, sky, 0.12) + disk * sun


def _frame(azimuth: Numbers, elevation: Numbers) -> Float[Array, "3 3"]:
    """Compute the directions along the horizon at a point of the sky, above it, and towards it."""
    turn, rise = (jnp.deg2rad(as_floats(degrees)) for degrees in (azimuth, elevation))
    (east, south), (high, across) = ((jnp.sin(a), jnp.cos(a)) for a in (turn, rise))
    right, up = [south, jnp.zeros_like(turn), -east], [-east * high, across, -south * high]
    return jnp.stack([*right, *up, east * across, high, south * across]).reshape(3, 3)
