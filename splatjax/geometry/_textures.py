"""Textures of a mesh, looked up at points of its surface."""

import equinox as eqx
import numpy as np
import scipy  # its parts are loaded where they are used, which takes a third of a second
from jaxtyping import Float

from ._mesh import Mesh, unit
from ._scatter import SurfacePoints


class Textures(eqx.Module):
    r"""Maps of a mesh; NumPy arrays, row 0 at the top, values linear. They repeat beyond [0, 1].

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


def lookup_at(
    mesh: Mesh, points: SurfacePoints, picture: Float[np.ndarray, "h w *channels"] | None
) -> Float[np.ndarray, "n *channels"] | None:
    """Look a picture up at points on a mesh, bilinearly between the centers of its pixels,
    repeating it; `None` for no picture.

    **Raises:** `ValueError` when the mesh has no texture coordinates.
    """
    if picture is None:
        return None
    if mesh.uvs is None:
        raise ValueError(
            "the mesh has no texture coordinates, so no texture can be laid on it; give a mesh "
            "with UVs, or no textures"
        )
    u, v = np.einsum("nc,nci->in", points.barycentrics, mesh.uvs[points.faces])
    height, width = picture.shape[:2]
    at = (1 - v) * height - 0.5, u * width - 0.5
    planes = np.moveaxis(picture.reshape(height, width, -1), -1, 0)
    values = [
        scipy.ndimage.map_coordinates(plane, at, order=1, mode="grid-wrap") for plane in planes
    ]
    return np.stack(values, axis=-1).reshape(len(u), *picture.shape[2:])


def albedo_at(
    textures: Textures, mesh: Mesh, points: SurfacePoints
) -> Float[np.ndarray, "n channels"] | None:
    """Return the albedo of points on a mesh: of its textures, times the colors of its vertices;
    `None` where it has neither.
    """
    if isinstance(textures.albedo, tuple):
        assert mesh.parts is not None
        albedo = np.empty((len(points.faces), 3))
        for part, picture in enumerate(textures.albedo):
            chosen = np.flatnonzero(mesh.parts[points.faces] == part)
            is_plain = picture.shape[:2] == (1, 1)
            own = points.take(chosen)
            albedo[chosen] = picture[0, 0] if is_plain else lookup_at(mesh, own, picture)
    else:
        albedo = lookup_at(mesh, points, textures.albedo)
    if mesh.colors is None:
        return albedo
    colors = mesh.colors[mesh.faces[points.faces]]
    colors = np.clip(np.einsum("nc,nci->ni", points.barycentrics, colors), 0.0, 1.0)
    return colors if albedo is None else albedo * colors


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
