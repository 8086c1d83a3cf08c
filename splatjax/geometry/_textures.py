"""Textures of a mesh, looked up at points of its surface."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ._mesh import Mesh, unit
from ._scatter import SurfacePoints


class Textures(eqx.Module):
    r"""Pictures that a mesh wears; NumPy arrays, row 0 at the top, values linear. They repeat
    beyond [0, 1].

    **Attributes:**

    - `albedo`: diffuse color, linear, in [0, 1]; or one for each part of the mesh, of one pixel
      where a part is plain.
    - `specular`: factor on the material's specular strength.
    - `roughness`: factor on the material's roughness.
    - `normal`: tangent-space normals in [-1, 1]: x along u, y along v (*up*), z outward; of any
      positive length.
    """

    albedo: (
        Float[np.ndarray, "h w channels"] | tuple[Float[np.ndarray, "_ _ channels"], ...] | None
    ) = None
    specular: Float[np.ndarray, "h2 w2"] | None = None
    roughness: Float[np.ndarray, "h3 w3"] | None = None
    normal: Float[np.ndarray, "h4 w4 3"] | None = None


def lookup(
    picture: Float[np.ndarray, "h w *channels"], uvs: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n *channels"]:
    """Look a picture up at texture coordinates (v up), bilinearly between the centers of its
    pixels, repeating it.
    """
    height, width = picture.shape[:2]
    x = uvs[:, 0] * width - 0.5
    y = (1 - uvs[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    trailing = (slice(None),) + (None,) * (picture.ndim - 2)
    right_share, bottom_share = (x - left)[trailing], (y - top)[trailing]
    rows, columns = (top % height, (top + 1) % height), (left % width, (left + 1) % width)
    upper = (
        picture[rows[0], columns[0]] * (1 - right_share)
        + picture[rows[0], columns[1]] * right_share
    )
    lower = (
        picture[rows[1], columns[0]] * (1 - right_share)
        + picture[rows[1], columns[1]] * right_share
    )
    return upper * (1 - bottom_share) + lower * bottom_share


def worn_albedo(
    textures: Textures | None, mesh: Mesh, points: SurfacePoints
) -> Float[np.ndarray, "n channels"] | None:
    """Give the albedo of points on a mesh: of its textures, times the colors of its vertices;
    `None` where it has neither.
    """
    colors = None
    if mesh.colors is not None:
        colors = np.clip(
            np.einsum("nc,nci->ni", points.barycentrics, mesh.colors[mesh.faces[points.faces]]),
            0.0,
            1.0,
        )
    pictures = None if textures is None else textures.albedo
    if pictures is None:
        return colors
    uvs = texture_coordinates(mesh, points)
    if isinstance(pictures, tuple):
        assert mesh.parts is not None
        parts = mesh.parts[points.faces]
        worn = np.empty((len(parts), pictures[0].shape[-1]))
        for number, picture in enumerate(pictures):
            there = parts == number
            worn[there] = (
                picture[0, 0] if picture.shape[:2] == (1, 1) else lookup(picture, uvs[there])
            )
    else:
        worn = lookup(pictures, uvs)
    return worn if colors is None else worn * colors


def texture_coordinates(mesh: Mesh, points: SurfacePoints) -> Float[np.ndarray, "n 2"]:
    """Give the texture coordinates of points on a mesh.

    **Raises:** `ValueError` when the mesh has none.
    """
    if mesh.uvs is None:
        raise ValueError(
            "the mesh has no texture coordinates, so no texture can be laid on it; give a mesh "
            "with UVs, or no textures"
        )
    return np.einsum("nc,nci->ni", points.barycentrics, mesh.uvs[points.faces])


def perturbed_normals(
    mesh: Mesh,
    points: SurfacePoints,
    normals: Float[np.ndarray, "n 3"],
    tangent_space: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Turn tangent-space normals into world space, in the frame of the mesh's texture coordinates,
    and make them unit.

    The tangent is that of the face (the direction in which u grows), made orthogonal to the
    interpolated normal; the bitangent completes the frame on the side where v grows. A face whose
    texture is degenerate keeps its normal.
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
