"""Measured profiles."""

import equinox as eqx
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import check_values, numbers, record
from splatjax.gaussians import AbstractProfile


@record
class Tabulated(AbstractProfile):
    r"""A profile given at radii, linear in between: constant within the first radius, 0 beyond the
    last.

    Nothing is invented: what leaves beyond the last radius is not in the total unless that is
    given, and integrals of the profile, those of a fit as well, are sums over its radii.
    Differentiable in values, radii, `r`, and the total.

    **Attributes:**

    - `radii`: mm, at least two; they ascend from at least 0.
    - `values`: 1/mm^2, one row per radius. May be negative, as noise is.
    - `deviation`: standard errors of the values, of their shape, or None where they are unknown.
      Constants of every derivative.
    - `total`: the total reflectance of each channel, or None: then it is the integral of the lines.

    **Raises:** `ValueError` for radii that do not ascend, for values that are not finite, and for
    shapes that do not match.
    """

    radii: Float[Array, " samples"] = eqx.field(converter=numbers)
    values: Float[Array, "samples channels"] = eqx.field(converter=numbers)
    deviation: Float[Array, "samples channels"] | None = eqx.field(converter=numbers, default=None)
    total: Float[Array, " channels"] | None = eqx.field(converter=numbers, default=None)

    def __check_init__(self):
        check_values("Tabulated.radii", self.radii, "at least 0 (mm)", lambda x: x >= 0)
        check_values("Tabulated.values", self.values, "numbers (1/mm^2)", lambda x: x == x)
        check_values("Tabulated.deviation", self.deviation, "at least 0 (1/mm^2)", lambda x: x >= 0)
        if len(self.radii) < 2:
            raise ValueError(f"Tabulated.radii must be at least two; got {len(self.radii)}")
        check_values(
            "the steps of Tabulated.radii",
            jnp.diff(self.radii),
            "positive (mm): radii ascend, each once",
            lambda x: x > 0,
        )

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii_"]) -> Float[Array, "*radii_ channels"]:
        flat = r.reshape(-1)
        columns = [jnp.interp(flat, self.radii, column, right=0.0) for column in self.values.T]
        return jnp.stack(columns, axis=-1).reshape(*r.shape, -1)

    def without(self, profile: AbstractProfile) -> "Tabulated":
        """Subtract a profile: single scattering, for a fit of the rest."""
        if profile.singular and not isinstance(self.radii, Tracer) and self.radii[0] == 0:
            name = type(profile).__name__
            raise ValueError(
                f"{name} is infinite at r = 0, so it cannot be taken from a table that begins "
                "there; leave that row out"
            )
        total = None if self.total is None else self.total - profile.total_reflectance()
        return Tabulated(self.radii, self.values - profile(self.radii), self.deviation, total)

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        """Return the total, or compute `2 pi` times the integral of `r R(r)`, exactly that of the
        straight lines.
        """
        if self.total is not None:
            return self.total
        a, b = self.radii[:-1], self.radii[1:]
        starts = ((b - a) * (2 * a + b) / 6) @ self.values[:-1]
        ends = ((b - a) * (a + 2 * b) / 6) @ self.values[1:]
        return 2 * jnp.pi * (0.5 * self.radii[0] ** 2 * self.values[0] + starts + ends)

    @jit_unless_traced
    def length_scale(self) -> Float[Array, " channels"]:
        """Compute the radius, mm, within which half of the integral of `r |R|` lies, by the steps
        of the table.
        """
        rings = self.radii * jnp.diff(self.radii, append=self.radii[-1:])
        within = jnp.cumsum(jnp.abs(self.values) * rings[:, None], axis=0)
        index = jnp.argmax(within >= 0.5 * within[-1][None], axis=0)
        return jnp.maximum(self.radii[index], self.radii[1])

    def known_radii(self) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
        """Return the radii and the weights of the trapezoidal rule; the first radius also stands
        for the disc within it.
        """
        steps = jnp.diff(self.radii)
        weights = 0.5 * (jnp.append(steps, 0.0) + jnp.insert(steps, 0, self.radii[0]))
        return self.radii, weights
