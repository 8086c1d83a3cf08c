"""Splats merged into fewer and larger ones: what casts shadows into coarse maps."""

import jax.numpy as jnp
from jax.lax import stop_gradient

from splatjax.scene import Splats

MERGED_COUNTS = 8, 16, 32  # consecutive splats that are near each other in the order of a plan


def merge_splats(splats: Splats, count: int) -> Splats:
    """Merge each `count` consecutive splats into one disc for each side of the surface: at the
    mean of their centers over area, with their mean normal and the sum of their areas.

    Splats of a group that face away from its first one are on the other side. Without any, a disc
    has no extent and no normal.

    **Arguments:**

    - `splats`: in a compact order, a multiple of `count`. Differentiable; the sides are held fixed.

    **Returns:** twice as many discs as there are groups, without maps.
    """

    def grouped(rows):
        return rows.reshape(-1, count, *rows.shape[1:])

    centers, normals = grouped(splats.centers), grouped(splats.normals)
    is_front = jnp.sum(stop_gradient(normals * normals[:, :1]), axis=2) >= 0

    def of_side(belongs):
        areas, squares = (
            jnp.where(belongs, grouped(rows), 0.0) for rows in (splats.areas, splats.radii**2)
        )
        area, square = jnp.sum(areas, axis=1), jnp.sum(squares, axis=1)
        exists = (area > 0) & (square > 0)
        weights = areas / jnp.where(exists, area, 1.0)[:, None]
        center, normal = (jnp.sum(weights[..., None] * rows, axis=1) for rows in (centers, normals))
        length = jnp.sqrt(jnp.where(exists, jnp.sum(normal**2, axis=1), 1.0))
        radius = jnp.where(exists, jnp.sqrt(jnp.where(exists, square, 1.0)), 0.0)
        normal = jnp.where(exists[:, None], normal / length[:, None], 0.0)
        return Splats(center, normal, radius, area)

    front, back = of_side(is_front), of_side(~is_front)
    return Splats(
        *(
            jnp.concatenate([getattr(side, name) for side in (front, back)])
            for name in ("centers", "normals", "radii", "areas")
        )
    )
