"""Deferred shading: light is computed at the visible points, by their normals."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Array, Float

from splatjax.geometry import tangent_frames
from splatjax.render import (
    AbstractLighting,
    LightVisibility,
    SurfaceAttributes,
    SurfaceSamples,
    irradiance_at_points,
)
from splatjax.scene import Scene, Splats, StackedLights
from splatjax.shading import unit_normals

_NEIGHBORS = 12
_LEAST_SPREAD = 1e-3  # of the neighbors' mean squared distance: below it a direction has no slope


class LightAtPixels(AbstractLighting):
    """Blends normals and all other attributes of splats, and lights each pixel by the blended
    attributes.

    **Source:** Botsch et al. 2005, "High-Quality Surface Splatting on Today's GPUs", section 4;
    also Zwicker et al. 2001.
    """

    def at_pixels(self, scene, groups, samples):
        return _lit(scene, groups, samples, samples.attributes.normals)


class PhongSplats(Splats):
    """Splats whose normals vary: `n_i + slopes_i (x - p_i)` at a point `x`, not unit.

    **Attributes:**

    - `slopes`: derivative of the normal of each splat, 1/mm, a 3 x 3 matrix, from `normal_slopes`
      or from the curvature of the surface. Differentiable.
    """

    slopes: Float[Array, "splats 9"] = eqx.field(kw_only=True)

    @classmethod
    def of(cls, splats: Splats) -> "PhongSplats":
        """Add the slopes of `normal_slopes` to concrete splats."""
        return cls(**vars(splats), slopes=normal_slopes(splats).reshape(-1, 9))


class NormalFields(AbstractLighting):
    r"""Lights each pixel by the normals of `PhongSplats` there.

    The fields of a pixel's splats are blended, then shaded. The original method shades, then
    blends, which is equal to second order in their differences.

    **Source:** Botsch et al. 2004, "Phong Splatting".
    """

    def attributes(self, scene, light, irradiance, eye):
        splats = scene.splats
        if not isinstance(splats, PhongSplats):
            raise ValueError(
                f"scene.splats are {type(splats).__name__}, whose normals do not vary; give "
                "PhongSplats.of(splats)"
            )
        slopes = splats.slopes.reshape(-1, 3, 3)
        at_origin = splats.normals - jnp.einsum("sij,sj->si", slopes, splats.centers)
        attributes = super().attributes(scene, light, irradiance, eye)
        return dataclasses.replace(attributes, normals=at_origin.T, extra=splats.slopes.T)

    def at_pixels(self, scene, groups, samples):
        blended = samples.attributes
        slopes = blended.extra.reshape(3, 3, -1)
        normals = blended.normals + jnp.einsum("ijp,jp->ip", slopes, samples.positions)
        return _lit(scene, groups, samples, normals)


def normal_slopes(splats: Splats, neighbors: int = _NEIGHBORS) -> Float[Array, "splats 3 3"]:
    r"""Fit the slopes of the normals around each splat, by least squares over its neighbors in the
    plane of the splat, 1/mm.

    **Arguments:**

    - `splats`: concrete, not traced; at least 4.
    - `neighbors`: number of neighbors; those on the far side of a thin part, which face away, do
      not count.

    **Returns:** the slopes; zero along the splat's own normal, and across the line of the neighbors
    if these lie on one line.
    """
    centers, normals = (np.asarray(rows, float) for rows in (splats.centers, splats.normals))
    near = scipy.spatial.KDTree(centers).query(centers, k=min(neighbors + 1, len(centers)))[1][
        :, 1:
    ]
    plane = np.stack(tangent_frames(normals), axis=1)
    counts = np.einsum("ski,si->sk", normals[near], normals) > 0
    offsets = np.einsum("ski,sai->ska", centers[near] - centers[:, None], plane) * counts[..., None]
    turns = normals[near] - normals[:, None]
    spread = np.einsum("ska,skb->sab", offsets, offsets)
    spread += _LEAST_SPREAD * np.trace(spread, axis1=1, axis2=2)[:, None, None] * np.eye(
        2
    ) + np.finfo(float).tiny * np.eye(2)
    slopes = np.einsum("ska,ski->sai", offsets, turns)
    in_space = np.einsum("sai,saj->sij", np.linalg.solve(spread, slopes), plane)
    return jnp.asarray(in_space, splats.centers.dtype)


def _lit(
    scene: Scene,
    groups: list[StackedLights],
    samples: SurfaceSamples,
    normals: Float[Array, "3 points"],
) -> SurfaceAttributes:
    """Compute the light that enters at the visible points, by their normals."""
    material, blended = scene.material, samples.attributes
    lit = [
        None if rows is None else group.per_sample(rows)
        for group, rows in zip(groups, blended.visibility, strict=True)
    ]
    light = LightVisibility(groups, lit, jnp.zeros((), normals.dtype))
    entering = irradiance_at_points(
        material,
        light,
        samples.positions.T,
        unit_normals(normals.T),
        None if blended.albedo is None else blended.albedo.T,
        material.roughness if blended.roughness is None else blended.roughness[0],
    )
    irradiance = None if blended.irradiance is None else entering.entering
    return dataclasses.replace(
        blended, normals=normals, source=entering.source, irradiance=irradiance, extra=None
    )
