"""Light transport in a half space by adding and doubling: directional albedo, angular law."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import Numbers, as_floats, check_values, is_traced, numbers, record, valid

from ._medium import Layer, Medium, reflectance
from ._quadrature import unit_legendre

ANGULAR_POWERS = 5  # number of powers in the fitted law
_HALVINGS = 24  # bisections in the search for a similarity parameter
_OUTSIDE, _BEYOND = 12, 8  # numbers of cosines: refracted, and beyond the critical angle
_MOMENTS = 12  # number of moments of the phase function
_LEAST_COSINE, _LEAST_ETA = 1e-4, 1.0003  # the index: for derivatives
_DEPTH, _DEEPEST = 0.05, 1e4  # of the first layer and of the thickest cover, mean free paths
_DOUBLINGS, _COVER_DOUBLINGS = 22, 8


@record
class AngularLaw(eqx.Module):
    r"""The dependence of multiply scattered light on the angles of entry and exit.

    A profile describes light that enters along the normal. Light that enters at the cosine `mu` is
    multiplied by `e(mu) = sum_k c_k mu^k`; by reciprocity, the radiance that leaves is proportional
    to `e(mu)` too. Surface reflection is not included.

    **Attributes:**

    - `coefficients`: `c_k`, the constant first; at most eight, with sum 1 in every channel.
      Differentiable.

    **Raises:** `ValueError` unless `e(1) = 1` and `e` is positive.
    """

    coefficients: Float[Array, "powers channels"] = eqx.field(converter=numbers)

    def __check_init__(self):
        powers = len(self.coefficients)
        if not 0 < powers <= 8:
            raise ValueError(f"AngularLaw.coefficients has {powers} powers; give 1 to 8")
        if is_traced(self.coefficients) or isinstance(self.coefficients, jax.ShapeDtypeStruct):
            return
        rows = np.vander(np.linspace(0, 1, 33), powers, increasing=True)
        values = rows @ np.asarray(self.coefficients)
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
        self,
        total: Float[Array, " channels"],
        matrix: Float[Array, "channels colors"] | Float[np.ndarray, "channels colors"],
    ) -> "AngularLaw":
        """Return the law of colors that are sums of the channels, weighted by total reflectance.
        Where a sum cancels to a tenth or less, use the law of the sum over all channels.
        """
        shares = total[:, None] * matrix
        is_left = jnp.sum(shares, axis=0) > 0.1 * jnp.sum(jnp.abs(shares), axis=0)
        shares = jnp.where(is_left[None], shares, total[:, None])
        return AngularLaw(self.coefficients @ shares / jnp.sum(shares, axis=0)[None])

    def __call__(self, mu: Float[Array, "*points"]) -> Float[Array, "*points channels"]:
        """Compute `e(mu)`; `mu` is the cosine outside, in [0, 1]."""
        powers = self.coefficients[::-1].reshape(-1, *[1] * mu.ndim, self.channels)
        return jnp.polyval(powers, mu[..., None], unroll=len(powers))


@record
class HalfSpace(eqx.Module):
    r"""The fraction of the light entering a half space that leaves again, by angle of entry. It is
    computed by light transport, without the diffusion approximation.

    The method is adding and doubling: the reflection and transmission of a layer over discrete
    cosines give those of two such layers, until they form a half space; the surface is added last.
    The phase function is Henyey-Greenstein; its forward peak beyond the twelfth moment counts as
    unscattered (delta-M).

    **Attributes:** (differentiable)

    - `medium`: its coefficients, [channels]; `eta` at least 1.
    - `g`: mean cosine of the phase function, [channels]; `sigma_s = sigma_s' / (1 - g)`.
    - `cover`: a layer of any thickness on the half space, with the same `eta` and `g`; or `None`.

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
        r"""Find the half space that has a given color, to convert materials of other renderers.
        This is the inverse of the method `color`.

        For OpenPBR, the arguments are `subsurface_color`, `subsurface_radius` times
        `subsurface_radius_scale` in mm, `specular_ior` and `subsurface_scatter_anisotropy`; for
        Blender's Principled BSDF with random walk, base color, radius times scale, IOR and
        anisotropy.

        **Arguments:** (one number for all channels, or one for each; differentiable except at a
        color of 1)

        - `color`: between 0.001 and 1.
        - `mean_free_path`: `1 / sigma_t`, mm, positive.
        - `eta`, `g`: as in the attributes.

        **Returns:** a half space whose `color()`, divided by the color of the same medium without
        absorption, equals the given color within 1e-5.

        **Raises:** `ValueError` for a number out of its range, and for unequal numbers of channels.
        """
        given, dtype = (color, mean_free_path, eta, g), as_floats(color).dtype
        arrays = [jnp.atleast_1d(as_floats(value, dtype)) for value in given]
        sizes = [array.size for array in arrays]
        if len({*sizes} - {1}) > 1:
            raise ValueError(f"color, mean_free_path, eta, g have sizes {sizes}; give equal sizes")
        color, mean_free_path, eta, g = jnp.broadcast_arrays(*arrays)
        check_values("color", color, "between 0.001 and 1", lambda x: (x >= 1e-3) & (x <= 1))
        check_values("mean_free_path", mean_free_path, "positive (mm)", lambda x: x > 0)
        check_values("eta", eta, "at least 1", lambda x: x >= 1)
        check_values("g", g, "between -0.95 and 0.95", lambda x: abs(x) <= 0.95)
        absorbed = jax.vmap(_similarity_of_color)(color, eta, g) ** 2  # 1 - albedo'
        # From the reduced to the unreduced albedo, without cancellation.
        per_mm = (1 - g) / (1 - g * absorbed) / mean_free_path
        return cls(Medium(per_mm * absorbed, per_mm * (1 - absorbed), eta), g)

    @staticmethod
    def cosines() -> Float[np.ndarray, " angles"]:
        """Return the cosines outside, ascending to 1, at which reflectances are computed."""
        return np.append(unit_legendre(_OUTSIDE)[0] ** 2, 1.0)

    @jit_unless_traced
    def directional_albedo(self) -> Float[Array, "angles channels"]:
        """Compute the fraction of the light entering at each of `cosines` that leaves again. The
        error is at most 3e-4, and energy is conserved by construction.
        """
        return self._by_channel(_directional_albedo).T

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the light entering along the normal that leaves."""
        return self.directional_albedo()[-1]

    @jit_unless_traced
    def color(self) -> Float[Array, " channels"]:
        """Compute the color of a flat surface under uniform light: the fraction of the entering
        light that leaves again. Surface reflection is not included.
        """
        return self._by_channel(_diffuse_albedo)

    def _by_channel(self, fraction: Callable[..., Array]) -> Float[Array, "channels *angles"]:
        """Compute a fraction of each channel from `1 - albedo'`, `eta`, `g` and the cover."""
        medium, cover = self.medium, self.cover
        layer = cover and (
            cover.medium.sigma_a / cover.medium.sigma_t_prime,
            cover.medium.sigma_t_prime
            * jnp.minimum(cover.thickness, _DEEPEST / cover.medium.sigma_t_prime),
        )
        inputs = medium.sigma_a / medium.sigma_t_prime, medium.eta, self.g, layer
        return jax.lax.map(lambda channel: fraction(*channel), inputs)  # batched compiles too long

    @jit_unless_traced
    def angular_law(self, separate: Float[Array, "angles channels"] | None = None) -> AngularLaw:
        """Fit the polynomial of `AngularLaw` to the directional albedo.

        **Arguments:**

        - `separate`: the part of the directional albedo at `cosines` that another law describes,
          such as `SingleScattering.directional_albedo`. It is subtracted.
        """
        fraction = self.directional_albedo()
        if separate is not None:
            fraction = fraction - separate
        # Least squares in mu^k - 1, weighted by the irradiance of uniform light.
        mu = self.cosines()[:, None]
        powers, weight = mu ** np.arange(1, ANGULAR_POWERS) - 1, np.sqrt(mu)
        inverse = np.linalg.pinv(weight * powers) * weight.T
        fitted = jnp.asarray(inverse, fraction.dtype) @ (fraction / fraction[-1:] - 1)
        return AngularLaw(jnp.concatenate([1 - jnp.sum(fitted, axis=0, keepdims=True), fitted]))


@jit_unless_traced
def _similarity_of_color(
    color: Float[Array, ""], eta: Float[Array, ""], g: Float[Array, ""]
) -> Float[Array, ""]:
    """Find the similarity parameter `sqrt(1 - albedo')`, in which the color is almost linear."""

    def excess(similarity, constants):
        color, eta, g, white = constants
        return _diffuse_albedo(similarity * similarity, eta, g) / white - color

    # Without absorption the color is 1 up to rounding, so a target just below 1 always has a root.
    below = 1 - 16 * jnp.finfo(color.dtype).eps
    constants = below * color, eta, g, _diffuse_albedo(jnp.zeros_like(color), eta, g)
    ends = {"lower": jnp.zeros_like(color), "upper": jnp.full_like(color, 1 - 1e-6)}
    solver, start = optx.Bisection(rtol=0, atol=0), 0.5 * ends["upper"]
    root = optx.root_find(excess, solver, start, constants, ends, max_steps=_HALVINGS, throw=False)
    return root.value


@jax.custom_jvp
def _directional_albedo(absorbed, eta, g, cover) -> Float[Array, " angles"]:
    """Compute the directional albedo from `1 - albedo'`, and that and the depth of a cover."""
    mu, weights, reflected = _directions(eta)
    half_space = _doubled(mu, weights, absorbed, g)[1]
    identity = jnp.eye(len(mu), dtype=mu.dtype)
    if cover is not None:
        # Adding the cover.
        transmitted, back = _doubled(mu, weights, cover[0], g, cover[1])
        between = jnp.linalg.solve(identity - back @ half_space, transmitted)
        half_space = back + transmitted @ half_space @ between
    # Adding the surface: by reciprocity, the fraction of light from one direction that leaves
    # equals the fraction of light from all directions that leaves in that direction.
    leaving = jnp.linalg.solve(
        identity - half_space * reflected[None], half_space @ (1 - reflected)[:, None]
    )
    return leaving[: _OUTSIDE + 1, 0]


@_directional_albedo.defjvp
def _directional_albedo_jvp(primals, tangents):
    absorbed, eta, *others = primals  # near eta = 1 no cosine resolves the critical angle
    resolved = absorbed, jnp.maximum(eta, _LEAST_ETA), *others
    _, tangent = jax.jvp(_directional_albedo.fun, resolved, tangents)
    return _directional_albedo(*primals), tangent


def _doubled(mu, weights, absorbed, g, optical_depth=None):
    """Compute transmission and reflection between all cosines, for a layer or a half space."""
    even, odd, albedo, lost, extinction = _redistribution(mu, weights, absorbed, g)
    doublings = _DOUBLINGS if optical_depth is None else _COVER_DOUBLINGS
    depth = _DEPTH if optical_depth is None else optical_depth * extinction / 2**doublings

    # One layer, whose internal light is the mean of the light at its two sides: the even part of
    # the light from both sides is attenuated by `with_even`, the odd part by `with_odd`.
    identity, half_depth = jnp.eye(len(mu), dtype=mu.dtype), 0.5 * depth / mu[:, None]
    losses = [half_depth * (identity - albedo * part) for part in (even, odd)]
    with_even, with_odd = (jnp.linalg.solve(identity + loss, identity - loss) for loss in losses)
    # Absorption of equal light from both sides, as a sum of positive terms.
    absorbed = jnp.linalg.solve(identity + losses[0], 2 * half_depth * lost)
    layer = 0.5 * (with_even + with_odd), 0.5 * (with_even - with_odd), absorbed

    # Doubling; energy is conserved to rounding.
    def double(_, layer):
        transmitted, reflected, absorbed = layer
        between = jnp.linalg.solve(
            identity - reflected @ reflected,
            jnp.hstack([transmitted, reflected @ transmitted, absorbed + reflected @ absorbed]),
        )
        count = len(identity)
        direct, back, below = jnp.split(between, [count, 2 * count], axis=1)
        transmitted, reflected = transmitted @ direct, reflected + transmitted @ back
        absorbed = absorbed + layer[0] @ below
        scale = (1 - absorbed) / jnp.sum(transmitted + reflected, axis=1, keepdims=True)
        return scale * transmitted, scale * reflected, absorbed

    transmitted, reflected, _ = jax.lax.fori_loop(0, doublings, double, layer)
    return transmitted, reflected


def _diffuse_albedo(absorbed, eta, g, cover=None) -> Float[Array, ""]:
    """Compute the fraction of the entering diffuse light that leaves again."""
    mu, weights, reflected = (values[: _OUTSIDE + 1] for values in _directions(eta))
    entering = mu * weights * (1 - reflected)
    return jnp.vdot(entering, _directional_albedo(absorbed, eta, g, cover)) / jnp.sum(entering)


def _directions(eta: Float[Array, ""]):
    """Compute the cosines inside, their weights, and the internal reflectance of the surface: first
    for the refracted `HalfSpace.cosines`, then beyond the critical angle.
    """
    nodes, node_weights = unit_legendre(_OUTSIDE)
    outside = jnp.asarray(HalfSpace.cosines(), eta.dtype)
    outside_weights = jnp.asarray(np.append(2 * nodes * node_weights, 0), eta.dtype)
    beyond, beyond_weights = (jnp.asarray(values, eta.dtype) for values in unit_legendre(_BEYOND))
    squared = eta * eta
    inside = jnp.sqrt(jnp.maximum(squared - 1 + outside * outside, _LEAST_COSINE**2)) / eta
    is_denser = squared > 1
    critical = jnp.where(is_denser, jnp.sqrt(jnp.where(is_denser, squared - 1, 1.0)) / eta, 0.0)
    mu = jnp.concatenate([inside, jnp.maximum(critical * beyond, _LEAST_COSINE)])
    weights = jnp.append(outside_weights * outside / (squared * inside), critical * beyond_weights)
    reflected = reflectance(inside, outside, jnp.full_like(inside, eta))
    return mu, weights / jnp.sum(weights), jnp.append(reflected, jnp.ones_like(beyond))


def _redistribution(mu, weights, absorbed, g):
    """Compute the even and odd parts of the phase function between all cosines, times weights, and
    the albedo, `1 - albedo` and the relative extinction, all with the peak unscattered.
    """
    polynomials = [jnp.ones_like(mu), mu]
    for n in range(1, _MOMENTS - 1):
        polynomials.append(((2 * n + 1) * mu * polynomials[n] - n * polynomials[n - 1]) / (n + 1))
    legendre = jnp.stack(polynomials)
    peak = g**_MOMENTS
    powers = jnp.concatenate([jnp.ones(1, mu.dtype), jnp.broadcast_to(g, (_MOMENTS - 1,))])
    moments = jnp.asarray(2 * np.arange(_MOMENTS) + 1, mu.dtype) * (jnp.cumprod(powers) - peak)
    by_moment = legendre * moments[:, None] / (1 - peak)
    even, odd = (
        by_moment[parity::2].T @ (legendre[parity::2] * weights[None]) for parity in (0, 1)
    )
    even = even / jnp.sum(even, axis=1, keepdims=True)  # conserve energy exactly
    scattered = (1 - absorbed) * (1 - peak) / (1 - g)
    extinction = scattered + absorbed
    return even, odd, scattered / extinction, absorbed / extinction, extinction
