"""Attributes of the splats, and the samples of the visible surface that passes 4 and 5 read."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from splatjax import diffusion as _diffusion


class SurfaceAttributes(eqx.Module):
    """Rows that passes 2 and 3 blend (Eq. 1), along the last axis of every array: of the splats, or
    of the visible points.

    **Attributes:**

    - `normals`: of the splats; blended ones are not of unit length.
    - `area`: per splat, mm^2.
    - `source`: irradiance that spreads below the surface.
    - `albedo`, `irradiance`, `specular`, `roughness`: `None` if the splats have none; `irradiance`
      is then `source`.
    - `weights`: factors on the weights of the material; `None` if the splats have none.
    - `visibility`: per group of samples, of each light; `None` for lights that cast no shadows.
    - `single_scattering`: radiance towards the eye, without the albedo; `None` if the material has
      none.
    - `layers`, `derivative`: the layers of pass 4 as `continue_from_splats` prepares them, and
      their derivatives; `centers` are the splats', mm from an origin.
    - `added_source`: the derivative of `source` in a weight of the Gaussians, if it is not zero.
    - `extra`: attributes of another `AbstractLighting`.
    """

    normals: Float[Array, "3 points"]
    area: Float[Array, "1 points"]
    source: Float[Array, "channels points"]
    albedo: Float[Array, "channels points"] | None
    irradiance: Float[Array, "channels points"] | None
    specular: Float[Array, "1 points"] | None
    roughness: Float[Array, "1 points"] | None
    visibility: tuple[Float[Array, "_lights points"] | None, ...]
    single_scattering: Float[Array, "channels points"] | None = None
    weights: Float[Array, "gaussians channels points"] | None = None
    centers: Float[Array, "3 points"] | None = None
    layers: _diffusion.LayerValues | None = None
    derivative: _diffusion.LayerValues | None = None
    added_source: Float[Array, "channels points"] | None = None
    extra: Any = None


class SurfaceSamples(eqx.Module):
    """The visible surface in the pixels of some tiles, along the last axis.

    **Attributes:**

    - `attributes`: blended.
    - `positions`: mm.
    - `depth`: mm along the camera's forward axis.
    - `covered`: whether a surface is visible.
    - `layers`: means and mass at the positions; none before they are computed.
    - `derivative`: of the layers in the logarithms of their variances; `None` if not requested.
    """

    attributes: SurfaceAttributes
    positions: Float[Array, "3 points"]
    depth: Float[Array, " points"]
    covered: Bool[Array, " points"]
    layers: Float[Array, "layers values points"]
    derivative: Float[Array, "layers values points"] | None


def stack_rows(rows: PyTree[Float[Array, "... points"]]) -> Float[Array, "all points"]:
    """Stack the rows of a tree of arrays."""
    leaves = jax.tree.leaves(rows)
    return jnp.concatenate([leaf.reshape(-1, leaf.shape[-1]) for leaf in leaves])


def split_rows(stacked: Float[Array, "all points"], like: PyTree) -> PyTree:
    """Undo `stack_rows`, for a tree of arrays that differs from `like` only in its last axis."""
    leaves, structure = jax.tree.flatten(like)
    sizes = [leaf.size // leaf.shape[-1] for leaf in leaves]
    parts = jax.lax.split(stacked, sizes, axis=0)
    points = stacked.shape[1]
    split = [
        part.reshape(*leaf.shape[:-1], points) for part, leaf in zip(parts, leaves, strict=True)
    ]
    return structure.unflatten(split)
