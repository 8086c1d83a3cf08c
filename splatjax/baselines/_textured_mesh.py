"""Triangle meshes with textures on the device, for mesh-based baselines."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatjax.geometry import Mesh, Textures
from splatjax.scene import Splats
from splatjax.shading import unit_normals
from splatjax.splatting import Bounds

from ._mesh_raster import Landing, SeenFaces, barycentrics

_OUTSIDE = 1e-6  # how far coordinates may reach beyond the texture


class TexturedMesh(eqx.Module):
    r"""Triangles whose charts lie in the unit square, and their textures; mm.

    **Attributes:** (all floats differentiable)

    - `vertices`, `faces`, `normals`, `uvs`: as in `splatjax.geometry.Mesh`.
    - `albedo`, `specular`, `roughness`, `normal`: as in `splatjax.geometry.Textures`.
    """

    vertices: Float[Array, "vertices 3"]
    faces: Int[Array, "faces 3"]
    normals: Float[Array, "vertices 3"]
    uvs: Float[Array, "faces 3 2"]
    albedo: Float[Array, "h w channels"] | None = None
    specular: Float[Array, "h2 w2"] | None = None
    roughness: Float[Array, "h3 w3"] | None = None
    normal: Float[Array, "h4 w4 3"] | None = None

    @classmethod
    def of(cls, mesh: Mesh, textures: Textures | None = None) -> "TexturedMesh":
        """Put a mesh and its textures on the device, in JAX's default precision.

        **Raises:** `ValueError` for a mesh without texture coordinates, or with some outside the
        unit square.
        """
        if mesh.uvs is None:
            raise ValueError(
                "the mesh has no texture coordinates, which texture-space diffusion needs; "
                "give a mesh with UVs"
            )
        low, high = float(mesh.uvs.min()), float(mesh.uvs.max())
        if low < -_OUTSIDE or high > 1 + _OUTSIDE:
            raise ValueError(
                f"the texture coordinates of the mesh range from {low:g} to {high:g}, and "
                "light is diffused only in the unit square; scale or move the charts into it"
            )

        def on_device(values):
            return None if values is None else jnp.asarray(np.asarray(values, np.float64), float)

        names = ("albedo", "specular", "roughness", "normal")
        maps = [on_device(getattr(textures, name, None)) for name in names]
        vertices, normals, uvs = map(on_device, (mesh.vertices, mesh.normals, mesh.uvs))
        return cls(vertices, jnp.asarray(mesh.faces, jnp.int32), normals, uvs, *maps)

    def corners(self) -> Float[Array, "faces 3 3"]:
        """Return the positions of each triangle's corners, mm."""
        return self.vertices[self.faces]

    def bounds(self) -> Bounds:
        """Compute the bounding sphere, which determines the shadow maps."""
        corners = self.corners().reshape(-1, 3)  # a mesh that was cut has vertices without faces
        center = 0.5 * (jnp.min(corners, axis=0) + jnp.max(corners, axis=0))
        offset = corners - center[None]
        return Bounds(center, 1.001 * jnp.sqrt(jnp.max(jnp.sum(offset * offset, axis=1))))

    def lengths(self) -> tuple[Float[Array, " faces"], Float[Array, " faces"]]:
        """Compute the length on the surface, mm, of a unit step along u and along v; 0 on a face
        without a chart.
        """
        along_u, along_v, _ = self._along()
        return jnp.linalg.norm(along_u, axis=1), jnp.linalg.norm(along_v, axis=1)

    def _along(
        self,
    ) -> tuple[Float[Array, "faces 3"], Float[Array, "faces 3"], Float[Array, " faces"]]:
        """Compute the derivatives of the position in u and v, and twice the area of the chart,
        negative where it is mirrored.
        """
        corners = self.corners()
        edges, steps = corners[:, 1:] - corners[:, :1], self.uvs[:, 1:] - self.uvs[:, :1]
        doubled = steps[:, 0, 0] * steps[:, 1, 1] - steps[:, 0, 1] * steps[:, 1, 0]
        inverse = jnp.where(doubled != 0, 1 / jnp.where(doubled != 0, doubled, 1.0), 0.0)[:, None]
        along_u = inverse * (
            steps[:, 1, 1, None] * edges[:, 0] - steps[:, 0, 1, None] * edges[:, 1]
        )
        along_v = inverse * (
            steps[:, 0, 0, None] * edges[:, 1] - steps[:, 1, 0, None] * edges[:, 0]
        )
        return along_u, along_v, doubled


class SurfaceTexels(eqx.Module):
    """The visible points of a textured mesh, row by row."""

    points: Splats
    """As splats without extent: positions, unit normals, albedo, specular and roughness."""
    uvs: Float[Array, "points 2"]
    seen: SeenFaces

    def picture(self, values: Float[Array, "points *rows"]) -> Float[Array, "height width *rows"]:
        """Arrange values as a picture."""
        return values.reshape(*self.seen.faces.shape, *values.shape[1:])


