"""A triangle mesh, as geometry sees it: host arrays, mm."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int


class Mesh(eqx.Module):
    r"""Triangles with normals and texture coordinates; NumPy arrays on the host, mm, right-handed.

    Texture coordinates belong to the corners of triangles, not to vertices, so that a mesh stays
    closed across the seams of its texture.

    **Attributes:**

    - `vertices`: mm.
    - `faces`: vertices of each triangle, counterclockwise seen from outside.
    - `normals`: unit, outward, one per vertex.
    - `uvs`: per face and corner; u to the right and v *up*, so that (0, 0) is the lower left corner
      of a texture and (0, 1) the upper left, where its row 0 begins. `None` where there are none.
    - `colors`: of vertices, linear, in [0, 1]. `None` where there are none.
    - `parts`: number of the part that each face belongs to, where parts have textures of their own.
    """

    vertices: Float[np.ndarray, "vertices 3"]
    faces: Int[np.ndarray, "faces 3"]
    normals: Float[np.ndarray, "vertices 3"]
    uvs: Float[np.ndarray, "faces 3 2"] | None = None
    colors: Float[np.ndarray, "vertices 3"] | None = None
    parts: Int[np.ndarray, " faces"] | None = None

    def corners(self) -> Float[np.ndarray, "faces 3 3"]:
        """Return the positions of each triangle's corners, mm."""
        return self.vertices[self.faces]

    def face_areas(self) -> Float[np.ndarray, " faces"]:
        """Compute the area of each triangle, mm^2."""
        a, b, c = np.moveaxis(self.corners(), 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1)

    def area(self) -> float:
        """Compute the area of the surface, mm^2."""
        return float(self.face_areas().sum())

    def volume(self) -> float:
        """Compute the enclosed volume, mm^3: positive for a closed mesh whose triangles face
        outward (divergence theorem).
        """
        a, b, c = np.moveaxis(self.corners(), 1, 0)
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)

    def select(self, keep) -> "Mesh":
        """Return the mesh of the chosen faces (a mask or indices), with all vertices."""
        uvs, parts = (None if each is None else each[keep] for each in (self.uvs, self.parts))
        return Mesh(self.vertices, self.faces[keep], self.normals, uvs, self.colors, parts)


def vertex_normals(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"]
) -> Float[np.ndarray, "vertices 3"]:
    """Compute unit vertex normals as the area-weighted mean of those of the faces around; +y for a
    vertex without faces.
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    face_normals = np.cross(b - a, c - a)
    normals = np.stack(
        [
            np.bincount(faces.ravel(), np.repeat(face_normals[:, axis], 3), len(vertices))
            for axis in range(3)
        ],
        axis=-1,
    )
    return unit(normals)


def unit(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Scale vectors to length one; +y for those of length zero."""
    x, y, z = np.moveaxis(vectors, -1, 0)  # sums over an axis of three are slow
    length = np.sqrt(x * x + y * y + z * z)[..., None]
    up = np.asarray([0.0, 1.0, 0.0], vectors.dtype)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), up)
