"""How the diffuse light leaves through the rough interface, and how a map of albedo colors it."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._albedo import average_albedo, directional_albedo

_LEAST_SHARE = 1e-4
_ALBEDO_FLOOR = 1e-4


def diffuse_transmission(
    mu: Float[Array, "..."],
    f0: Float[Array, "..."],
    specular: Float[Array, "..."],
    roughness: Float[Array, "..."],
) -> Float[Array, "..."]:
    r"""Give the angular factor of the diffuse light that leaves, `(1 - rho(mu)) / (1 - rho_avg)`.

    The radiance of a surface of radiant exitance `M` is `M diffuse_transmission(mu_o) / pi`. Since
    the factor's average, weighted with `2 mu`, is one, the light that leaves is exactly `M`.

    **Arguments:** as in `directional_albedo`; `mu` is the cosine of the direction towards the
    camera.

    **Returns:** at least 0. `1 - rho_avg` is kept above 1e-4 (gradient 0 below): a surface that
    reflects everything lets nothing in, so that `M` is 0 there.

    **Source:** d'Eon and Luebke 2007 (GPU Gems 3, chapter 14).
    """
    share = 1 - directional_albedo(mu, f0, specular, roughness)
    average = 1 - average_albedo(f0, specular, roughness)
    return share / jnp.maximum(average, _LEAST_SHARE)


def albedo_root(albedo: Float[Array, "..."]) -> Float[Array, "..."]:
    """Give `sqrt(max(albedo, 1e-4))`: half of the color acts before the light spreads, half after.

    **Arguments:**

    - `albedo`: diffuse color, linear, in [0, 1]. Differentiable; the gradient is `1 / (2
      sqrt(albedo))` above the floor and 0 at and below it, since that of the root itself diverges
      at a black texel.

    **Returns:** at least 0.01; its square is the albedo, but for texels darker than 1e-4.

    **Source:** d'Eon and Luebke 2007 (GPU Gems 3, chapter 14): pre- and post-scatter texturing in
    equal parts.
    """
    return jnp.sqrt(jnp.where(albedo > _ALBEDO_FLOOR, albedo, _ALBEDO_FLOOR))
