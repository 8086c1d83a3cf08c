"""Phase functions: into which direction a photon is scattered."""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from splatjax._records import check_values, numbers, record

from ._stack import of_layer

_SINE = [(-1) ** n * math.pi ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(8)]
_COSINE = [(-1) ** n * math.pi ** (2 * n) / math.factorial(2 * n) for n in range(9)]

Direction = tuple[Float[Array, " photons"], Float[Array, " photons"], Float[Array, " photons"]]


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
    """All directions are equally likely. By similarity it stands for any phase function, with
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

    **Source:** Henyey and Greenstein 1941; the inverse of its distribution is written so that
    nothing is singular at `g = 0`.
    """

    g: Float[Array, "*layers"] = eqx.field(converter=numbers)

    def __check_init__(self):
        check_values(
            "HenyeyGreenstein.g", self.g, "between -1 and 1, neither included", lambda x: abs(x) < 1
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


def on_circle(
    xi: Float[Array, " photons"],
) -> tuple[Float[Array, " photons"], Float[Array, " photons"]]:
    """Compute a point of the unit circle for each number in (0, 1]; right to 1e-10.

    Series for a quarter of a turn, and the double angle: a library's sine is made for arguments of
    any size, and slow.
    """
    half_turns = xi - 0.5
    squared = half_turns * half_turns
    sine, cosine = jnp.full_like(xi, _SINE[-1]), jnp.full_like(xi, _COSINE[-1])
    for coefficient in reversed(_SINE[:-1]):
        sine = sine * squared + coefficient
    for coefficient in reversed(_COSINE[:-1]):
        cosine = cosine * squared + coefficient
    sine = sine * half_turns
    return (cosine - sine) * (cosine + sine), 2 * sine * cosine
