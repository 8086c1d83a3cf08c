"""The light that a surface receives, and pass 5: deferred shading (section 4.1), with the
reflection and transmission of the rough interface and the albedo.
"""

from collections.abc import Callable
from itertools import compress

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatjax.scattering import AngularLaw, SingleScattering
from splatjax.scene import StackedLights

from ._specular import (
    albedo_series,
    average_albedo,
    directional_albedo,
    specular_lobe,
    sum_albedo,
)

_LEAST_SHARE = 1e-4


def diffuse_transmission(
    mu: Float[Array, "..."],
    f0: Float[Array, "..."],
    roughness: Float[Array, "..."],
    angles: AngularLaw,
) -> Float[Array, "channels ..."]:
    r"""Compute the angular factor of the diffuse light that leaves: `e(mu) (1 - rho(mu))` divided
    by its average with weight `2 mu`. The transmission depends on index and roughness, not on the
    strength of the specular lobe.

    A surface with radiant exitance `M` has the radiance `M diffuse_transmission(mu_o) / pi`. Since
    the average is 1, the light that leaves is exactly `M`.

    **Arguments:** as in `directional_albedo`; `mu` is the cosine of the direction to the camera.

    - `angles`: the law `e` of a material.

    **Returns:** at least 0, with the channels of `angles` as first axis. The average is clamped to
    1e-4 (gradient 0 below), since a surface that reflects all light transmits none, and `M` is 0.

    **Source:** d'Eon and Luebke 2007 (GPU Gems 3, chapter 14), with `e = 1`.
    """
    average = jnp.maximum(average_transmission(f0, roughness, angles), _LEAST_SHARE)
    leaves = jnp.moveaxis(angles(mu), -1, 0) * (1 - directional_albedo(mu, f0, roughness))[None]
    return leaves / average.reshape(*average.shape, *[1] * (leaves.ndim - average.ndim))


def average_transmission(
    f0: Float[Array, "..."],
    roughness: Float[Array, "..."],
    angles: AngularLaw,
) -> Float[Array, "channels ..."]:
    """Compute the average of `e(mu) (1 - rho(mu))` with weight `2 mu`: the transmitted fraction of
    uniform light, relative to light along the normal.

    **Arguments:** as for `diffuse_transmission`.

    **Returns:** the average, with the channels of `angles` as first axis.
    """
    reflected = average_albedo(f0, roughness, angles.coefficients)
    total = angles.coefficients.T @ jnp.asarray(
        [2 / (2 + power) for power in range(len(angles.coefficients))], reflected.dtype
    )
    return total.reshape(-1, *[1] * roughness.ndim) - reflected


class SurfacePoints(eqx.Module):
    r"""The visible points of a surface, with blended attributes for shading.

    **Attributes:**

    - `normals`: unit vectors, or zero where there is no surface.
    - `outgoing`: `wo`, the unit vectors to the eye.
    - `visibility`: per group, the fraction of each light that arrives; `None` for lights without
      shadows.
    """

    positions: Float[Array, "*pixels 3"]
    normals: Float[Array, "*pixels 3"]
    outgoing: Float[Array, "*pixels 3"]
    specular: Float[Array, "*pixels"] | Float[Array, ""]
    roughness: Float[Array, "*pixels"] | Float[Array, ""]
    visibility: list[Float[Array, "_lights *pixels"] | None]


def unit_normals(normals: Float[Array, "*pixels 3"]) -> Float[Array, "*pixels 3"]:
    """Normalize blended normals. Zero stays zero, with a zero gradient."""
    squared = jnp.sum(normals * normals, axis=-1, keepdims=True)
    is_surface = squared > 0
    return jnp.where(is_surface, normals / jnp.sqrt(jnp.where(is_surface, squared, 1.0)), 0.0)


def _cosine(
    normals: Float[Array, "*pixels 3"], directions: Float[Array, "*pixels 3"]
) -> Float[Array, "*pixels"]:
    """Compute the cosine between unit vectors, clamped to 0 below the horizon, where it has a
    kink.
    """
    return jnp.maximum(jnp.sum(normals * directions, axis=-1), 0)


