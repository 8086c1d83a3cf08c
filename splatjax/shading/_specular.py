"""The specular lobe of Kelemen and Szirmay-Kalos, its Fresnel term, and its tabulated directional
and average albedos.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.chebyshev import chebpts1, chebvander

from splatjax._chunking import map_chunks

ROUGHNESS_RANGE = (0.05, 1.0)
_LOG_ROUGHNESS = np.log(ROUGHNESS_RANGE).tolist()
_LEAST_HALF_COSINE = 1e-4  # least N.(L+V), below which the pole of the lobe is cut

# Chebyshev degrees in sqrt(mu) and in log m. The square root resolves grazing angles, where the
# albedo varies like mu log mu. The error is at most 1.3e-4 (a) and 1.2e-4 (b) for all mu and m in
# range.
_MU_NODES = 18
_ROUGHNESS_NODES = 12
_POWERS = 8  # powers of the cosine whose averages with the albedo are tabulated
_LEAST_MU = 1e-5
_LEAST_F0 = 0.02  # least f0 of surfaces that reflect all light at grazing incidence
_AT_ONCE = 1 << 14  # points whose polynomials are in memory at once


def fresnel_f0(eta: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute the reflectance at normal incidence, `((eta - 1) / (eta + 1))^2`.

    **Arguments:**

    - `eta`: index of refraction relative to the outside, positive. Differentiable.

    **Returns:** in [0, 1); 0 at `eta = 1`.
    """
    ratio = (eta - 1) / (eta + 1)
    return ratio * ratio


def grazing_reflectance(f0: Float[Array, "..."]) -> Float[Array, "..."]:
    """Compute the reflectance at grazing incidence, which replaces 1 in Schlick's term. It is 1 for
    f0 of at least 0.02 (water) and falls below that, so that a surface without change of index
    reflects nothing. The reflected fraction of uniform light is within 0.007 of Fresnel's for every
    index up to 2.

    **Source:** Lagarde and de Rousiers 2014, "Moving Frostbite to PBR", as a step in f0.
    """
    deficit = jnp.maximum(1 - f0 / _LEAST_F0, 0)
    return 1 - deficit * deficit * deficit


def specular_lobe(
    normal: Float[Array, "*#points 3"],
    wi: Float[Array, "*#points 3"],
    wo: Float[Array, "*#points 3"],
    *,
    f0: Float[Array, "..."],
    specular: Float[Array, "..."],
    roughness: Float[Array, "..."],
) -> Float[Array, "*points"]:
    r"""Compute the reflectance of a rough interface, `f = specular PH F(H.V) / |wi + wo|^2`.

    With `a` the angle between the normal and the half vector,
    `PH = exp(-tan^2 a / m^2) / (pi m^2 cos^4 a)`; the half vector `wi + wo` is not normalized in
    the quotient. `F` is Schlick's, with `grazing_reflectance` instead of 1. The outgoing radiance
    is `f (N.wi)` times the irradiance on a surface that faces the light. The lobe includes the
    factor `1 / pi`, which some published shaders lack, so that it never reflects more than it
    receives (`directional_albedo`).

    **Arguments:** directions have equal rank and broadcast; the others are scalars or broadcast
    against their leading axes.

    - `normal`, `wi`, `wo`: unit vectors; `wi` and `wo` point away from the surface. Differentiable.
    - `f0`: reflectance at normal incidence (`fresnel_f0`). Differentiable.
    - `specular`: strength rho_s. Differentiable.
    - `roughness`: root mean square slope m, clamped to [0.05, 1] with gradient 0 outside.
      Differentiable.

    **Returns:** 1/sr, at least 0, symmetric in `wi` and `wo`. Value and gradient are 0 where
    `N.wi <= 0` or `N.wo <= 0`. The pole where `wi` and `wo` graze the surface in opposite
    directions is cut at `N.(wi + wo) = 1e-4`.

    **Source:** Kelemen and Szirmay-Kalos 2001; d'Eon and Luebke 2007 (GPU Gems 3, chapter 14),
    which omits the 1/pi.
    """
    cos_i = jnp.sum(normal * wi, axis=-1)
    cos_o = jnp.sum(normal * wo, axis=-1)
    half_vector = wi + wo
    squared_length = jnp.sum(half_vector * half_vector, axis=-1)
    seen = (cos_i > 0) & (cos_o > 0)
    # Finite placeholders outside the domain of the lobe keep infinities out of the derivative.
    squared_length = jnp.maximum(jnp.where(seen, squared_length, 2.0), _LEAST_HALF_COSINE**2)
    cosine = jnp.maximum(jnp.where(seen, cos_i + cos_o, 1.0), _LEAST_HALF_COSINE)
    squared_cosine = cosine * cosine
    ratio = squared_length / squared_cosine  # 1 / cos^2 a
    slope = jnp.clip(roughness, *ROUGHNESS_RANGE)
    squared_slope = slope * slope
    spread = jnp.exp((1 - ratio) / squared_slope) / (jnp.pi * squared_slope)
    half_cosine = 0.5 * jnp.sqrt(squared_length)  # H.V, the same for wi and wo
    fresnel = f0 + (grazing_reflectance(f0) - f0) * (1 - half_cosine) ** 5
    return jnp.where(seen, specular * fresnel * spread * ratio / squared_cosine, 0.0)


