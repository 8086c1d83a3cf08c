"""Directions of photons: entry, refraction and scattering."""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._records import numbers, record, valid
from splatjax.scattering import moment_outside, reflectance

_SINE = [(-1) ** n * math.pi ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(8)]
_COSINE = [(-1) ** n * math.pi ** (2 * n) / math.factorial(2 * n) for n in range(9)]

Direction = tuple[Float[Array, " photons"], Float[Array, " photons"], Float[Array, " photons"]]


class AbstractIncidence(eqx.Module):
    """The directions of a narrow beam inside the surface. Powers are relative to the entering
    power.
    """

    @abc.abstractmethod
    def enter(
        self,
        xi_cosine: Float[Array, " photons"],
        xi_angle: Float[Array, " photons"],
        eta: Float[Array, " two"],
    ) -> tuple[Direction, Float[Array, " photons"]]:
        """Draw directions inside and weights, of mean 1, by uniform numbers and the indices outside
        and inside.
        """

    @abc.abstractmethod
    def reflected(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute the fraction of the arriving power that does not enter, by the index inside over
        outside.
        """


class NormalIncidence(AbstractIncidence):
    """Along the normal."""

    def enter(self, xi_cosine, xi_angle, eta):
        zero, one = jnp.zeros_like(xi_cosine), jnp.ones_like(xi_cosine)
        return (zero, zero, one), one

    def reflected(self, eta):
        return ((eta - 1) / (eta + 1)) ** 2


class DiffuseIncidence(AbstractIncidence):
    """Uniform radiance from all directions above: a white sky."""

    def enter(self, xi_cosine, xi_angle, eta):
        outside, inside = (jnp.broadcast_to(each, xi_cosine.shape) for each in eta)
        reflectance, cosine = fresnel(jnp.sqrt(xi_cosine), outside, inside)
        sine = jnp.sqrt(jnp.maximum(1 - cosine * cosine, 0.0))
        weight = (1 - reflectance) / jnp.broadcast_to(
            1 - self.reflected(eta[1:] / eta[:1])[0], xi_cosine.shape
        )
        x, y = on_circle(xi_angle)
        return (sine * x, sine * y, cosine), weight

    def reflected(self, eta):
        """Compute twice the integral of `mu F(mu)` over the cosine outside."""
        return jnp.where(eta < 1, 1 - (1 - moment_outside(eta)) * eta * eta, moment_outside(eta))


class AbstractPhaseFunction(eqx.Module):
    """A distribution of scattering angles, rotationally symmetric."""

    @abc.abstractmethod
    def anisotropy(self, layers: int, dtype) -> Float[Array, " layers"]:
        """Return the mean cosine `g` of each layer."""

    @abc.abstractmethod
    def scatter(
        self,
        direction: Direction,
        layer: Int[Array, " photons"],
        xi_cosine: Float[Array, " photons"],
        xi_angle: Float[Array, " photons"],
    ) -> Direction:
        """Draw new unit directions by two uniform random numbers in (0, 1) each."""


class Isotropic(AbstractPhaseFunction):
    """All directions are equally likely. By similarity it represents any phase function, with
    `sigma_s'` for `sigma_s`.
    """

    def anisotropy(self, layers, dtype):
        return jnp.zeros(layers, dtype)

    def scatter(self, direction, layer, xi_cosine, xi_angle):
        cosine = 2 * xi_cosine - 1
        sine = jnp.sqrt((1 - cosine) * (1 + cosine))
        x, y = on_circle(xi_angle)
        return sine * x, sine * y, cosine


@record
class HenyeyGreenstein(AbstractPhaseFunction):
    r"""Henyey and Greenstein's phase function.

    **Attributes:**

    - `g`: mean cosine, between -1 and 1; one for all layers, or one for each. A constant of every
      derivative.

    **Raises:** `ValueError` for a `g` out of this range.

    **Source:** Henyey and Greenstein 1941; the inverse of its distribution is written without a
    singularity at `g = 0`.
    """

    g: Float[Array, "*layers"] = eqx.field(
        converter=numbers,
        metadata=valid("between -1 and 1, both excluded", lambda x: abs(x) < 1),
    )

    def anisotropy(self, layers, dtype):
        if self.g.ndim and self.g.shape[0] != layers:
            raise ValueError(
                f"g must be one number, or one for each of the {layers} layers; got "
                f"{self.g.shape[0]}"
            )
        return jnp.broadcast_to(self.g.astype(dtype), (layers,))

    def scatter(self, direction, layer, xi_cosine, xi_angle):
        x, y, z = direction
        g = (
            jnp.broadcast_to(self.g.astype(x.dtype), x.shape)
            if self.g.ndim == 0
            else of_layer(self.g.astype(x.dtype), layer)
        )
        s = 2 * xi_cosine - 1
        cosine = (s + 0.5 * g * (3 + s * s) + g * g * (s + 0.5 * g * (s * s - 1))) / (
            (1 + g * s) * (1 + g * s)
        )
        sine = jnp.sqrt(jnp.maximum(1 - cosine * cosine, 0.0))
        along, across = (sine * each for each in on_circle(xi_angle))
        # An orthonormal basis about the direction (Duff et al. 2017).
        sign = jnp.where(z < 0, -jnp.ones_like(z), jnp.ones_like(z))
        a = -1 / (sign + z)
        b = x * y * a
        turned = (
            along * (1 + sign * x * x * a) + across * b + cosine * x,
            along * sign * b + across * (sign + y * y * a) + cosine * y,
            -along * sign * x - across * y + cosine * z,
        )
        scale = 1 / jnp.sqrt(turned[0] * turned[0] + turned[1] * turned[1] + turned[2] * turned[2])
        return turned[0] * scale, turned[1] * scale, turned[2] * scale


def fresnel(
    cosine: Float[Array, " photons"],
    eta_from: Float[Array, " photons"],
    eta_to: Float[Array, " photons"],
) -> tuple[Float[Array, " photons"], Float[Array, " photons"]]:
    """Compute the reflectance for unpolarized light that arrives at `cosine` (0 to 1), and the
    cosine of the transmitted light.

    Total internal reflection is 1, with a cosine of 0. Between equal indices there is exactly no
    reflection or refraction.
    """
    ratio = eta_from / eta_to
    squared = 1 - ratio * ratio * (1 - cosine * cosine)
    matched = eta_from == eta_to
    onward = jnp.where(matched, cosine, jnp.sqrt(jnp.maximum(squared, 0.0)))
    reflected = jnp.where(squared > 0, reflectance(cosine, onward, ratio), 1.0)
    return jnp.where(matched, 0.0, reflected), onward


def on_circle(
    xi: Float[Array, " photons"],
) -> tuple[Float[Array, " photons"], Float[Array, " photons"]]:
    """Compute a point of the unit circle for each number in (0, 1]; right to 1e-10.

    Series for a quarter of a turn, and the double angle: a library's sine is made for arguments of
    any size, and slow.
    """
    half_turns = xi - 0.5
    squared = half_turns * half_turns
    sine, cosine = (
        jnp.polyval(jnp.asarray(series[::-1], xi.dtype), squared) for series in (_SINE, _COSINE)
    )
    sine = sine * half_turns
    return (cosine - sine) * (cosine + sine), 2 * sine * cosine


def of_layer(
    table: Float[Array, "layers *channels"], layer: Int[Array, " photons"]
) -> Float[Array, "*channels photons"]:
    """Look up the entry of each photon's layer: by selections, which vectorize as a gather does
    not.
    """
    shape = (*table.shape[1:], *layer.shape)
    entry = jnp.broadcast_to(table[0][..., None], shape)
    for number in range(1, table.shape[0]):
        here = jnp.broadcast_to(layer == number, shape)
        entry = jnp.where(here, jnp.broadcast_to(table[number][..., None], shape), entry)
    return entry
