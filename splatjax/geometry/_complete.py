"""Splats from points that lack normals, radii or areas."""

import numpy as np
from jaxtyping import Float

from splatjax.scene import Splats

from ._morton import morton_order
from ._normals import estimate_normals
from ._sample import covering, make_splats


def complete_splats(
    centers: Float[np.ndarray, "splats 3"],
    *,
    normals: Float[np.ndarray, "splats 3"] | None = None,
    radii: Float[np.ndarray, " splats"] | None = None,
    areas: Float[np.ndarray, " splats"] | None = None,
    albedo: Float[np.ndarray, "splats channels"] | None = None,
    specular: Float[np.ndarray, " splats"] | None = None,
    roughness: Float[np.ndarray, " splats"] | None = None,
) -> Splats:
    """Make splats of points, estimating what is not given, and put them in Morton order.

    **Arguments:**

    - `centers`: mm, at least one.
    - `normals`: unit; `None`: from neighbours (`estimate_normals`).
    - `areas`: mm^2; `None`: those of the Voronoi cells in the tangent planes.
    - `radii`: mm; `None`: as large as the cells ask for, so that no hole is left.

    **Raises:** `ValueError` when something must be estimated and there are fewer than four points.
    """
    count = len(centers)
    if count < 4 and (normals is None or areas is None or radii is None):
        raise ValueError(f"{count} points are too few to estimate normals, radii and areas from; give at least 4, or all three")
    order = morton_order(centers.astype(np.float32))
    centers = centers[order]
    normals, radii, areas, albedo, specular, roughness = (
        None if array is None else array[order] for array in (normals, radii, areas, albedo, specular, roughness)
    )
    if normals is None:
        normals = estimate_normals(centers)
    if radii is None or areas is None:
        cell_areas, cell_radii = covering(centers, normals)
        areas = cell_areas if areas is None else areas
        radii = cell_radii if radii is None else radii
    return make_splats(centers, normals, radii, areas, albedo, specular, roughness)
