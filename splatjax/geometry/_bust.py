"""A bust made of formulas: what is shown when no scan is given."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatjax.scene import Splats

from ._complexion import complexion
from ._head import HIGH, LOW, head_distance
from ._mesh import Mesh
from ._sample import splats_at
from ._scatter import scatter
from ._surface_nets import surface_nets

_MIDDLE = np.asarray([0.0, -30.0, -10.0])


def bust_mesh(*, spacing: float = 1.4) -> Mesh:
    r"""Make a head with neck and shoulders as a closed mesh, life-size: mm, +y up, facing +z, eyes
    near y = 0.

    **Arguments:**

    - `spacing`: of the grid that the mesh is made on, mm: about the length of its edges, from 0.5
      to 1.6.

    **Returns:** the mesh, with normals and texture coordinates: u is the longitude around the
    vertical axis (0.5 the face, the seam at the back), v the angle from the bottom, both seen from
    a point inside the head.

    **Raises:** `ValueError` for another spacing.
    """
    if not 0.5 <= spacing <= 1.6:
        raise ValueError(
            f"spacing is {spacing}; it must lie between 0.5 and 1.6 mm, or the ears grow onto the "
            "head"
        )
    mesh = surface_nets(head_distance, LOW, HIGH, spacing)
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, _coordinates(mesh.corners()))


def bust(count: int = 200_000, *, seed: int = 0) -> Splats:
    r"""Make the bust as splats, in the colors of skin.

    **Arguments:**

    - `count`: of splats, at least 1.
    - `seed`: another spread of the same quality; the same seed gives the same splats.

    **Returns:** splats in Morton order with albedo, specular and roughness, in JAX's default
    precision; their areas add up to that of the mesh. `splatjax.geometry.sample_mesh` describes
    how they are spread.

    **Raises:** `ValueError` when `count` is below 1.
    """
    mesh = bust_mesh()
    points = scatter(mesh, count, seed=seed, relaxations=2)
    splats = splats_at(mesh, points)
    albedo, specular, roughness = (
        jnp.asarray(values, dtype=float) for values in complexion(points.positions(mesh))
    )
    return Splats(
        splats.centers, splats.normals, splats.radii, splats.areas, albedo, specular, roughness
    )


def _coordinates(corners: Float[np.ndarray, "faces 3 3"]) -> Float[np.ndarray, "faces 3 2"]:
    x, y, z = np.moveaxis(corners - _MIDDLE, -1, 0)
    u = np.arctan2(x, z) / (2 * np.pi) + 0.5
    u = np.where((np.ptp(u, axis=1) > 0.5)[:, None] & (u < 0.5), u + 1, u)
    return np.stack([u, 1 - np.arctan2(np.hypot(x, z), y) / np.pi], axis=-1)
