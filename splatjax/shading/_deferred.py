"""Pass 5: deferred shading of one visible surface (section 4.1)."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scattering import SingleScattering
from splatjax.scene import StackedLights, sum_over_lights

from ._albedo import directional_albedo
from ._composition import diffuse_transmission
from ._specular import specular_lobe


class SurfacePoints(eqx.Module):
    """What the pixels see of one surface: blended attributes, ready to be shaded."""

    positions: Float[Array, "*pixels 3"]
    normals: Float[Array, "*pixels 3"]
    """Unit, or zero where there is no surface."""
    outgoing: Float[Array, "*pixels 3"]
    """`wo`: unit, towards the eye."""
    specular: Float[Array, "*pixels"] | Float[Array, ""]
    roughness: Float[Array, "*pixels"] | Float[Array, ""]
    lit: list[Float[Array, "_lights *pixels"] | None]
    """Per group of lights, as the splats received it."""


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

    return sum_over_lights(groups, points.lit, reflected, _dark(points, channels))


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

    return sum_over_lights(
        groups, points.lit, scattered, _dark(points, single.medium.sigma_a.shape[0])
    )


def _dark(points: SurfacePoints, channels: int) -> Float[Array, "*pixels channels"]:
    return jnp.zeros((*points.positions.shape[:-1], channels), points.positions.dtype)
