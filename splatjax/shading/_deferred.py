"""Pass 5: deferred shading of one visible surface (section 4.1): what the rough interface reflects,
how the diffuse light leaves through it, and how a map of albedo colors that.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scattering import SingleScattering
from splatjax.scene import StackedLights, sum_over_lights

from ._specular import average_albedo, directional_albedo, specular_lobe

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


class SurfacePoints(eqx.Module):
    r"""What the pixels see of one surface: blended attributes, ready to be shaded.

    **Attributes:**

    - `normals`: unit, or zero where there is no surface.
    - `outgoing`: `wo`, unit, towards the eye.
    - `lit`: per group of lights, as the splats received it.
    """

    positions: Float[Array, "*pixels 3"]
    normals: Float[Array, "*pixels 3"]
    outgoing: Float[Array, "*pixels 3"]
    specular: Float[Array, "*pixels"] | Float[Array, ""]
    roughness: Float[Array, "*pixels"] | Float[Array, ""]
    lit: list[Float[Array, "_lights *pixels"] | None]


def unit_normals(normals: Float[Array, "*pixels 3"]) -> Float[Array, "*pixels 3"]:
    """Give blended normals unit length; zero stays zero, with a zero gradient: no direction is
    better than another.
    """
    squared = jnp.sum(normals * normals, axis=-1, keepdims=True)
    there = squared > 0
    return jnp.where(there, normals / jnp.sqrt(jnp.where(there, squared, 1.0)), 0.0)


def leaving_share(points: SurfacePoints, f0: Float[Array, ""]) -> Float[Array, "*pixels"]:
    """Give the share of diffused light that leaves towards the eye, `(1 - rho(wo)) / (1 -
    rho_avg)`: on average 1.
    """
    cosine = jnp.maximum(jnp.sum(points.normals * points.outgoing, axis=-1), 0)
    return diffuse_transmission(cosine, f0, points.specular, points.roughness)


def reflected_radiance(
    points: SurfacePoints, groups: list[StackedLights], f0: Float[Array, ""], channels: int
) -> Float[Array, "*pixels channels"]:
    """Give the specular radiance towards the eye: Kelemen / Szirmay-Kalos, each light in its own
    shadow.
    """

    def reflected(light, share):
        wi, irradiance = light.incidence(points.positions)
        lobe = specular_lobe(
            points.normals,
            wi,
            points.outgoing,
            f0=f0,
            specular=points.specular,
            roughness=points.roughness,
        )
        received = lobe * jnp.maximum(jnp.sum(wi * points.normals, axis=-1), 0)
        received = received if share is None else received * share
        return received[..., None] * irradiance

    dark = jnp.zeros((*points.positions.shape[:-1], channels), points.positions.dtype)
    return sum_over_lights(groups, points.lit, reflected, dark)


def single_scattered_radiance(
    points: SurfacePoints,
    groups: list[StackedLights],
    f0: Float[Array, ""],
    single: SingleScattering,
) -> Float[Array, "*pixels channels"]:
    """Give the radiance of light that entered where it leaves and scattered once, each light in its
    own shadow.

    What the specular lobe reflects does not enter. The surface counts as flat and evenly lit over a
    mean free path.
    """
    towards_eye = jnp.maximum(jnp.sum(points.normals * points.outgoing, axis=-1), 0)

    def scattered(light, share):
        wi, irradiance = light.incidence(points.positions)
        cosine = jnp.maximum(jnp.sum(wi * points.normals, axis=-1), 0)
        entered = cosine * (1 - directional_albedo(cosine, f0, points.specular, points.roughness))
        entered = entered if share is None else entered * share
        return single.reflected(cosine, towards_eye) * entered[..., None] * irradiance

    dark = jnp.zeros((*points.positions.shape[:-1], single.channels), points.positions.dtype)
    return sum_over_lights(groups, points.lit, scattered, dark)
