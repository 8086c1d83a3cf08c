"""A smooth interface between two indices."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def fresnel(
    cosine: Float[Array, " photons"],
    eta_from: Float[Array, " photons"],
    eta_to: Float[Array, " photons"],
) -> tuple[Float[Array, " photons"], Float[Array, " photons"]]:
    """Give the reflectance for unpolarized light that comes under `cosine` (0 to 1), and the cosine
    it goes on under.

    Total internal reflection is 1, with a cosine of 0. Between equal indices nothing is reflected
    or bent, exactly.
    """
    ratio = eta_from / eta_to
    squared = 1 - ratio * ratio * (1 - cosine * cosine)
    matched = eta_from == eta_to
    onward = jnp.where(matched, cosine, jnp.sqrt(jnp.maximum(squared, 0.0)))
    across = (eta_from * cosine - eta_to * onward) / (eta_from * cosine + eta_to * onward)
    along = (eta_from * onward - eta_to * cosine) / (eta_from * onward + eta_to * cosine)
    reflectance = jnp.where(
        squared > 0, 0.5 * (across * across + along * along), jnp.ones_like(cosine)
    )
    return jnp.where(matched, jnp.zeros_like(cosine), reflectance), onward
