"""Light transport in a half space by adding and doubling: the fraction of light that leaves, by the
angle of entry, and the law of angles of a material.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import Numbers, as_floats, check_values, numbers, record, valid

from ._doubling import diffuse_albedo, directional_albedo, outside_cosines
from ._medium import Layer, Medium

ANGULAR_POWERS = 5  # of the law that is fitted
_HALVINGS = 24  # of the interval in which a similarity parameter lies


@record
class AngularLaw(eqx.Module):
    r"""The dependence of diffused light on the angles of entry and exit.

    A profile describes light along the normal. Light that enters at the cosine `mu` is multiplied
    by `e(mu) = sum_k c_k mu^k`, and by reciprocity light leaves in proportion to `e(mu)`.
    Reflection at the surface is separate.

    **Attributes:**

    - `coefficients`: `c_k`, the constant first; at most eight, of sum 1 in every channel.
      Differentiable.

    **Raises:** `ValueError` unless `e(1) = 1` and `e` is positive.
    """

    coefficients: Float[Array, "powers channels"] = eqx.field(converter=numbers)

    def __check_init__(self):
        powers = len(self.coefficients)
        if not 0 < powers <= 8:
            raise ValueError(f"AngularLaw.coefficients has {powers} powers; give 1 to 8")
        if isinstance(self.coefficients, Tracer | jax.ShapeDtypeStruct):
            return
        values = np.vander(np.linspace(0, 1, 33), powers, increasing=True) @ np.asarray(
            self.coefficients
        )
        check_values(
            "AngularLaw.coefficients, summed",
            values[-1],
            "1: the factor of light along the normal",
            lambda x: abs(x - 1) < 1e-4,
        )
        check_values("AngularLaw from mu = 0 to 1", values, "positive", lambda x: x > 0)

    @property
    def channels(self) -> int:
        return self.coefficients.shape[1]

    def projected(
        self, total: Float[Array, " channels"], matrix: Float[Array, "channels colors"]
    ) -> "AngularLaw":
        """Return the law of sums over the channels, weighted by their total reflectance."""
        return AngularLaw((self.coefficients * total[None]) @ matrix / (total @ matrix)[None])

    def __call__(self, mu: Float[Array, "*points"]) -> Float[Array, "*points channels"]:
        """Compute `e(mu)`; `mu` is the cosine outside, in [0, 1]."""
        value = jnp.zeros((*mu.shape, self.channels), mu.dtype)
        for coefficient in self.coefficients[::-1]:
            value = value * mu[..., None] + jnp.broadcast_to(coefficient, value.shape)
        return value


@record
class HalfSpace(eqx.Module):
    r"""The reflection by a half space of the light that has entered it, by light transport.

    Adding and doubling: the reflection and transmission of a layer between discrete cosines give
    those of two such layers, and so on to a half space. The surface is added last; it reflects from
    inside, totally beyond the critical angle. The result does not depend on the division into
    layers, so the first layer may be thick. The phase function is Henyey and Greenstein's; the
    forward peak beyond its twelfth moment counts as unscattered (delta-M).

    **Attributes:** (differentiable)

    - `medium`: its coefficients, [channels]; `eta` at least 1.
    - `g`: mean cosine of the phase function, [channels]; `sigma_s = sigma_s' / (1 - g)`.
    - `cover`: a layer on the half space, thin or thick, or `None`; its index and mean cosine are
      those of the half space.

    **Source:** Van de Hulst 1980 (doubling); Prahl, Van Gemert and Welch 1993 (adding the
    surface); Wiscombe 1977 (delta-M).
    """

    medium: Medium
    g: Float[Array, " channels"] = eqx.field(
        converter=numbers,
        default=0.0,
        metadata=valid("between -0.95 and 0.95", lambda x: abs(x) <= 0.95),
    )
    cover: Layer | None = None

    def __check_init__(self):
        check_values("HalfSpace.medium.eta", self.medium.eta, "at least 1", lambda x: x >= 1)

    @classmethod
    def of_color(
        cls, color: Numbers, mean_free_path: Numbers, eta: Numbers = 1.4, g: Numbers = 0.0
    ) -> "HalfSpace":
        r"""Compute the half space of a color, for materials of other renderers: the inverse of the
        method `color`.

        For OpenPBR, `color` is `subsurface_color`, `mean_free_path` the product of
        `subsurface_radius` and `subsurface_radius_scale` in mm, `eta` is `specular_ior` and `g`
        `subsurface_scatter_anisotropy`. For Blender's Principled BSDF: base color, radius times
        scale, IOR and anisotropy of its random walk.

        **Arguments:** (numbers, or one for each channel; differentiable but at color 1)

        - `color`: between 0.001 and 1.
        - `mean_free_path`: `1 / sigma_t`, mm, positive.
        - `eta`, `g`: as in the attributes.

        **Returns:** a half space whose color, over that of white, is within 1e-4 of the given
        color; in single precision within 2e-2.

        **Raises:** `ValueError` for a number out of its range.
        """
        given = [jnp.atleast_1d(as_floats(each)) for each in (color, mean_free_path, eta, g)]
        color, mean_free_path, eta, g = jnp.broadcast_arrays(*given)
        check_values("color", color, "between 0.001 and 1", lambda x: (x >= 1e-3) & (x <= 1))
        check_values("mean_free_path", mean_free_path, "positive (mm)", lambda x: x > 0)
        absorbed = _similarity_of_color(color, eta, g) ** 2  # 1 - albedo'
        # From the reduced albedo to that of the unreduced medium, without cancellation.
        per_mm = (1 - g) / (1 - g * absorbed) / mean_free_path
        return cls(Medium(per_mm * absorbed, per_mm * (1 - absorbed), eta), g)

    @staticmethod
    def cosines() -> Float[np.ndarray, " angles"]:
        """Return the cosines outside, ascending to 1, at which reflectances are computed."""
        return outside_cosines()

    @jit_unless_traced
    def directional_albedo(self) -> Float[Array, "angles channels"]:
        """Compute the fraction of light, entering at each of `cosines`, that leaves, within 3e-4.
        Energy is conserved by construction.
        """
        medium = self.medium
        fraction = jax.vmap(directional_albedo)(
            medium.albedo_prime, medium.eta, self.g, self._cover()
        )
        return fraction.T

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the light entering along the normal that leaves."""
        return self.directional_albedo()[-1]

    @jit_unless_traced
    def color(self) -> Float[Array, " channels"]:
        """Compute the fraction that leaves of diffuse light that has entered: the color of a flat
        surface in a white furnace, without the reflection of its surface.
        """
        medium = self.medium
        return jax.vmap(diffuse_albedo)(medium.albedo_prime, medium.eta, self.g, self._cover())

    def _cover(self) -> "tuple[Float[Array, ' channels'], Float[Array, ' channels']] | None":
        """Return the reduced albedo of the cover and its reduced optical depth."""
        if self.cover is None:
            return None
        medium = self.cover.medium
        return medium.albedo_prime, medium.sigma_t_prime * self.cover.thickness

    @jit_unless_traced
    def angular_law(self, separate: Float[Array, "angles channels"] | None = None) -> AngularLaw:
        """Fit the polynomial of `AngularLaw` to the directional albedo.

        **Arguments:**

        - `separate`: the light that leaves by a separate law, at `cosines`, as
          `SingleScattering.directional_albedo` computes it.
        """
        fraction = self.directional_albedo()
        if separate is not None:
            fraction = fraction - separate
        mu, degree = self.cosines(), ANGULAR_POWERS - 1
        # Least squares in the powers of 1 - mu, weighted by the irradiance of uniform light.
        powers = (1 - mu[:, None]) ** np.arange(1, degree + 1)
        weight = np.sqrt(mu)[:, None]
        inverse = np.linalg.pinv(weight * powers) * weight.T
        fitted = jnp.asarray(inverse, fraction.dtype) @ (fraction / fraction[-1:] - 1)
        # From powers of 1 - mu to powers of mu.
        expansion = np.polynomial.polynomial.polyvander
        grid = np.linspace(0, 1, degree + 1)
        exchange = np.linalg.solve(
            expansion(grid, degree), (1 - grid[:, None]) ** np.arange(degree + 1)
        )
        one = jnp.ones_like(fitted[:1])
        return AngularLaw(jnp.asarray(exchange, fitted.dtype) @ jnp.concatenate([one, fitted]))


@jit_unless_traced
def _similarity_of_color(
    color: Float[Array, " channels"], eta: Float[Array, " channels"], g: Float[Array, " channels"]
) -> Float[Array, " channels"]:
    """Find the similarity parameter, the root of `1 - albedo'`, in which a color is almost
    linear.
    """
    solver = optx.Bisection(rtol=0, atol=0)

    def solve(color, eta, g):
        def excess(similarity, given):
            color, eta, g, white = given
            return diffuse_albedo(1 - similarity * similarity, eta, g) / white - color

        # White is 1 to rounding.
        white = diffuse_albedo(jnp.ones_like(color), eta, g)
        ends = {"lower": jnp.zeros_like(color), "upper": jnp.full_like(color, 1 - 1e-6)}
        given = color, eta, g, white
        found = optx.root_find(
            excess, solver, 0.5 * ends["upper"], given, ends, max_steps=_HALVINGS, throw=False
        )
        return found.value

    return jax.vmap(solve)(color, eta, g)
