"""The specular lobe of Kelemen and Szirmay-Kalos, and its Fresnel term."""

import jax.numpy as jnp
from jaxtyping import Array, Float

ROUGHNESS_RANGE = (0.05, 1.0)
_LEAST_HALF_COSINE = 1e-4  # of N.(L+V): below it the lobe's pole is cut


def fresnel_f0(eta: Float[Array, "..."]) -> Float[Array, "..."]:
    """Give the reflectance at normal incidence, `((eta - 1) / (eta + 1))^2`.

    **Arguments:**

    - `eta`: index of refraction relative to the outside, positive. Differentiable.

    **Returns:** in [0, 1); 0 at `eta = 1`.
    """
    ratio = (eta - 1) / (eta + 1)
    return ratio * ratio


def clamped_roughness(roughness: Float[Array, "..."]) -> Float[Array, "..."]:
    """Give the roughness that lobe and albedo both use: clamped to [0.05, 1], with gradient 0
    outside.
    """
    return jnp.clip(roughness, *ROUGHNESS_RANGE)


def specular_lobe(
    normal: Float[Array, "*#points 3"],
    wi: Float[Array, "*#points 3"],
    wo: Float[Array, "*#points 3"],
    *,
    f0: Float[Array, "..."],
    specular: Float[Array, "..."],
    roughness: Float[Array, "..."],
) -> Float[Array, "*points"]:
    r"""Give the reflectance of a rough interface, `f = specular PH F(H.V) / |wi + wo|^2`.

    With `a` the angle between the normal and the half vector, `PH = exp(-tan^2 a / m^2) / (pi m^2
    cos^4 a)`; the half vector `wi + wo` is not normalized in the quotient. `F` is Schlick's. The
    outgoing radiance is `f (N.wi)` times the irradiance of a surface that faces the light. The
    factor `1 / pi`, which some published shaders lack, is part of it, so that the lobe never
    reflects more than it receives (`directional_albedo`).

    **Arguments:** directions have equal rank and broadcast; the others are scalars or broadcast
    against their leading axes.

    - `normal`, `wi`, `wo`: unit vectors; `wi` and `wo` point away from the surface. Differentiable.
    - `f0`: reflectance at normal incidence (`fresnel_f0`). Differentiable.
    - `specular`: strength rho_s. Differentiable.
    - `roughness`: root mean square slope m, clamped to [0.05, 1]. Differentiable.

    **Returns:** 1/sr, at least 0, unchanged when `wi` and `wo` are exchanged. Where `N.wi <= 0` or
    `N.wo <= 0` value and gradient are 0. The pole where both directions graze the surface in
    opposite directions is cut at `N.(wi + wo) = 1e-4`.

    **Source:** Kelemen and Szirmay-Kalos 2001; d'Eon and Luebke 2007 (GPU Gems 3, chapter 14),
    which leaves out the 1/pi.
    """
    cos_i = jnp.sum(normal * wi, axis=-1)
    cos_o = jnp.sum(normal * wo, axis=-1)
    half_vector = wi + wo
    squared_length = jnp.sum(half_vector * half_vector, axis=-1)
    seen = (cos_i > 0) & (cos_o > 0)
    # Where the lobe is not seen, harmless numbers stand in, so that no infinity enters the
    # derivative.
    squared_length = jnp.maximum(jnp.where(seen, squared_length, 2.0), _LEAST_HALF_COSINE**2)
    cosine = jnp.maximum(jnp.where(seen, cos_i + cos_o, 1.0), _LEAST_HALF_COSINE)
    squared_cosine = cosine * cosine
    ratio = squared_length / squared_cosine  # 1 / cos^2 a
    slope = clamped_roughness(roughness)
    squared_slope = slope * slope
    spread = jnp.exp((1 - ratio) / squared_slope) / (jnp.pi * squared_slope)
    half_cosine = 0.5 * jnp.sqrt(squared_length)  # H.V, the same for wi and wo
    grazing = (1 - half_cosine) ** 5
    fresnel = f0 + (1 - f0) * grazing
    return jnp.where(seen, specular * fresnel * spread * ratio / squared_cosine, 0.0)