def _lobe_quadrature(mu: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Integrate the lobe over incident directions, with F = 1 and with F = (1 - H.V)^5, in float64.

    In the slopes p of the half vector, this is the integral of a Gaussian,
    `exp(-p^2 / m^2) / (pi m^2)`, times `2 - mu (1 + p^2) / (mu - p_x sin)`, over the disc of radius
    `1 / mu` around `(-tan, 0)`; on its rim, the incident directions graze the surface. Nodes are
    dense at the rim near the origin. The Gaussian is negligible for |p| > 5 m.
    """
    mu, roughness = (x[..., None, None] for x in np.broadcast_arrays(mu, roughness))
    sine = np.sqrt(1 - mu * mu)
    low = np.maximum(-(1 + sine) / mu, -5 * roughness)
    high = np.minimum(mu / (1 + sine), 5 * roughness)
    x, x_weights = np.polynomial.legendre.leggauss(64)
    angle = np.pi / 4 * (x + 1)
    px = low + (high - low) * np.sin(angle)[:, None]
    px_weights = (high - low) * (np.pi / 4 * x_weights * np.cos(angle))[:, None]
    y, y_weights = np.polynomial.legendre.leggauss(32)
    reach = np.minimum(np.sqrt(np.maximum(1 - px * px - 2 * px * sine / mu, 0)), 5 * roughness)
    py = reach * (y + 1) / 2
    squared = px * px + py * py
    towards = mu - px * sine
    half_cosine = np.clip(towards / np.sqrt(1 + squared), 0, 1)
    density = np.exp(-squared / roughness**2) / (np.pi * roughness**2)
    integrand = (
        density * np.maximum(2 - mu * (1 + squared) / towards, 0) * px_weights * reach * y_weights
    )
    return np.stack([integrand.sum((-1, -2)), (integrand * (1 - half_cosine) ** 5).sum((-1, -2))])


@functools.cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """Compute the Chebyshev coefficients of (a, b) in sqrt(mu) and log m, and those in log m of
    their averages with powers of mu.
    """
    mu_nodes, roughness_nodes = chebpts1(_MU_NODES), chebpts1(_ROUGHNESS_NODES)
    roughness = np.exp(np.interp(roughness_nodes, [-1, 1], _LOG_ROUGHNESS))
    values = _lobe_quadrature(((1 + mu_nodes[:, None]) / 2) ** 2, roughness)
    to_mu = np.linalg.inv(chebvander(mu_nodes, _MU_NODES - 1))
    to_roughness = np.linalg.inv(chebvander(roughness_nodes, _ROUGHNESS_NODES - 1))
    coefficients = to_mu @ values @ to_roughness.T
    # 2 mu dmu = 4 u^3 du with u = sqrt(mu), so the average is exactly that of the interpolant.
    x, weights = np.polynomial.legendre.leggauss(_MU_NODES)
    powers = ((1 + x) / 2) ** (3 + 2 * np.arange(_POWERS)[:, None])
    average = (2 * weights * powers) @ chebvander(x, _MU_NODES - 1)
    return coefficients, np.einsum("pi,tij->tpj", average, coefficients)


def _roughness_basis(roughness: Float[Array, "*points"]) -> Float[Array, "basis *points"]:
    """Evaluate the Chebyshev polynomials of `log m` in a loop, which compiles quickly."""
    low, high = _LOG_ROUGHNESS
    t = (2 * jnp.log(jnp.clip(roughness, *ROUGHNESS_RANGE)) - (low + high)) / (high - low)

    def step(rows, _):
        row, following = rows
        return (following, 2 * t * following - row), row

    return jax.lax.scan(step, (jnp.ones_like(t), t), length=_ROUGHNESS_NODES)[1]


def _with_fresnel(tables: np.ndarray, f0: Float[Array, ""]) -> Float[Array, "..."]:
    """Combine the coefficients of the tables (a, b) by Schlick's term."""
    constant, grazing = jnp.asarray(tables, f0.dtype)
    return f0 * constant + (grazing_reflectance(f0) - f0) * grazing


def _sum_over_roughness(
    table: Float[Array, "rows basis"], roughness: Float[Array, "*points"]
) -> Float[Array, "rows *points"]:
    """Sum series in `log m` at the roughness of each point."""
    sums = map_chunks(
        lambda part: (table @ _roughness_basis(part)).T, roughness.reshape(-1), at_once=_AT_ONCE
    )
    return sums.T.reshape(-1, *roughness.shape)


def albedo_series(
    f0: Float[Array, "..."], roughness: Float[Array, "*points"]
) -> Float[Array, "terms *points"]:
    """Compute the series of `directional_albedo` in `sqrt(mu)` for the roughness of each point."""
    return _sum_over_roughness(_with_fresnel(_tables()[0], f0), roughness)


def sum_albedo(
    series: Float[Array, "terms *#points"], mu: Float[Array, "*points"]
) -> Float[Array, "*points"]:
    """Sum the series of `directional_albedo`."""
    x = 2 * jnp.sqrt(jnp.clip(mu, _LEAST_MU, 1.0)) - 1
    first, *others = series
    following = after = jnp.zeros_like(x)
    for row in reversed(others):  # Clenshaw's recurrence
        following, after = row + 2 * x * following - after, following
    return jnp.clip(first + x * following - after, 0.0, 1.0)


def directional_albedo(
    mu: Float[Array, "..."],
    f0: Float[Array, "..."],
    roughness: Float[Array, "..."],
) -> Float[Array, "..."]:
    r"""Compute the fraction of light from one direction that a rough interface reflects, `rho(mu)`,
    by a specular lobe of strength 1.

    Schlick's term splits the integral of `specular_lobe` over the hemisphere:
    `rho = f0 a(mu, m) + (g - f0) b(mu, m)`, where g is the `grazing_reflectance`. The tables a and
    b are computed once by quadrature and stored as Chebyshev series in `sqrt(mu)` and `log m`.

    **Arguments:** `mu` and `roughness` broadcast.

    - `mu`: cosine between direction and normal, clamped to [1e-5, 1]. Differentiable; the slope
      diverges like `log mu` at `mu = 0` and is set to 0 below 1e-5.
    - `f0`: reflectance at normal incidence. Differentiable.
    - `roughness`: m, clamped to [0.05, 1] as in the lobe. Differentiable.

    **Returns:** in [0, 1], with an error of at most 2e-4.

    **Source:** the lobe of Kelemen and Szirmay-Kalos 2001, as normalized in `specular_lobe`.
    """
    if not roughness.ndim:
        return sum_albedo(albedo_series(f0, roughness), mu)
    mu, roughness = jnp.broadcast_arrays(mu, roughness)
    flat = map_chunks(
        lambda mu, m: sum_albedo(albedo_series(f0, m), mu),
        *(mu.reshape(-1), roughness.reshape(-1)),
        at_once=_AT_ONCE,
    )
    return flat.reshape(mu.shape)


def average_albedo(
    f0: Float[Array, "..."], roughness: Float[Array, "..."], factor: Float[Array, "powers channels"]
) -> Float[Array, "channels ..."]:
    r"""Compute the fraction of uniform light that a rough interface reflects, with an angular
    factor `e(mu) = sum_k c_k mu^k`: `2 int_0^1 rho(mu) e(mu) mu dmu`.

    This is the exact integral of the series that `directional_albedo` evaluates, so the two are
    consistent.

    **Arguments:** as in `directional_albedo`.

    - `factor`: `c_k`, at most 8 powers.
    """
    averages = factor.T @ _with_fresnel(_tables()[1][:, : len(factor)], f0)
    return _sum_over_roughness(averages, roughness)
