"""One flight of many photons, to the next scattering event or the next interface, whichever comes
first; and their entry, refraction and scattering.
"""

import abc
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from splatjax._smooth import mean_decay
from splatjax.scattering import ExactFresnel, reflectance

_SINE = [(-1) ** n * math.pi ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(8)]
_COSINE = [(-1) ** n * math.pi ** (2 * n) / math.factorial(2 * n) for n in range(9)]

Direction = tuple[Float[Array, " photons"], Float[Array, " photons"], Float[Array, " photons"]]


class AbstractIncidence(eqx.Module):
    """The distribution of the directions of a narrow beam after it enters. Powers are relative to
    the entering power.
    """

    @abc.abstractmethod
    def enter(
        self,
        xi_cosine: Float[Array, " photons"],
        xi_angle: Float[Array, " photons"],
        eta: Float[Array, " two"],
    ) -> tuple[Direction, Float[Array, " photons"]]:
        """Draw directions inside, and weights with mean 1, from uniform random numbers and the
        indices outside and inside.
        """

    @abc.abstractmethod
    def reflected(self, eta: Float[Array, " channels"]) -> Float[Array, " channels"]:
        """Compute the fraction of the incident power that does not enter. `eta` is the index inside
        divided by the index outside.
        """


class NormalIncidence(AbstractIncidence):
    """Light along the normal."""

    def enter(self, xi_cosine, xi_angle, eta):
        zero, one = jnp.zeros_like(xi_cosine), jnp.ones_like(xi_cosine)
        return (zero, zero, one), one

    def reflected(self, eta):
        return ((eta - 1) / (eta + 1)) ** 2


class DiffuseIncidence(AbstractIncidence):
    """Uniform radiance from all directions above, a white sky."""

    def enter(self, xi_cosine, xi_angle, eta):
        outside, inside = (jnp.broadcast_to(index, xi_cosine.shape) for index in eta)
        reflectance, cosine = fresnel(jnp.sqrt(xi_cosine), outside, inside)
        sine = jnp.sqrt(jnp.maximum(1 - cosine * cosine, 0.0))
        weight = (1 - reflectance) / jnp.broadcast_to(
            1 - self.reflected(eta[1:] / eta[:1])[0], xi_cosine.shape
        )
        x, y = on_circle(xi_angle)
        return (sine * x, sine * y, cosine), weight

    def reflected(self, eta):
        """Compute twice the integral of `mu F(mu)` over the cosine outside."""
        return ExactFresnel().first_moment(1 / eta)


def fresnel(
    cosine: Float[Array, " photons"],
    eta_from: Float[Array, " photons"],
    eta_to: Float[Array, " photons"],
) -> tuple[Float[Array, " photons"], Float[Array, " photons"]]:
    """Compute the reflectance for unpolarized light incident at `cosine` (0 to 1), and the cosine
    of the transmitted light.

    Total internal reflection has reflectance 1 and cosine 0. Between equal indices there is exactly
    no reflection or refraction.
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
    """Compute a point of the unit circle for each number in (0, 1], with an error of 1e-10. It uses
    series for a quarter turn and the double-angle formula, because a library's sine accepts
    arguments of any size and is slow.
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
    """Look up the entry of each photon's layer, by selections because a gather does not
    vectorize.
    """
    shape = (*table.shape[1:], *layer.shape)
    entry = jnp.broadcast_to(table[0][..., None], shape)
    for number in range(1, table.shape[0]):
        is_in_layer = jnp.broadcast_to(layer == number, shape)
        entry = jnp.where(is_in_layer, jnp.broadcast_to(table[number][..., None], shape), entry)
    return entry


# States of a photon. An idle lane has no photon.
INSIDE, ABOVE, BELOW, IDLE = 0, 1, 2, 3


