"""A smooth interface between two indices."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scattering import reflectance


def fresnel(
    cosine: Float[Array, " photons"],
    eta_from: Float[Array, " photons"],
    eta_to: Float[Array, " photons"],
) -> tuple[Float[Array, " photons"], Float[Array, " photons"]]:
    """Compute the reflectance for unpolarized light that arrives under `cosine` (0 to 1), and the
    cosine of the transmitted light.

    Total internal reflection is 1, with a cosine of 0. Between equal indices nothing is reflected
    or bent, exactly.
    """
    ratio = eta_from / eta_to
    squared = 1 - ratio * ratio * (1 - cosine * cosine)
    matched = eta_from == eta_to
    onward = jnp.where(matched, cosine, jnp.sqrt(jnp.maximum(squared, 0.0)))
    reflected = jnp.where(squared > 0, reflectance(cosine, onward, ratio), 1.0)
    return jnp.where(matched, 0.0, reflected), onward