def surface_texels(mesh: TexturedMesh, landing: Landing, seen: SeenFaces) -> SurfaceTexels:
    """Interpolate position, normal and textures at the visible point of every pixel of a landing.
    Differentiable in the mesh and the landing.

    Where a pixel sees nothing, position and normal are 0.
    """
    points, uvs = surface_points(
        mesh, seen.faces.reshape(-1), barycentrics(landing, seen).reshape(-1, 3)
    )
    is_covered = seen.covered.reshape(-1, 1)
    centers = jnp.where(is_covered, points.centers, 0.0)
    normals = jnp.where(is_covered, points.normals, 0.0)
    return SurfaceTexels(replace(points, centers=centers, normals=normals), uvs, seen)


def surface_points(
    mesh: TexturedMesh, faces: Int[Array, " points"], shares: Float[Array, "points 3"]
) -> tuple[Splats, Float[Array, "points 2"]]:
    r"""Return points of a mesh with its textures, as splats without extent, and their texture
    coordinates. Differentiable.

    **Arguments:**

    - `faces`: face of each point.
    - `shares`: barycentric coordinates of each point in its face.
    """
    carried = jnp.concatenate([mesh.corners(), mesh.normals[mesh.faces], mesh.uvs], axis=2)
    blended = jnp.sum(carried[faces] * shares[..., None], axis=1)
    positions, normals, uvs = blended[:, :3], unit_normals(blended[:, 3:6]), blended[:, 6:]
    if mesh.normal is not None:
        normals = _perturbed(mesh, faces, normals, look_up(mesh.normal, uvs))
    albedo, specular, roughness = (
        None if texture is None else look_up(texture, uvs)
        for texture in (mesh.albedo, mesh.specular, mesh.roughness)
    )
    no_extent = jnp.zeros(len(faces), positions.dtype)
    return Splats(positions, normals, no_extent, no_extent, albedo, specular, roughness), uvs


def look_up(
    picture: Float[Array, "h w *channels"], uvs: Float[Array, "points 2"]
) -> Float[Array, "points *channels"]:
    """Look up a picture at texture coordinates (v up), bilinearly between the centers of its
    pixels, repeating it.
    """
    height, width = picture.shape[:2]
    weights, rows, columns = _four(uvs, height, width)
    trailing = (slice(None), *(None,) * (picture.ndim - 2))
    return sum(
        weight[trailing] * picture[row % height, column % width]
        for weight, row, column in zip(weights, rows, columns, strict=True)
    )


def look_up_charts(
    picture: Float[Array, "h w channels"], valid: Float[Array, "h w"], uvs: Float[Array, "points 2"]
) -> Float[Array, "points channels"]:
    """Look up a picture that is valid only on the charts (where `valid` is 1), from its valid
    texels; 0 if there are none.
    """
    height, width = picture.shape[:2]
    weights, rows, columns = _four(uvs, height, width)
    total = jnp.zeros((len(uvs), picture.shape[2]), picture.dtype)
    share = total[:, 0]
    for weight, row, column in zip(weights, rows, columns, strict=True):
        at = jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)
        trust = weight * valid[at]
        total, share = total + trust[:, None] * picture[at], share + trust
    return jnp.where(share[:, None] > 0, total / jnp.where(share > 0, share, 1.0)[:, None], 0.0)


def _four(uvs: Float[Array, "points 2"], height: int, width: int):
    """Compute weights, rows and columns of the four pixels around points."""
    x, y = uvs[:, 0] * width - 0.5, (1 - uvs[:, 1]) * height - 0.5
    left, top = jnp.floor(x), jnp.floor(y)
    a, b = x - left, y - top
    left, top = left.astype(jnp.int32), top.astype(jnp.int32)
    weights = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    return weights, (top, top, top + 1, top + 1), (left, left + 1, left, left + 1)


def _perturbed(
    mesh: TexturedMesh,
    faces: Int[Array, " points"],
    normals: Float[Array, "points 3"],
    tangent_space,
):
    """Turn tangent-space normals into world space, as `splatjax.geometry` does for splats."""
    along_u, _, doubled = mesh._along()
    along_u, handedness = along_u[faces], jnp.sign(doubled)[faces][:, None]
    tangent = unit_normals(along_u - jnp.sum(along_u * normals, axis=1, keepdims=True) * normals)
    bitangent = handedness * jnp.cross(normals, tangent)
    x, y, z = (tangent_space[:, axis, None] for axis in range(3))
    turned = unit_normals(x * tangent + y * bitangent + z * normals)
    return jnp.where(handedness == 0, normals, turned)
