"""Light transport in a half space by adding and doubling: how much light leaves, by the angle under
which it entered; and the law of angles that this gives a material.
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

from ._fresnel import reflectance
from ._medium import Medium
from ._quadrature import unit_legendre

_OUTSIDE, _BEYOND = 12, 8  # cosines: refracted, and beyond the critical angle
ANGULAR_POWERS = 5  # of the law that is fitted
_MOMENTS = 12  # of the phase function
_LEAST_COSINE = 1e-4
_DEPTH = 0.05  # of the first layer, in mean free paths
_DOUBLINGS = 18
_HALVINGS = 24  # of the interval in which a similarity parameter lies


@record
class AngularLaw(eqx.Module):
    r"""How diffused light depends on the angles under which it enters and leaves.

    A profile is that of light along the normal. Light that enters under the cosine `mu` is
    multiplied by `e(mu) = sum_k c_k mu^k`, and by reciprocity light leaves in proportion to
    `e(mu)`, besides what the surface reflects.

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

    def __call__(self, mu: Float[Array, "*points"]) -> Float[Array, "*points channels"]:
        """Compute `e(mu)`; `mu` is the cosine outside, in [0, 1]."""
        value = jnp.zeros((*mu.shape, self.channels), mu.dtype)
        for coefficient in self.coefficients[::-1]:
            value = value * mu[..., None] + jnp.broadcast_to(coefficient, value.shape)
        return value


