"""Profiles of slabs and of stacks of layers, by adding their reflection and transmission in the
Hankel domain.
"""

import abc
from functools import reduce

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax._chunking import jit_unless_traced
from splatjax._records import numbers, record, several
from splatjax.gaussians import AbstractProfile

from ._medium import AbstractFresnel, ExactFresnel, Film, Layer, check_stack
from ._quadrature import inverse_hankel_transform, unit_interval


class Response(eqx.Module):
    """Reflectance and transmittance of layers from above and from below, in the Hankel domain."""

    reflectance_above: Float[Array, "*shape"]
    transmittance_down: Float[Array, "*shape"]
    reflectance_below: Float[Array, "*shape"]
    transmittance_up: Float[Array, "*shape"]

    def over(self, lower: "Response") -> "Response":
        """Add this layer on top of another: sum the geometric series of reflections between them.

        **Source:** Donner and Jensen 2005 (adding, after Kubelka).
        """
        between = 1 / (1 - self.reflectance_below * lower.reflectance_above)
        reflected_once = self.transmittance_down * lower.reflectance_above * self.transmittance_up
        returned_once = lower.transmittance_up * self.reflectance_below * lower.transmittance_down
        return Response(
            self.reflectance_above + reflected_once * between,
            self.transmittance_down * lower.transmittance_down * between,
            lower.reflectance_below + returned_once * between,
            lower.transmittance_up * self.transmittance_up * between,
        )


def film_response(film: Film, lit_by_beam: bool, shape: tuple[int, ...]) -> Response:
    """Compute the response of a film. `lit_by_beam` is true if no layer above scatters the incident
    light.
    """
    depth = jnp.broadcast_to(film.optical_depth, shape)
    diffuse = diffuse_transmittance(depth)
    none = jnp.zeros(shape, depth.dtype)
    return Response(none, jnp.exp(-depth) if lit_by_beam else diffuse, none, diffuse)


