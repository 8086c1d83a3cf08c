"""Adding and doubling: reflection and transmission of layers between discrete cosines, and the
reflectance of a half space.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._fresnel import reflectance
from ._quadrature import unit_legendre

_OUTSIDE, _BEYOND = 12, 8  # cosines: refracted, and beyond the critical angle
_MOMENTS = 12  # of the phase function
_LEAST_COSINE = 1e-4
_DEPTH = 0.05  # of the first layer of a half space, in mean free paths
_DOUBLINGS, _COVER_DOUBLINGS = 18, 8


def outside_cosines() -> Float[np.ndarray, " angles"]:
    """Return the cosines outside, ascending to 1, at which reflectances are computed."""
    return np.append(unit_legendre(_OUTSIDE)[0] ** 2, 1.0)


def directional_albedo(
    albedo_prime: Float[Array, ""],
    eta: Float[Array, ""],
    g: Float[Array, ""],
    cover: tuple[Float[Array, ""], Float[Array, ""]] | None = None,
) -> Float[Array, " angles"]:
    """Compute the fraction of light, entering at each of `outside_cosines`, that leaves a half
    space. The cover is given by its reduced albedo and reduced optical depth.
    """
    mu, weights, reflected = _directions(eta)
    half_space = _doubled(mu, weights, albedo_prime, g)[1]
    identity = jnp.eye(len(mu), dtype=mu.dtype)
    if cover is not None:
        # Adding the cover.
        transmitted, back = _doubled(mu, weights, cover[0], g, cover[1])
        between = jnp.linalg.solve(identity - back @ half_space, transmitted)
        half_space = back + transmitted @ half_space @ between

    # Adding the surface: by reciprocity, the fraction that leaves of light from one direction is
    # the fraction of light from all directions that leaves in that direction.
    leaving = jnp.linalg.solve(
        identity - half_space * reflected[None], half_space @ (1 - reflected)[:, None]
    )
    return leaving[: _OUTSIDE + 1, 0]


def _doubled(mu, weights, albedo_prime, g, optical_depth=None):
    """Return the transmission and reflection, between all cosines, of a layer of a reduced optical
    depth, or of a half space.
    """
    scattering, albedo, extinction = _redistribution(mu, weights, albedo_prime, g)
    even, odd = scattering
    doublings = _DOUBLINGS if optical_depth is None else _COVER_DOUBLINGS
    depth = _DEPTH if optical_depth is None else optical_depth * extinction / 2**doublings

    # One layer, with the mean of its two sides for the light within: the even part of the light
    # from both sides is attenuated by `with_even`, the odd part by `with_odd`.
    identity, half_depth = jnp.eye(len(mu), dtype=mu.dtype), 0.5 * depth / mu[:, None]
    with_even, with_odd = (
        jnp.linalg.solve(identity + loss, identity - loss)
        for loss in (
            half_depth * (identity - albedo * even),
            half_depth * (identity - albedo * odd),
        )
    )
    # Absorption of equal light from both sides, as a sum of positive terms.
    absorbed = jnp.linalg.solve(
        identity + half_depth * (identity - albedo * even), 2 * half_depth * (1 - albedo)
    )
    layer = 0.5 * (with_even + with_odd), 0.5 * (with_even - with_odd), absorbed

    # Doubling; energy is conserved to rounding.
    def double(_, layer):
        transmitted, reflected, absorbed = layer
        between = jnp.linalg.solve(
            identity - reflected @ reflected,
            jnp.concatenate(
                [transmitted, reflected @ transmitted, absorbed + reflected @ absorbed], axis=1
            ),
        )
        count = len(identity)
        direct, back, below = jnp.split(between, [count, 2 * count], axis=1)
        transmitted, reflected = transmitted @ direct, reflected + transmitted @ back
        absorbed = absorbed + layer[0] @ below
        scale = (1 - absorbed) / jnp.sum(transmitted + reflected, axis=1, keepdims=True)
        return scale * transmitted, scale * reflected, absorbed

    transmitted, reflected, _ = jax.lax.fori_loop(0, doublings, double, layer)
    return transmitted, reflected


def diffuse_albedo(
    albedo_prime: Float[Array, ""],
    eta: Float[Array, ""],
    g: Float[Array, ""],
    cover: tuple[Float[Array, ""], Float[Array, ""]] | None = None,
) -> Float[Array, ""]:
    """Compute the fraction that leaves of diffuse light that has entered."""
    mu, weights, reflected = (each[: _OUTSIDE + 1] for each in _directions(eta))
    entering = mu * weights * (1 - reflected)
    return jnp.vdot(entering, directional_albedo(albedo_prime, eta, g, cover)) / jnp.sum(entering)


def _directions(eta: Float[Array, ""]):
    """Return cosines inside, their weights, and the reflectance of the surface met from inside:
    refracted ones, of `outside_cosines`, and those beyond the critical angle.
    """
    nodes, node_weights = unit_legendre(_OUTSIDE)
    outside = jnp.asarray(outside_cosines(), eta.dtype)
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
    weights; and the albedo and the reduced extinction, the forward peak taken as unscattered.
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
    extinction = scattered + 1 - albedo_prime
    return (even, odd), scattered / extinction, extinction
