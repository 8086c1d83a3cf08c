"""Splats from points that lack normals, radii or areas."""

import warnings

import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Bool, Float, Int

from splatjax.scene import Splats

from ._normals import estimate_normals
from ._places import distinct, morton_order
from ._sample import covering, make_splats

_NEIGHBORS = 8
_ALONE = 5.0  # times farther from its neighbors than they are from theirs


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
    - `normals`: unit; `None`: from neighbors (`estimate_normals`).
    - `areas`: mm^2; `None`: those of the Voronoi cells in the tangent planes.
    - `radii`: mm; `None`: as large as the cells ask for, so that no hole is left.
    - `albedo`, `specular`, `roughness`: as `Splats` has them; never estimated.

    Points that lie alone are kept, estimated as large as their neighbors are, and a warning states
    how many there are. Points at one place share their area.

    **Returns:** as many splats as points, in JAX's default precision.

    **Raises:** `ValueError` when something must be estimated and there are fewer than four points
    at different places.
    """
    estimated = normals is None or areas is None or radii is None
    if estimated and (count := len(distinct(centers)[0])) < 4:
        raise ValueError(
            f"{count} points are too few to estimate normals, radii and areas from; give at least "
            "4, or all three"
        )
    order = morton_order(centers.astype(np.float32))
    centers = centers[order]
    normals, radii, areas, albedo, specular, roughness = (
        None if array is None else array[order]
        for array in (normals, radii, areas, albedo, specular, roughness)
    )
    if normals is None:
        normals = estimate_normals(centers)
    if radii is None or areas is None:
        cell_areas, cell_radii = _covered(centers, normals)
        areas = cell_areas if areas is None else areas
        radii = cell_radii if radii is None else radii
    return make_splats(centers, normals, radii, areas, albedo, specular, roughness)


def _covered(centers: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute areas and radii; those of points that lie alone are their neighbors', lest their
    discs hide everything.
    """
    first, place = distinct(centers)
    places = centers[first]
    areas, radii = covering(places, normals[first])
    alone, near, distances = _strays(places)
    if alone.any():
        areas[alone], radii[alone] = (
            np.median(each[near[alone]], axis=1) for each in (areas, radii)
        )
        warnings.warn(
            f"{alone.sum()} of {len(centers)} points lie alone, one of them "
            f"{distances[alone].max():.3g} mm from its neighbors;"
            " they are kept, as specks as large as those: remove them if they are noise of a "
            "scanner",
            stacklevel=3,
        )
    return (areas / np.bincount(place))[place], radii[place]


def _strays(
    points: Float[np.ndarray, "n 3"],
) -> tuple[Bool[np.ndarray, " n"], Int[np.ndarray, "n k"], Float[np.ndarray, " n"]]:
    r"""Find points that lie alone: much farther from their neighbors than these are from their
    own, and no one's neighbors.

    So that neither a place where all points are sparse holds one, nor the border between dense and
    sparse.

    **Returns:** whether each is one, its nearest neighbors, and its mean distance to them, mm.

    **Source:** after Breunig et al. 2000, "LOF: Identifying Density-Based Local Outliers", medians
    in the place of means.
    """
    distances, near = scipy.spatial.KDTree(points).query(
        points, k=min(_NEIGHBORS, len(points) - 1) + 1, workers=-1
    )
    mean, near = distances[:, 1:].mean(axis=1), near[:, 1:]
    is_neighbor = np.bincount(near.ravel(), minlength=len(points)) > 0
    return (mean > _ALONE * np.median(mean[near], axis=1)) & ~is_neighbor, near, mean
