"""An environment as a sum of spherical harmonics, in which a picture is linear."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._records import numbers, record

from ._environment import (
    EnvironmentLight,
    PrefilteredEnvironment,
    even_directions,
    pixel_directions,
    prefilter,
)
from ._lights import AbstractExtendedLight, AbstractHighlight, AbstractLightSample, DistantStratum

_ROWS = 64  # of the map that is mirrored


@record
class HarmonicLight(AbstractExtendedLight):
    r"""Distant light from all directions, as a sum of spherical harmonics.

    It is sampled by `count` even directions (`even_directions`), whose visibility is valid for all
    coefficients (`splatjax.transfer`, `splatjax.relighting_basis`). A picture is linear in the
    coefficients: its highlight and its layer `shadow` use the visibility of uniform light.

    **Attributes:**

    - `coefficients`: radiance, of `spherical_harmonics` in world space. The sum may be negative in
      some directions, for example for a small sun with few harmonics. Differentiable.
    - `count`, `cast_shadows`: static.

    **Raises:** `ValueError` for another number of coefficients than 1, 4, 9, 16, 25, ...
    """

    coefficients: Float[Array, "harmonics channels"] = eqx.field(converter=numbers)

    def __check_init__(self):
        harmonics = getattr(self.coefficients, "shape", (1,))[0]
        if math.isqrt(harmonics) ** 2 != harmonics or harmonics == 0:
            raise ValueError(
                f"HarmonicLight.coefficients has {harmonics} rows; give (order + 1)^2: 1, 4, 9, 16 "
                "or 25"
            )

    @classmethod
    def of(cls, environment: EnvironmentLight, order: int = 4, **settings) -> "HarmonicLight":
        """Project an environment, in its rotation, onto the harmonics up to an order.
        Differentiable in every field of the environment.

        **Arguments:** `settings` are `count` and `cast_shadows`.
        """
        radiance = environment.radiance()
        directions, solid_angles = pixel_directions(len(radiance), radiance.dtype)
        harmonics = spherical_harmonics(directions @ environment.to_world().T, order)
        weighted = radiance * solid_angles[..., None]
        return cls(jnp.einsum("hwb,hwc->bc", harmonics, weighted), **settings)

    @property
    def order(self) -> int:
        return math.isqrt(len(self.coefficients)) - 1

    def radiance(self, directions: Float[Array, "*points 3"]) -> Float[Array, "*points channels"]:
        """Compute the radiance from world directions, unit vectors."""
        return spherical_harmonics(directions, self.order) @ self.coefficients

    def stacked_samples(self) -> AbstractLightSample:
        directions = jnp.asarray(even_directions(self.count), self.coefficients.dtype)
        irradiance = 4 * jnp.pi / self.count * self.radiance(directions)

        def sample(direction, irradiance):
            return HarmonicStratum(
                direction=direction, irradiance=irradiance, cast_shadows=self.cast_shadows
            )

        return jax.vmap(sample)(-directions, irradiance)

    def highlight(self) -> AbstractHighlight:
        dtype = self.coefficients.dtype
        image = self.radiance(pixel_directions(_ROWS, dtype)[0])
        return PrefilteredEnvironment(prefilter(image), jnp.eye(3, dtype=dtype))


class HarmonicStratum(DistantStratum):
    """A direction of a `HarmonicLight`, of either sign; all have the same weight."""

    def weight(self, irradiance: Float[Array, "*points channels"]) -> Float[Array, "*points"]:
        return jnp.ones_like(irradiance[..., 0])


def spherical_harmonics(
    directions: Float[Array, "*points 3"], order: int
) -> Float[Array, "*points harmonics"]:
    r"""Evaluate the real spherical harmonics up to an order.

    They are orthonormal over the sphere; the index of `Y_lm` is `l (l + 1) + m`. The pole is +z,
    and the first band is `sqrt(3 / (4 pi)) (y, z, x)`.

    **Arguments:**

    - `directions`: unit. Differentiable.

    **Returns:** `(order + 1)^2` values.

    **Source:** Sloan 2008, "Stupid Spherical Harmonics (SH) Tricks", without the sign of Condon and
    Shortley.
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