class LayeredMedia(eqx.Module):
    r"""Layers, including films, as arrays over channels, from the top.

    **Attributes:**

    - `sigma_a`, `sigma_s`: 1/mm; a film has `sigma_s = 0`, and `sigma_a` is its optical depth
      divided by its thickness.
    - `thickness`: mm.
    - `eta`: indices relative to air, including those of the neighbors above and below.
    - `g`: mean cosines of the phase function.
    - `first`: index of the uppermost scattering layer.

    In a walk, lengths are in scattering free paths of that layer, so that all channels have the
    same geometry.
    """

    sigma_a: Float[Array, "layers channels"]
    sigma_s: Float[Array, "layers channels"]
    thickness: Float[Array, "layers channels"]
    eta: Float[Array, "layers_and_neighbors channels"]
    g: Float[Array, " layers"]
    first: int = eqx.field(static=True)


class Photons(eqx.Module):
    """Positions of photons, in free paths; `depth` is measured from the top of the layer. Not
    differentiated.
    """

    x: Float[Array, " photons"]
    y: Float[Array, " photons"]
    depth: Float[Array, " photons"]
    direction: Direction
    to_scatter: Float[Array, " photons"]
    layer: Int[Array, " photons"]
    place: Int[Array, " photons"]
    flights: Int[Array, " photons"]


class PathWeights(eqx.Module):
    r"""Carried and absorbed weights of photons in each channel of the walk.

    **Attributes:**

    - `carried`: the share of the entering power that a photon carries; its mean is 1 at the start.
    - `absorbed`: the share that each layer has absorbed.

    Derivatives of both have a leading axis.
    """

    carried: Float[Array, "*slopes channels photons"]
    absorbed: Float[Array, "*slopes layers channels photons"]


def scatter(
    direction: Direction,
    g: Float[Array, " photons"],
    xi_cosine: Float[Array, " photons"],
    xi_angle: Float[Array, " photons"],
) -> Direction:
    """Sample new unit directions from the phase function with mean cosine `g`, by two uniform
    random numbers in (0, 1).

    **Source:** Henyey and Greenstein 1941; the inverse distribution is written without a
    singularity at `g = 0`.
    """
    x, y, z = direction
    s = 2 * xi_cosine - 1
    cosine = (s + 0.5 * g * (3 + s * s) + g * g * (s + 0.5 * g * (s * s - 1))) / (
        (1 + g * s) * (1 + g * s)
    )
    sine = jnp.sqrt(jnp.maximum(1 - cosine * cosine, 0.0))
    along, across = (sine * coordinate for coordinate in on_circle(xi_angle))
    # An orthonormal basis around the direction (Duff et al. 2017).
    sign = jnp.where(z < 0, -jnp.ones_like(z), jnp.ones_like(z))
    a = -1 / (sign + z)
    b = x * y * a
    turned = (
        along * (1 + sign * x * x * a) + across * b + cosine * x,
        along * sign * b + across * (sign + y * y * a) + cosine * y,
        -along * sign * x - across * y + cosine * z,
    )
    # Normalize by one Newton step for the inverse square root.
    squared = turned[0] * turned[0] + turned[1] * turned[1] + turned[2] * turned[2]
    scale = 1.5 - 0.5 * squared
    return turned[0] * scale, turned[1] * scale, turned[2] * scale


