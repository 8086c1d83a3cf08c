"""Measured profiles."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax.gaussians import AbstractProfile

from ._medium import check_range


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

    radii: Float[Array, " samples"]
    values: Float[Array, "samples channels"]
    deviation: Float[Array, "samples channels"] | None
    total: Float[Array, " channels"] | None

    def __init__(
        self,
        radii: Float[Array, " samples"],
        values: Float[Array, " samples_"] | Float[Array, "samples_ channels"],
        deviation: Float[Array, " samples_"] | Float[Array, "samples_ channels"] | None = None,
        total: Float[Array, " channels"] | None = None,
    ):
        self.radii = radii
        self.values = values if values.ndim == 2 else values[:, None]
        self.deviation = (
            deviation if deviation is None or deviation.ndim == 2 else deviation[:, None]
        )
        self.total = total

    def __check_init__(self):
        samples, rows = self.radii.shape[0], self.values.shape[0]
        if samples < 2 or rows != samples:
            raise ValueError(
                f"a table needs at least two radii, and a row of values for each; got {samples} "
                f"and {rows} rows"
            )
        check_range("radii", self.radii, "at least 0 (mm)", lambda x: x >= 0)
        check_range("values", self.values, "numbers (1/mm^2)", lambda x: x == x)
        if self.deviation is not None:
            check_range("deviation", self.deviation, "at least 0 (1/mm^2)", lambda x: x >= 0)
        if not isinstance(self.radii, Tracer):
            radii = np.asarray(self.radii)
            for before, radius in pairwise(radii):
                if radius <= before:
                    raise ValueError(
                        f"radii must ascend, each once; got {radius} mm after {before} mm"
                    )

    @jit_unless_traced
    def __call__(self, r: Float[Array, "*radii_"]) -> Float[Array, "*radii_ channels"]:
        flat = r.reshape(-1)
        columns = [jnp.interp(flat, self.radii, column, right=0.0) for column in self.values.T]
        return jnp.stack(columns, axis=-1).reshape(*r.shape, -1)

    def without(self, profile: AbstractProfile) -> "Tabulated":
        """Give what is left when a profile is taken away: of R(r) what was scattered more than
        once, say.
        """
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
        """Give the total, or else `2 pi` times the integral of `r R(r)`, exactly that of the
        straight lines.
        """
        if self.total is not None:
            return self.total
        a, b = self.radii[:-1], self.radii[1:]
        lines = ((b - a) * (2 * a + b) / 6) @ self.values[:-1] + (
            (b - a) * (a + 2 * b) / 6
        ) @ self.values[1:]
        return 2 * jnp.pi * (0.5 * self.radii[0] ** 2 * self.values[0] + lines)

    @jit_unless_traced
    def length_scale(self) -> Float[Array, " channels"]:
        """Give the radius, mm, within which half of the integral of `r |R|` lies, by the table's
        own steps.
        """
        share = jnp.cumsum(
            jnp.abs(self.values)
            * (self.radii * jnp.diff(self.radii, append=self.radii[-1:]))[:, None],
            axis=0,
        )
        index = jnp.argmax(share >= 0.5 * share[-1][None], axis=0)
        return jnp.maximum(self.radii[index], self.radii[1])

    def known_radii(self) -> tuple[Float[Array, " samples"], Float[Array, " samples"]]:
        """Give the radii and the trapezoidal rule's weights; the first also stands for the disc
        within it.
        """
        steps = jnp.diff(self.radii)
        weights = 0.5 * (jnp.append(steps, 0.0) + jnp.insert(steps, 0, self.radii[0]))
        return self.radii, weights