def diffuse_transmittance(optical_depth: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Compute `2 E3(t)`, the integral of `2 mu exp(-t / mu)` over the cosine. At t = 0 it is 1, and
    its derivative is -2.
    """
    mu, _, weights = (
        jnp.asarray(values, optical_depth.dtype).reshape(-1, *[1] * optical_depth.ndim)
        for values in unit_interval()
    )
    return jnp.sum(2 * weights * mu * jnp.exp(-optical_depth[None] / mu), axis=0)


def slab_response(
    layer: Layer,
    eta_above: Float[Array, " channels"],
    eta_below: Float[Array, " channels"],
    fresnel: AbstractFresnel,
    k: Float[Array, "*shape"],
) -> Response:
    r"""Compute the response of a slab: Donner and Jensen's multipole, with its infinite series in
    closed form.

    With `s^2 = sigma_tr^2 + k^2`, `l = 1 / sigma_t'`, extrapolated boundaries `z_a` above and `z_b`
    below, and `H = d + z_a + z_b`,

        R(k) = alpha' sinh(s (d - l + z_b)) cosh(s z_a) / sinh(s H),
        T(k) = alpha' sinh(s (l + z_a)) cosh(s z_b) / sinh(s H),

    and the same from below with z_a and z_b exchanged. A slab thinner than l gives NaN.

    **Arguments:**

    - `eta_above`, `eta_below`: indices of the neighbors relative to air.
    - `fresnel`: computes the diffuse Fresnel moments of both sides.
    - `k`: 1/mm, at least 0; the last axis holds the channels.

    **Source:** image positions: Donner and Jensen 2005; the sum is our own.
    """
    medium = layer.medium
    depth = 1 / medium.sigma_t_prime
    thickness = jnp.minimum(layer.thickness, _ENDLESS * depth)
    thickness = jnp.where(thickness >= (1 - 1e-6) * depth, thickness, jnp.nan)
    above, below = (
        2 / 3 * fresnel.boundary(medium.eta / eta) * depth for eta in (eta_above, eta_below)
    )
    lengths = depth, above, below, thickness - depth, thickness + above + below
    albedo, squared_sigma_tr, depth, above, below, beneath, height = (
        jnp.broadcast_to(values, k.shape)
        for values in (medium.albedo_prime, medium.squared_sigma_tr, *lengths)
    )
    u = squared_sigma_tr + k * k

    def part(wave, across, fall):
        return albedo * hyperbolic_ratio(u, wave, across, fall, height)

    return Response(
        part(beneath + below, above, depth),
        part(depth + above, below, beneath),
        part(beneath + above, below, depth),
        part(depth + below, above, beneath),
    )


_SMALL = 0.05**2  # bound of (s H)^2 below which the series is accurate to 1e-16
_ENDLESS = 1e12  # mean free paths that replace an infinite thickness


def hyperbolic_ratio(
    u: Float[Array, "..."],
    a: Float[Array, "..."],
    b: Float[Array, "..."],
    fall: Float[Array, "..."],
    height: Float[Array, "..."],
) -> Float[Array, "..."]:
    r"""Compute `sinh(s a) cosh(s b) / sinh(s height)` with `s = sqrt(u)`, where `height = a + b +
    fall` and nothing is negative.

    The function is even in s and hence smooth in u; a series about `u = 0` gives the right
    derivatives.
    """
    small = u * height * height < _SMALL
    # Near 0: sum the series of the logarithms of sinh(x) / x and cosh(x).
    v = jnp.where(small, u, 0.0)
    y = v * b * b
    log_cosh = y * (1 / 2 - y * (1 / 12 - y * (1 / 45 - y * (17 / 2520))))
    log_sinhs = _log_sinhc(v * a * a) - _log_sinhc(v * height * height)
    series = a / height * jnp.exp(log_sinhs + log_cosh)
    s = jnp.sqrt(jnp.where(small, 1 / (height * height), u))
    sinhs = jnp.exp(-s * fall) * jnp.expm1(-2 * s * a) / jnp.expm1(-2 * s * height)
    return jnp.where(small, series, 0.5 * (1 + jnp.exp(-2 * s * b)) * sinhs)


def _log_sinhc(y):
    """Compute `log(sinh(x) / x)` for small `y = x^2`."""
    return y * (1 / 6 - y * (1 / 180 - y * (1 / 2835 - y / 37800)))


# Least depth of a source, in mean free paths, that the quadrature resolves.
_SHALLOWEST = 1e-3


class AbstractSlabProfile(AbstractProfile):
    """A profile of slabs, with both a reflectance and a transmittance, computed as inverse Hankel
    transforms.

    **Attributes:** (by keyword)

    - `eta_above`, `eta_below`: indices of the neighbors relative to air, [channels].
    - `fresnel`: the diffuse Fresnel moments.
    """

    eta_above: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0, kw_only=True)
    eta_below: Float[Array, " channels"] = eqx.field(converter=numbers, default=1.0, kw_only=True)
    fresnel: AbstractFresnel = eqx.field(default=ExactFresnel(), kw_only=True)

    @property
    @abc.abstractmethod
    def stack(self) -> tuple[Layer | Film, ...]:
        """Return all layers, from the top."""

    def __check_init__(self):
        check_stack(self.stack)
        for layer in self._scattering():
            layer.check_diffusion()

    @property
    def top(self) -> Layer:
        """Return the uppermost layer that scatters."""
        return self._scattering()[0]

    def _scattering(self) -> list[Layer]:
        return [layer for layer in self.stack if isinstance(layer, Layer)]

    def response(self, k: Float[Array, "*frequencies channels"]) -> Response:
        """Compute reflectance and transmittance at spatial frequencies `k` (1/mm, at least 0)."""
        etas = [self.eta_above, *(layer.medium.eta for layer in self._scattering()), self.eta_below]
        responses, passed = [], 0
        for layer in self.stack:
            if isinstance(layer, Film):
                responses.append(film_response(layer, passed == 0, k.shape))
            else:
                responses.append(
                    slab_response(layer, etas[passed], etas[passed + 2], self.fresnel, k)
                )
                passed += 1
        return reduce(Response.over, responses)

    def decay_lengths(self) -> tuple[Float[Array, " channels"], Float[Array, " channels"]]:
        """Compute the lengths a (mm) such that reflectance and transmittance fall at least like
        `exp(-a k)`: the depths of the sources from the two sides.
        """
        depths = [1 / layer.medium.sigma_t_prime for layer in self._scattering()]
        # An infinite layer transmits nothing; any length is valid.
        beneath = [
            jnp.where(
                jnp.isfinite(layer.thickness),
                jnp.maximum(layer.thickness - depth, _SHALLOWEST * depth),
                depth,
            )
            for layer, depth in zip(self._scattering(), depths, strict=True)
        ]
        return reduce(jnp.minimum, depths), reduce(jnp.add, beneath)

    def length_scale(self) -> Float[Array, " channels"]:
        """Return the mean free path of the uppermost layer that scatters, mm."""
        return 1 / self.top.medium.sigma_t_prime

    @jit_unless_traced
    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return inverse_hankel_transform(
            lambda k: self.response(k).reflectance_above, r, self.decay_lengths()[0]
        )

    @jit_unless_traced
    def transmittance(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        """Compute the radiant exitance below per unit power entering above, at distance `r` (mm)
        from the axis; 1/mm^2.
        """
        return inverse_hankel_transform(
            lambda k: self.response(k).transmittance_down, r, self.decay_lengths()[1]
        )

    @jit_unless_traced
    def total_reflectance(self) -> Float[Array, " channels"]:
        return self.response(jnp.zeros_like(self.length_scale())).reflectance_above

    @jit_unless_traced
    def total_transmittance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the entering power that leaves below."""
        return self.response(jnp.zeros_like(self.length_scale())).transmittance_down


class Transmitted(AbstractProfile):
    """The profile of the light that leaves a slab on the far side."""

    slab: AbstractSlabProfile

    def evaluate(self, r: Float[Array, "*radii"]) -> Float[Array, "*radii channels"]:
        return self.slab.transmittance(r)

    def total_reflectance(self) -> Float[Array, " channels"]:
        """Compute the fraction of the entering power that leaves on the far side."""
        return self.slab.total_transmittance()

    def length_scale(self) -> Float[Array, " channels"]:
        """Return the mean free path or, if larger, the slab's depth below the last source, mm."""
        return jnp.maximum(self.slab.length_scale(), self.slab.decay_lengths()[1])


@record
class Multipole(AbstractSlabProfile):
    r"""The multipole of a slab: the infinite series of image sources at both sides, summed in
    closed form in the Hankel domain.

    For a slab many mean free paths thick it equals `Dipole`. Differentiable in every coefficient,
    in the thickness, and in `r`.

    **Attributes:**

    - `layer`: medium and thickness.
    - `eta_above`, `eta_below`, `fresnel`: as in `AbstractSlabProfile`.

    **Raises:** `ValueError` for a layer thinner than one mean free path `1 / sigma_t'` in any
    channel, because its sources would lie outside. For traced values there is no error, and the
    profile is NaN.

    **Source:** Donner and Jensen 2005, "Light diffusion in multi-layered translucent materials".
    """

    layer: Layer

    @property
    def stack(self) -> tuple[Layer | Film, ...]:
        return (self.layer,)


@record
class LayeredMultipole(AbstractSlabProfile):
    r"""The profile of a stack of layers, such as skin, or a glaze on stone.

        glazed = LayeredMultipole([Layer(glaze, 0.5), Layer(stone, jnp.inf)])  # from the top, mm
        glazed(jnp.linspace(0.5, 2, 3))  # [radii, channels], 1/mm^2

    Each layer is a multipole; the layers are combined by adding, in the Hankel domain. The
    interface between two scattering layers has the ratio of their indices; a film has no interface.
    Light enters from above as a narrow beam. Each slab has its own extrapolated boundaries, so
    dividing a slab into two layers of the same medium changes the result, by a few percent for a
    slab four mean free paths thick.

    Differentiable in every coefficient and thickness, and in `r`.

    **Attributes:**

    - `layers`: `Layer` and `Film` records, from the top; at least one is a `Layer`. Only the lowest
      may be infinite.
    - `eta_above`, `eta_below`, `fresnel`: as in `AbstractSlabProfile`.

    **Raises:** `ValueError` without a scattering layer, for unequal numbers of channels, for an
    infinite layer above another layer, and for a layer thinner than one mean free path `1 /
    sigma_t'` in any channel. For traced values there is no error, and the profile is NaN.

    **Source:** Donner and Jensen 2005, "Light diffusion in multi-layered translucent materials".
    """

    layers: tuple[Layer | Film, ...] = eqx.field(converter=several)

    @property
    def stack(self) -> tuple[Layer | Film, ...]:
        """Return all layers; adjacent films are joined, as no light is diffused between them."""
        joined: list[Layer | Film] = []
        for layer in self.layers:
            if joined and isinstance(layer, Film) and isinstance(joined[-1], Film):
                joined[-1] = Film(joined[-1].optical_depth + layer.optical_depth)
            else:
                joined.append(layer)
        return tuple(joined)
