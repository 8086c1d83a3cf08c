"""One flight of many photons: to the next scattering or to the next interface, whichever comes
first.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._directions import AbstractPhaseFunction, Direction, fresnel, of_layer

# States of a photon; an idle one does not fly.
INSIDE, ABOVE, BELOW, IDLE = 0, 1, 2, 3


class Stack(eqx.Module):
    r"""The geometry of a walk, in free paths of the first layer that scatters. A constant of every
    derivative.

    **Attributes:**

    - `sigma_s`: scattering coefficients; 0 in a film.
    - `thickness`: of each layer.
    - `eta`: indices relative to air, those of the neighbors above and below included.
    """

    sigma_s: Float[Array, " layers"]
    thickness: Float[Array, " layers"]
    eta: Float[Array, " layers_and_neighbors"]


class Photons(eqx.Module):
    """Positions of photons, in free paths of the stack; depth is from the top of their layer. Not
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
    r"""Carried and absorbed weights of photons, in each channel of the walk.

    **Attributes:**

    - `carried`: the share of the entering power; 1 at the start, on average.
    - `absorbed`: the share that each layer has absorbed.

    Derivatives of both have a leading axis.
    """

    carried: Float[Array, "*slopes channels photons"]
    absorbed: Float[Array, "*slopes layers channels photons"]


class Optics(eqx.Module):
    r"""The coefficients that determine weights, per free path of the stack. Only these are
    differentiable.

    **Attributes:**

    - `absorption`: absorption coefficients.
    - `removal`: absorption, and scattering in excess of that by which flights are drawn.
    - `ratio`: scattering over that by which flights are drawn. 1 in value.

    The likelihood of a path under other coefficients than those it was drawn by is a product over
    its flights and scatterings: its derivative is the path's share in that of every mean.
    """

    absorption: Float[Array, "*slopes layers channels"]
    removal: Float[Array, "*slopes layers channels"]
    ratio: Float[Array, "*slopes layers channels"]

    @classmethod
    def of(
        cls,
        sigma_a: Float[Array, "layers channels"],
        sigma_s: Float[Array, "layers channels"],
        unit,
    ) -> "Optics":
        """State coefficients (1/mm) in free paths of `unit` mm, [channels]."""
        drawn, unit = jax.lax.stop_gradient(sigma_s), jax.lax.stop_gradient(unit)[None]
        return cls(
            sigma_a * unit,
            sigma_a * unit + (sigma_s - drawn) * unit,
            jnp.where(drawn > 0, sigma_s / jnp.where(drawn > 0, drawn, 1.0), 1.0),
        )


def fly(
    stack: Stack, phase: AbstractPhaseFunction, photons: Photons, xi: Float[Array, "four photons"]
) -> tuple[Photons, Float[Array, " photons"], Bool[Array, " photons"]]:
    """Move photons by one flight. Uniform random numbers: cosine or reflection, angle, and the next
    free path. Also return its length in the layer where it began, 0 for a photon that does not fly,
    and whether it ended in a scattering.
    """
    ux, uy, uz = photons.direction
    layer, inside = photons.layer, photons.place == INSIDE
    sigma_s, thickness = of_layer(stack.sigma_s, layer), of_layer(stack.thickness, layer)
    down = uz > 0
    ahead = jnp.where(down, thickness - photons.depth, photons.depth)
    to_interface = jnp.maximum(ahead, 0.0) / jnp.maximum(jnp.abs(uz), jnp.finfo(uz.dtype).tiny)
    to_scatter = jnp.where(
        sigma_s > 0, photons.to_scatter / jnp.where(sigma_s > 0, sigma_s, 1.0), jnp.inf
    )
    scattered = to_scatter < to_interface
    length = jnp.where(inside, jnp.minimum(to_scatter, to_interface), 0.0)

    turned = phase.scatter(photons.direction, layer, xi[0], xi[1])
    from_eta, to_eta = (
        of_layer(stack.eta[1:-1], layer),
        jnp.where(down, of_layer(stack.eta[2:], layer), of_layer(stack.eta[:-2], layer)),
    )
    reflectance, onward = fresnel(jnp.abs(uz), from_eta, to_eta)
    crosses = ~scattered & (xi[0] > reflectance)
    bent = jnp.where(crosses, from_eta / to_eta, 1.0)
    after = jnp.where(crosses, layer + jnp.where(down, 1, -1), layer)
    left = jnp.where(after < 0, ABOVE, jnp.where(after >= stack.sigma_s.shape[0], BELOW, INSIDE))
    stays = left == INSIDE
    up_again = jnp.where(crosses, jnp.where(down, onward, -onward), -uz)
    # At an interface the depth is 0 or that of the layer now entered, or met from inside, exactly.
    arrives_on_top = jnp.where(crosses, down, ~down)
    at_interface = jnp.where(
        arrives_on_top, 0.0, of_layer(stack.thickness, jnp.where(stays, after, layer))
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
        layer=jnp.where(scattered | ~stays, layer, after),
        place=jnp.where(scattered, INSIDE, left),
        flights=photons.flights + 1,
    )
    moved = jax.tree.map(lambda new, old: jnp.where(inside, new, old), moved, photons)
    return moved, length, scattered & inside


def weigh(
    optics: Optics,
    weights: PathWeights,
    layer: Int[Array, " photons"],
    length: Float[Array, " photons"],
    scattered: Bool[Array, " photons"],
) -> PathWeights:
    """Update weights along a flight in a layer: absorption is its mean, not sampled."""
    length, scattered = (jnp.broadcast_to(x, weights.carried.shape) for x in (length, scattered))
    removal = of_layer(optics.removal, layer) * length
    # The mean of exp(-removal) on the way; a series where the quotient has no derivative.
    short = removal < 1e-4
    mean = -jnp.expm1(-removal) / jnp.where(short, 1.0, removal)
    mean = jnp.where(short, 1 - 0.5 * removal, mean)
    taken = weights.carried * of_layer(optics.absorption, layer) * length * mean
    ratio = jnp.where(scattered, of_layer(optics.ratio, layer), 1.0)
    layers = jnp.broadcast_to(
        jnp.arange(weights.absorbed.shape[0], dtype=jnp.int32)[:, None, None],
        weights.absorbed.shape,
    )
    here = jnp.broadcast_to(layer, layers.shape) == layers
    return PathWeights(
        weights.carried * jnp.exp(-removal) * ratio,
        weights.absorbed + jnp.where(here, jnp.broadcast_to(taken, here.shape), 0.0),
    )