@record
class HalfSpace(eqx.Module):
    r"""How a half space reflects the light that has entered it, by light transport.

    Adding and doubling: the reflection and transmission of a layer between discrete cosines give
    those of two such layers, and so on to a half space; then the surface is added, which reflects
    from inside, totally beyond the critical angle. The half space is the same whatever layers it
    is cut into, so the first one may be thick. The phase function is Henyey and Greenstein's, with
    the forward peak beyond its twelfth moment taken as unscattered (delta-M).

    **Attributes:** (differentiable)

    - `medium`: its coefficients, [channels]; `eta` at least 1.
    - `g`: mean cosine of the phase function, [channels]; `sigma_s = sigma_s' / (1 - g)`.

    **Source:** Van de Hulst 1980 (doubling); Prahl, Van Gemert and Welch 1993 (adding the
    surface); Wiscombe 1977 (delta-M).
    """

    medium: Medium
    g: Float[Array, " channels"] = eqx.field(
        converter=numbers,
        default=0.0,
        metadata=valid("between -0.95 and 0.95", lambda x: abs(x) <= 0.95),
    )

    def __check_init__(self):
        check_values("HalfSpace.medium.eta", self.medium.eta, "at least 1", lambda x: x >= 1)

    @classmethod
    def of_color(
        cls, color: Numbers, mean_free_path: Numbers, eta: Numbers = 1.4, g: Numbers = 0.0
    ) -> "HalfSpace":
        r"""Find the half space of a color, for materials of other renderers: the inverse of the
        method `color`.

        For OpenPBR, `color` is `subsurface_color`, `mean_free_path` the product of
        `subsurface_radius` and `subsurface_radius_scale` in mm, `eta` is `specular_ior` and `g`
        `subsurface_scatter_anisotropy`. For Blender's Principled BSDF: base color, radius times
        scale, IOR and anisotropy of its random walk.

        **Arguments:** (numbers, or one for each channel; differentiable but at color 1)

        - `color`: between 0.001 and 1.
        - `mean_free_path`: `1 / sigma_t`, mm, positive.
        - `eta`, `g`: as in the attributes.

        **Returns:** a half space whose color, over that of white, is within 1e-4 of what is given;
        in single precision within 2e-2.

        **Raises:** `ValueError` for a number out of its range.
        """
        given = [jnp.atleast_1d(as_floats(each)) for each in (color, mean_free_path, eta, g)]
        color, mean_free_path, eta, g = jnp.broadcast_arrays(*given)
        check_values("color", color, "between 0.001 and 1", lambda x: (x >= 1e-3) & (x <= 1))
        check_values("mean_free_path", mean_free_path, "positive (mm)", lambda x: x > 0)
        absorbed = _similarity_of_color(color, eta, g) ** 2  # 1 - albedo'
        # From the reduced albedo to that of the medium as it is, without a difference that rounds.
        per_mm = (1 - g) / (1 - g * absorbed) / mean_free_path
        return cls(Medium(per_mm * absorbed, per_mm * (1 - absorbed), eta), g)

    @staticmethod
    def cosines() -> Float[np.ndarray, " angles"]:
        """Return the cosines outside, ascending to 1, at which reflectances are computed."""
        return np.append(unit_legendre(_OUTSIDE)[0] ** 2, 1.0)

    @jit_unless_traced
    def directional_albedo(self) -> Float[Array, "angles channels"]:
        """Compute the fraction of the light entering under each of `cosines` that leaves, within
        3e-4; in single precision within 6e-3 where nothing is absorbed.
        """
        medium = self.medium
        fraction = jax.vmap(_directional_albedo)(medium.albedo_prime, medium.eta, self.g)
        return fraction.T

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the light entering along the normal that leaves."""
        return self.directional_albedo()[-1]

    @jit_unless_traced
    def color(self) -> Float[Array, " channels"]:
        """Compute the fraction of evenly diffuse light that leaves, of what has entered: what a
        flat piece sends back in a white furnace, besides the reflection of its surface.
        """
        medium = self.medium
        return jax.vmap(_color)(medium.albedo_prime, medium.eta, self.g)

    @jit_unless_traced
    def angular_law(self, separate: Float[Array, "angles channels"] | None = None) -> AngularLaw:
        """Fit the polynomial of `AngularLaw` to the directional albedo.

        **Arguments:**

        - `separate`: what leaves under a law of its own, at `cosines`, as
          `SingleScattering.directional_albedo` computes it.
        """
        fraction = self.directional_albedo()
        if separate is not None:
            fraction = fraction - separate
        mu, degree = self.cosines(), ANGULAR_POWERS - 1
        # Least squares in the powers of 1 - mu, weighted as light falls on the surface.
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


def _directional_albedo(
    albedo_prime: Float[Array, ""], eta: Float[Array, ""], g: Float[Array, ""]
) -> Float[Array, " angles"]:
    mu, weights, reflected = _directions(eta)
    scattering, albedo = _redistribution(mu, weights, albedo_prime, g)
    even, odd = scattering

    # One layer, with the mean of its two sides in the place of the light within: what enters from
    # both sides alike is attenuated by `with_even`, the difference by `with_odd`.
    identity, half_depth = jnp.eye(len(mu), dtype=mu.dtype), 0.5 * _DEPTH / mu[:, None]
    with_even, with_odd = (
        jnp.linalg.solve(identity + loss, identity - loss)
        for loss in (
            half_depth * (identity - albedo * even),
            half_depth * (identity - albedo * odd),
        )
    )
    layer = 0.5 * (with_even + with_odd), 0.5 * (with_even - with_odd)

    # Doubling.
    def double(_, layer):
        transmitted, reflected = layer
        between = jnp.linalg.solve(
            identity - reflected @ reflected,
            jnp.concatenate([transmitted, reflected @ transmitted], axis=1),
        )
        direct, back = jnp.split(between, 2, axis=1)
        return transmitted @ direct, reflected + transmitted @ back

    _, half_space = jax.lax.fori_loop(0, _DOUBLINGS, double, layer)

    # Adding the surface: by reciprocity, what leaves of light from one direction is what leaves in
    # that direction of light from all.
    leaving = jnp.linalg.solve(
        identity - half_space * reflected[None], half_space @ (1 - reflected)[:, None]
    )
    return leaving[: _OUTSIDE + 1, 0]


def _color(
    albedo_prime: Float[Array, ""], eta: Float[Array, ""], g: Float[Array, ""]
) -> Float[Array, ""]:
    mu, weights, reflected = (each[: _OUTSIDE + 1] for each in _directions(eta))
    entering = mu * weights * (1 - reflected)
    return jnp.vdot(entering, _directional_albedo(albedo_prime, eta, g)) / jnp.sum(entering)


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
            return _color(1 - similarity * similarity, eta, g) / white - color

        # White is 1 but for rounding.
        white = _color(jnp.ones_like(color), eta, g)
        ends = {"lower": jnp.zeros_like(color), "upper": jnp.full_like(color, 1 - 1e-6)}
        given = color, eta, g, white
        found = optx.root_find(
            excess, solver, 0.5 * ends["upper"], given, ends, max_steps=_HALVINGS, throw=False
        )
        return found.value

    return jax.vmap(solve)(color, eta, g)


def _directions(eta: Float[Array, ""]):
    """Return cosines inside, their weights, and the reflectance of the surface met from inside:
    refracted ones, of `HalfSpace.cosines`, and those beyond the critical angle.
    """
    nodes, node_weights = unit_legendre(_OUTSIDE)
    outside = jnp.asarray(HalfSpace.cosines(), eta.dtype)
    outside_weights = jnp.asarray(np.append(2 * nodes * node_weights, 0), eta.dtype)
    beyond, beyond_weights = (jnp.asarray(each, eta.dtype) for each in unit_legendre(_BEYOND))
    squared = eta * eta
    inside = jnp.sqrt(jnp.maximum(squared - 1 + outside * outside, _LEAST_COSINE**2)) / eta
    is_denser = squared > 1
    critical = jnp.where(is_denser, jnp.sqrt(jnp.where(is_denser, squared - 1, 1.0)) / eta, 0.0)
    mu = jnp.concatenate([inside, jnp.maximum(critical * beyond, _LEAST_COSINE)])
    weights = jnp.concatenate(
        [outside_weights * outside / (squared * inside), critical * beyond_weights]
    )
    reflected = jnp.concatenate(
        [reflectance(inside, outside, jnp.broadcast_to(eta, inside.shape)), jnp.ones_like(beyond)]
    )
    return mu, weights / jnp.sum(weights), reflected


def _redistribution(mu, weights, albedo_prime, g):
    """Return the phase function's even and odd moments, between all cosines and times their
    weights; and the albedo, the forward peak taken as unscattered.
    """
    polynomials = [jnp.ones_like(mu), mu]
    for n in range(1, _MOMENTS - 1):
        polynomials.append(((2 * n + 1) * mu * polynomials[n] - n * polynomials[n - 1]) / (n + 1))
    legendre = jnp.stack(polynomials)
    peak = g**_MOMENTS
    powers = jnp.concatenate([jnp.ones(1, mu.dtype), jnp.broadcast_to(g, (_MOMENTS - 1,))])
    moments = (
        jnp.asarray(2 * np.arange(_MOMENTS) + 1, mu.dtype)
        * (jnp.cumprod(powers) - peak)
        / (1 - peak)
    )
    by_moment = legendre * moments[:, None]
    even, odd = (
        by_moment[parity::2].T @ (legendre[parity::2] * weights[None]) for parity in (0, 1)
    )
    even = even / jnp.sum(even, axis=1, keepdims=True)  # nothing is lost to rounding
    scattered = albedo_prime * (1 - peak) / (1 - g)
    return (even, odd), scattered / (scattered + 1 - albedo_prime)
