"""Splats from a textured triangle mesh, or from points without normals, radii or areas."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
import scipy  # submodules load on first use, which takes a third of a second
from jaxtyping import Float

from splatjax.scene import Splats

from ._mesh import Mesh, distinct, faces_beyond, morton_order, unit
from ._normals import estimate_normals
from ._scatter import Rounding, SurfacePoints, mirror_images, scatter, surface_cells


class Textures(eqx.Module):
    r"""Maps of a mesh, as NumPy arrays with linear values and row 0 at the top. They repeat beyond
    [0, 1].

    **Attributes:**

    - `albedo`: diffuse color, linear, in [0, 1]; or one map per part of the mesh, with a single
      pixel for a part without texture.
    - `specular`: factor of the material's specular strength.
    - `roughness`: factor of the material's roughness.
    - `normal`: tangent-space normals in [-1, 1], of any positive length: x along u, y along v
      (*up*), z outward.
    - `parameters`: maps of parameters of the material, such as melanin, or one number for all.
    - `weights`: computes `Splats.weights` from the parameters at the splats, by name, such as
      `factors` of a `splatjax.fitting.WeightTable`.
    """

    albedo: (
        Float[np.ndarray, "h w channels"] | tuple[Float[np.ndarray, "_ _ channels"], ...] | None
    ) = None
    specular: Float[np.ndarray, "h2 w2"] | None = None
    roughness: Float[np.ndarray, "h3 w3"] | None = None
    normal: Float[np.ndarray, "h4 w4 3"] | None = None
    parameters: dict[str, Any] = eqx.field(default_factory=dict, kw_only=True)
    weights: Callable[[dict[str, Any]], Any] | None = eqx.field(default=None, kw_only=True)


def lookup_at(
    mesh: Mesh, points: SurfacePoints, picture: Float[np.ndarray, "h w *channels"] | None
) -> Float[np.ndarray, "n *channels"] | None:
    """Look up a picture at points on a mesh, bilinearly and periodically; `None` without a picture.

    **Raises:** `ValueError` if the mesh has no texture coordinates.
    """
    if picture is None:
        return None
    if picture.shape[:2] == (1, 1):
        return np.broadcast_to(picture[0, 0], (len(points.faces), *picture.shape[2:]))
    if mesh.uvs is None:
        raise ValueError(
            "the mesh has no texture coordinates, which textures need; give a mesh with UVs, "
            "or no textures"
        )
    u, v = np.einsum("nc,nci->in", points.barycentrics, mesh.uvs[points.faces])
    height, width = picture.shape[:2]
    at = (1 - v) * height - 0.5, u * width - 0.5
    values = [
        scipy.ndimage.map_coordinates(plane, at, order=1, mode="grid-wrap")
        for plane in np.moveaxis(picture.reshape(height, width, -1), -1, 0)
    ]
    return np.stack(values, axis=-1).reshape(len(u), *picture.shape[2:])


def albedo_at(
    textures: Textures, mesh: Mesh, points: SurfacePoints
) -> Float[np.ndarray, "n channels"] | None:
    """Compute the albedo at points on a mesh, the product of texture and vertex colors; `None` if
    the mesh has neither.
    """
    if isinstance(textures.albedo, tuple):
        assert mesh.parts is not None
        albedo = np.empty((len(points.faces), 3))
        for part, picture in enumerate(textures.albedo):
            chosen = np.flatnonzero(mesh.parts[points.faces] == part)
            albedo[chosen] = lookup_at(mesh, points.take(chosen), picture)
    else:
        albedo = lookup_at(mesh, points, textures.albedo)
    if mesh.colors is None:
        return albedo
    at_corners = mesh.colors[mesh.faces[points.faces]]
    colors = np.clip(np.einsum("nc,nci->ni", points.barycentrics, at_corners), 0.0, 1.0)
    return colors if albedo is None else albedo * colors


def perturbed_normals(
    mesh: Mesh,
    points: SurfacePoints,
    normals: Float[np.ndarray, "n 3"],
    tangent_space: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Transform tangent-space normals to world space, by the frame of the texture coordinates, and
    normalize them.

    The tangent is the direction of increasing u on the face, made orthogonal to the interpolated
    normal; the bitangent completes the frame on the side of increasing v. Faces with degenerate
    texture coordinates keep the normal.
    """
    assert mesh.uvs is not None
    corners, uvs = mesh.corners()[points.faces], mesh.uvs[points.faces]
    edges, steps = corners[:, 1:] - corners[:, :1], uvs[:, 1:] - uvs[:, :1]
    determinant = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
    handedness = np.sign(determinant)[:, None]
    along_u = handedness * (steps[:, 1, 1, None] * edges[:, 0] - steps[:, 0, 1, None] * edges[:, 1])
    tangent = unit(along_u - np.einsum("ni,ni->n", along_u, normals)[:, None] * normals)
    bitangent = handedness * np.cross(normals, tangent)
    x, y, z = (tangent_space[:, axis, None] for axis in range(3))
    return np.where(handedness == 0, normals, unit(x * tangent + y * bitangent + z * normals))