def fly(
    media: LayeredMedia, photons: Photons, xi: Float[Array, "four photons"]
) -> tuple[Photons, Float[Array, " photons"], Bool[Array, " photons"]]:
    """Move photons by one flight, and return them, the length of the flight (0 for a photon that is
    not inside), and whether it ended in a scattering event. `xi` are uniform random numbers for the
    scattering cosine or reflection, the angle, and the next free path.
    """
    ux, uy, uz = photons.direction
    layer, inside = photons.layer, photons.place == INSIDE
    thicknesses, eta = media.thickness[:, 0], media.eta[:, 0]
    sigma_s, thickness = of_layer(media.sigma_s[:, 0], layer), of_layer(thicknesses, layer)
    down = uz > 0
    vertical = jnp.where(down, thickness - photons.depth, photons.depth)
    to_interface = jnp.maximum(vertical, 0.0) / jnp.maximum(jnp.abs(uz), jnp.finfo(uz.dtype).tiny)
    to_scatter = jnp.where(
        sigma_s > 0, photons.to_scatter / jnp.where(sigma_s > 0, sigma_s, 1.0), jnp.inf
    )
    scattered = to_scatter < to_interface
    length = jnp.where(inside, jnp.minimum(to_scatter, to_interface), 0.0)

    turned = scatter(photons.direction, of_layer(media.g, layer), xi[0], xi[1])
    from_eta, to_eta = (
        of_layer(eta[1:-1], layer),
        jnp.where(down, of_layer(eta[2:], layer), of_layer(eta[:-2], layer)),
    )
    reflectance, onward = fresnel(jnp.abs(uz), from_eta, to_eta)
    crosses = ~scattered & (xi[0] > reflectance)
    bent = jnp.where(crosses, from_eta / to_eta, 1.0)
    next_layer = jnp.where(crosses, layer + jnp.where(down, 1, -1), layer)
    next_place = jnp.where(
        next_layer < 0, ABOVE, jnp.where(next_layer >= len(thicknesses), BELOW, INSIDE)
    )
    stays = next_place == INSIDE
    up_again = jnp.where(crosses, jnp.where(down, onward, -onward), -uz)
    # At an interface the depth is exactly 0 or the thickness of the layer, entered or reflected
    # into.
    arrives_on_top = jnp.where(crosses, down, ~down)
    at_interface = jnp.where(
        arrives_on_top, 0.0, of_layer(thicknesses, jnp.where(stays, next_layer, layer))
    )

    moved = Photons(
        x=photons.x + ux * length,
        y=photons.y + uy * length,
        depth=jnp.where(scattered, photons.depth + uz * length, at_interface),
        direction=(
            jnp.where(scattered, turned[0], ux * bent),
            jnp.where(scattered, turned[1], uy * bent),
            jnp.where(scattered, turned[2], up_again),
        ),
        to_scatter=jnp.where(
            scattered, -jnp.log(xi[2]), photons.to_scatter - to_interface * sigma_s
        ),
        layer=jnp.where(scattered | ~stays, layer, next_layer),
        place=jnp.where(scattered, INSIDE, next_place),
        flights=photons.flights + 1,
    )
    moved = jax.tree.map(lambda new, old: jnp.where(inside, new, old), moved, photons)
    return moved, length, scattered & inside


def weigh(
    sigma_a: Float[Array, "layers channels"],
    sigma_s: Float[Array, "layers channels"],
    weights: PathWeights,
    layer: Int[Array, " photons"],
    length: Float[Array, " photons"],
    scattered: Bool[Array, " photons"],
) -> PathWeights:
    """Update weights along a flight in a layer. Absorption is computed as a mean, not sampled.
    Differentiable in the coefficients.

    The likelihood ratio of a path, under scattering coefficients other than those that it was
    sampled with, is a product over its flights and scattering events. Its value is 1; its
    derivative is the contribution of the path to the derivative of every mean.
    """
    drawn = jax.lax.stop_gradient(sigma_s)
    ratio = jnp.where(drawn > 0, sigma_s / jnp.where(drawn > 0, drawn, 1.0), 1.0)
    removal = of_layer(sigma_a + (sigma_s - drawn), layer) * length[None]
    absorbed = weights.carried * of_layer(sigma_a, layer) * length[None] * mean_decay(removal)
    ratio = jnp.where(scattered[None], of_layer(ratio, layer), 1.0)
    layers = jnp.arange(weights.absorbed.shape[0], dtype=jnp.int32)[:, None, None]
    return PathWeights(
        weights.carried * jnp.exp(-removal) * ratio,
        weights.absorbed + jnp.where(layer[None, None] == layers, absorbed[None], 0.0),
    )
