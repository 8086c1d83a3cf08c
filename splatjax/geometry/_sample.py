"""From a triangle mesh to splats."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatjax.scene import Splats

from ._cells import Cells, surface_cells
from ._creases import faces_beyond
from ._mesh import Mesh
from ._rounding import Rounding
from ._scatter import SurfacePoints, mirror_images, scatter
from ._textures import Textures, albedo_at, lookup_at, perturbed_normals

_PLAIN = Textures()


def sample_mesh(
    mesh: Mesh,
    count: int,
    *,
    textures: Textures = _PLAIN,
    seed: int = 0,
    rounded: bool = False,
) -> Splats:
    r"""Cover a mesh with splats, spread evenly, its textures baked in.

    **Arguments:**

    - `mesh`: mm, with positive area.
    - `count`: of splats, at least 1.
    - `textures`: looked up bilinearly at every splat.
    - `seed`: another spread of the same quality; the same seed gives the same splats.
    - `rounded`: put them where the surface is that bends as the mesh's normals do, instead of on
      flat triangles.

    **Returns:** splats in Morton order, in JAX's default precision. Their areas are those of their
    Voronoi cells on the surface, all scaled by one factor so that they add up to the surface's
    area; their radii are `1.5 sqrt(area)`, and at least 1.2 times the way to the farthest corner of
    the cell, so that the discs leave no hole.

    **Raises:** `ValueError` for a count below 1, a mesh without area, or textures on a mesh without
    UVs.
    """
    points = scatter(mesh, count, seed=seed)
    return splats_at(mesh, points, textures, rounded=rounded)


def splats_at(
    mesh: Mesh, points: SurfacePoints, textures: Textures = _PLAIN, *, rounded: bool = False
) -> Splats:
    """Make splats of points on a mesh, its textures baked in; otherwise as `sample_mesh`."""
    centers, area = points.positions(mesh), mesh.area()
    if rounded:
        rounding = Rounding(mesh)
        centers, area = rounding.positions(points), rounding.area()
    normals = points.normals(mesh)
    spacing = float(np.sqrt(area / len(centers)))
    images = mirror_images(mesh, faces_beyond(mesh), centers, spacing)
    cells = surface_cells(centers, normals, images, limit=spacing)
    areas = cells.areas * (area / cells.areas.sum())
    radii = _radii(areas, cells, images, spacing)
    specular, roughness, tangent_space = (
        lookup_at(mesh, points, picture)
        for picture in (textures.specular, textures.roughness, textures.normal)
    )
    if tangent_space is not None:
        normals = perturbed_normals(mesh, points, normals, tangent_space)
    albedo = albedo_at(textures, mesh, points)
    return make_splats(centers, normals, radii, areas, albedo, specular, roughness)


def covering(
    centers: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Compute areas (mm^2) and radii (mm) of splats that cover a surface known from these points
    alone.
    """
    cells = surface_cells(centers, normals)
    return cells.areas, _radii(cells.areas, cells)


def _radii(
    areas: Float[np.ndarray, " n"],
    cells: Cells,
    images: Float[np.ndarray, "n images 3"] | None = None,
    spacing: float = 0.0,
) -> Float[np.ndarray, " n"]:
    """Choose radii that leave no hole, and reach little beyond the borders of the surface.

    A splat is seen up to about 0.8 of its radius; a third of a spacing beyond a border, these lie
    in a straight line, and the border itself is covered in full.
    """
    radii = 1.5 * np.sqrt(areas)
    if images is not None and images.shape[1]:
        gaps = 0.5 * np.linalg.norm(images, axis=-1)
        clearance = np.where(gaps > 0, gaps, np.inf).min(axis=1)
        radii = np.minimum(radii, (clearance + 0.5 * spacing) / 0.8)
    return np.maximum(radii, 1.2 * cells.reaches)


def make_splats(
    centers, normals, radii, areas, albedo=None, specular=None, roughness=None
) -> Splats:
    """Put host arrays into a record, in JAX's default precision."""

    def there(array):
        return jnp.asarray(np.asarray(array, np.float64), dtype=float)

    maps = (None if array is None else there(array) for array in (albedo, specular, roughness))
    return Splats(there(centers), there(normals), there(radii), there(areas), *maps)