def sample_mesh(
    mesh: Mesh,
    count: int,
    *,
    textures: Textures = Textures(),
    seed: int = 0,
    rounded: bool = False,
    relaxations: int = 4,
) -> Splats:
    r"""Sample evenly spread splats from a mesh, with its textures.

    **Arguments:**

    - `mesh`: mm, with positive area.
    - `count`: number of splats, at least 1.
    - `textures`: maps that are looked up bilinearly at every splat.
    - `seed`: seed of the random positions; the same seed gives the same splats.
    - `rounded`: place splats on a curved surface that follows the normals of the mesh, instead of
      on flat triangles.
    - `relaxations`: number of times that splats are moved to the centroids of their cells.

    **Returns:** splats in Morton order, in JAX's default precision. The areas are those of the
    Voronoi cells on the surface, scaled by a common factor to sum to the area of the surface. The
    radii are `1.5 sqrt(area)`, and at least 1.2 times the distance of the farthest corner of the
    cell, so that the discs leave no hole.

    **Raises:** `ValueError` for a count below 1, for a mesh without area, and for textures on a
    mesh without UVs.
    """
    points = scatter(mesh, count, seed=seed, relaxations=relaxations)
    centers, area = points.positions(mesh), mesh.area()
    if rounded:
        rounding = Rounding(mesh)
        centers, area = rounding.positions(points), rounding.area()
    normals = points.normals(mesh)
    spacing = float(np.sqrt(area / len(centers)))
    images = mirror_images(mesh, faces_beyond(mesh), centers, spacing)
    areas, reaches, _ = surface_cells(centers, normals, images, limit=spacing)
    areas = areas * (area / areas.sum())
    specular, roughness, tangent_space = (
        lookup_at(mesh, points, getattr(textures, name))
        for name in ("specular", "roughness", "normal")
    )

    def at_points(name: str, given: Any) -> Float[np.ndarray, " n"]:
        given = np.asarray(given, np.float64)
        if given.ndim not in (0, 2):
            raise ValueError(f"{name} has shape {given.shape}; give a gray map, or one number")
        if not given.ndim:
            return np.full(len(centers), given)
        # Rounding could exceed the range of the map.
        return np.clip(np.asarray(lookup_at(mesh, points, given)), given.min(), given.max())

    values = {name: at_points(name, given) for name, given in textures.parameters.items()}
    weights = None if textures.weights is None else textures.weights(values)
    if tangent_space is not None:
        normals = perturbed_normals(mesh, points, normals, tangent_space)
    return Splats(
        centers,
        normals,
        _radii(areas, reaches, images, spacing),
        areas,
        albedo_at(textures, mesh, points),
        specular,
        roughness,
        weights,
    )


def _radii(
    areas: Float[np.ndarray, " n"],
    reaches: Float[np.ndarray, " n"],
    images: Float[np.ndarray, "n images 3"] | None = None,
    spacing: float = 0.0,
) -> Float[np.ndarray, " n"]:
    """Choose radii that leave no hole and extend little beyond the borders of the surface.

    A splat is visible up to about 0.8 of its radius. The visible edges form a straight line a third
    of a spacing beyond a border, so the border itself is fully covered.
    """
    radii = 1.5 * np.sqrt(areas)
    if images is not None and images.shape[1]:
        gaps = 0.5 * np.linalg.norm(images, axis=-1)
        clearance = np.where(gaps > 0, gaps, np.inf).min(axis=1)
        radii = np.minimum(radii, (clearance + 0.5 * spacing) / 0.8)
    return np.maximum(radii, 1.2 * reaches)