def sum_received(
    points: Float[Array, "*pixels 3"],
    normals: Float[Array, "*pixels 3"],
    groups: list[StackedLights],
    visibility: list[Float[Array, "_lights *pixels"] | None],
    factor: Callable[
        [Float[Array, "*pixels 3"], Float[Array, "*pixels"]], Float[Array, "#channels *pixels"]
    ],
    channels: int,
) -> Float[Array, "channels *pixels"]:
    r"""Sum the light that a surface receives, `sum_lights irradiance max(n . wi, 0) visibility
    factor(wi, n . wi)`, one light at a time. The backward pass recomputes each term.

    **Arguments:**

    - `normals`: unit vectors.
    - `visibility`: per group, the fraction of each light that reaches each point; `None` for lights
      without shadows.
    - `factor`: computes the diffuse fraction of the light, or the reflectance towards the eye, with
      one row for all channels or one per channel.

    **Returns:** the sum, linear in the lights. Differentiable in all arguments, with a kink at the
    horizon.
    """

    @jax.checkpoint
    def add(total, light_and_visibility):
        light, visible = light_and_visibility
        wi, irradiance = light.incidence(points)
        cosine = _cosine(normals, wi)
        received = cosine if visible is None else cosine * visible
        return total + jnp.moveaxis(irradiance, -1, 0) * received[None] * factor(wi, cosine), None

    total = jnp.zeros((channels, *points.shape[:-1]), points.dtype)
    for group, visible in zip(groups, visibility, strict=True):
        total, _ = jax.lax.scan(add, total, (group.lights, visible))
    return total


def albedo_under(
    groups: list[StackedLights], f0: Float[Array, ""], roughness: Float[Array, "*points"]
) -> Callable[[Float[Array, "*points"]], Float[Array, "*points"]]:
    """Return `directional_albedo` as a function of the cosine, to be called for each light sample.
    For many samples, the sum over roughness is computed in advance.
    """
    if any(len(group.light_indices) > len(group.distinct) for group in groups):
        return eqx.Partial(sum_albedo, albedo_series(f0, roughness))
    return lambda mu: directional_albedo(mu, f0, roughness)


def exit_transmission(
    points: SurfacePoints, f0: Float[Array, ""], angles: AngularLaw
) -> Float[Array, "channels *pixels"]:
    """Compute the factor of the diffuse light that leaves towards the eye (`diffuse_transmission`);
    its average is 1.
    """
    return diffuse_transmission(
        _cosine(points.normals, points.outgoing), f0, points.roughness, angles
    )


def reflected_radiance(
    points: SurfacePoints, groups: list[StackedLights], f0: Float[Array, ""], channels: int
) -> Float[Array, "channels *pixels"]:
    """Compute the specular radiance towards the eye by the Kelemen / Szirmay-Kalos lobe, with the
    shadow of each light. Extended lights have one highlight for all their samples.
    """

    def lobe(wi, specular=points.specular):
        return specular_lobe(
            points.normals,
            wi,
            points.outgoing,
            f0=f0,
            specular=specular,
            roughness=points.roughness,
        )

    has_lobes = [not group.highlights for group in groups]
    radiance = sum_received(
        points.positions,
        points.normals,
        list(compress(groups, has_lobes)),
        list(compress(points.visibility, has_lobes)),
        lambda wi, _: lobe(wi)[None],
        channels,
    )
    if all(has_lobes):
        return radiance
    one, cosine = jnp.ones_like(f0), _cosine(points.normals, points.outgoing)
    specular = jnp.broadcast_to(points.specular, cosine.shape)[None]
    mirrored = 2 * cosine[..., None] * points.normals - points.outgoing
    albedo = directional_albedo(cosine, f0, points.roughness)

    def received(wi):
        return lobe(wi, one) * _cosine(points.normals, wi)

    for group, visible in zip(groups, points.visibility, strict=True):
        for index, highlight in zip(group.distinct, group.highlights, strict=False):
            reflected = specular * highlight.reflected(
                points.positions, mirrored, points.roughness, received, albedo
            )
            row = None if visible is None else visible[group.light_indices.index(index)]
            radiance += reflected if row is None else reflected * row[None]
    return radiance


def single_scattered_radiance(
    points: SurfacePoints,
    groups: list[StackedLights],
    f0: Float[Array, ""],
    single: SingleScattering,
) -> Float[Array, "channels *pixels"]:
    """Compute the radiance of light that is scattered once and leaves where it entered, with the
    shadow of each light.

    Light that the interface reflects does not enter. The surface is assumed flat and uniformly lit
    over a mean free path.
    """
    to_eye = _cosine(points.normals, points.outgoing)
    reflects = albedo_under(groups, f0, points.roughness)

    def scattered(_, cosine):
        return jnp.moveaxis(single.reflected(cosine, to_eye), -1, 0) * (1 - reflects(cosine))[None]

    return sum_received(
        points.positions, points.normals, groups, points.visibility, scattered, single.channels
    )