_NEIGHBORS = 8
# An isolated point is this many times farther from its neighbors than they are from theirs.
_ALONE = 5.0


def complete_splats(
    centers: Float[np.ndarray, "splats 3"],
    *,
    normals: Float[np.ndarray, "splats 3"] | None = None,
    radii: Float[np.ndarray, " splats"] | None = None,
    areas: Float[np.ndarray, " splats"] | None = None,
    albedo: Float[np.ndarray, "splats channels"] | None = None,
    specular: Float[np.ndarray, " splats"] | None = None,
    roughness: Float[np.ndarray, " splats"] | None = None,
    weights: Float[np.ndarray, "splats gaussians channels"] | None = None,
) -> Splats:
    """Make splats from points: estimate missing fields, and sort the splats in Morton order.

    **Arguments:**

    - `centers`: mm, at least one.
    - `normals`: unit vectors; `None` to estimate them from neighbors (`estimate_normals`).
    - `areas`: mm^2; `None` for the areas of the Voronoi cells in the tangent planes.
    - `radii`: mm; `None` for radii that cover the cells, so that no hole is left.
    - `albedo`, `specular`, `roughness`, `weights`: as in `Splats`; never estimated.

    Isolated points are kept with the size of their neighbors, and a warning reports their number.
    Points at the same place share their area.

    **Returns:** as many splats as points, in JAX's default precision.

    **Raises:** `ValueError` if a field must be estimated from fewer than four distinct points.
    """
    estimated = normals is None or areas is None or radii is None
    if estimated and (count := len(distinct(centers)[0])) < 4:
        raise ValueError(
            f"{count} points are too few to estimate normals, radii and areas from; give at least "
            "4, or all three"
        )
    order = morton_order(centers.astype(np.float32))
    centers = centers[order].astype(np.float64)
    normals, radii, areas, *carried = (
        None if array is None else array[order]
        for array in (normals, radii, areas, albedo, specular, roughness, weights)
    )
    if normals is None:
        normals = estimate_normals(centers)
    if radii is None or areas is None:
        cell_areas, cell_radii = _covered(centers, normals)
        areas = cell_areas if areas is None else areas
        radii = cell_radii if radii is None else radii
    return Splats(centers, normals, radii, areas, *carried)


def _covered(centers: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    r"""Compute areas and radii. Isolated points get those of their neighbors, so that their discs
    do not hide the body.

    A point is isolated if it is much farther from its neighbors than they are from their own, and
    is not a neighbor of any other point. Sparse regions and borders between dense and sparse
    regions therefore contain no isolated points.

    **Source:** after Breunig et al. 2000, "LOF: Identifying Density-Based Local Outliers", with
    medians instead of means.
    """
    first, place = distinct(centers)
    places = centers[first]
    areas, reaches, _ = surface_cells(places, normals[first])
    radii = _radii(areas, reaches)
    distances, near = scipy.spatial.KDTree(places).query(
        places, k=min(_NEIGHBORS, len(places) - 1) + 1, workers=-1
    )
    distances, near = distances[:, 1:].mean(axis=1), near[:, 1:]
    is_neighbor = np.bincount(near.ravel(), minlength=len(places)) > 0
    alone = (distances > _ALONE * np.median(distances[near], axis=1)) & ~is_neighbor
    if alone.any():
        areas[alone], radii[alone] = (
            np.median(values[near[alone]], axis=1) for values in (areas, radii)
        )
        warnings.warn(
            f"{alone.sum()} of {len(centers)} points are isolated, one of them "
            f"{distances[alone].max():.3g} mm from its neighbors; they are kept with the size "
            "of their neighbors, so remove them if they are noise of a scanner",
            stacklevel=3,
        )
    return (areas / np.bincount(place))[place], radii[place]
