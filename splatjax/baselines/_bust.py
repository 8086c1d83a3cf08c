"""The bust with texture coordinates, for methods that work in textures."""

import numpy as np

from splatjax.geometry import Mesh, Textures, bust_mesh, complexion, cut_below

from ._mesh_raster import Landing, capacity_for
from ._texture_space import rasterize_in_texture
from ._textured_mesh import TexturedMesh

_NECK = -105.0  # mm; below this height, shoulders and chest would overlap in the chart
_RIM = 0.002  # fraction of the texture that stays free along each edge


def bust_with_textures(texels: int) -> tuple[Mesh, Textures]:
    r"""Make the head of the bust as a mesh with textures, in its own texture coordinates.

    The coordinates are longitude and latitude as seen from inside the head. Ears, nostrils and neck
    overlap in them, and a texel there has the color of only one of the overlapping parts.

    **Arguments:**

    - `texels`: number of texels along each edge of the textures.

    **Returns:** the mesh as `splatjax.geometry.bust_mesh` makes it, cut off at the neck (mm), and
    its albedo (linear), specular and roughness (factors), `[texels, texels, ...]`.

    **Raises:** `ValueError` for no texels.
    """
    if texels < 1:
        raise ValueError(f"texels is {texels}; give at least 1 along each edge")
    mesh = cut_below(bust_mesh(), _NECK)
    assert mesh.uvs is not None
    low, high = mesh.uvs.min(axis=(0, 1)), mesh.uvs.max(axis=(0, 1))
    mesh = Mesh(
        mesh.vertices,
        mesh.faces,
        mesh.normals,
        _RIM + (1 - 2 * _RIM) * (mesh.uvs - low) / (high - low),
    )
    bare = TexturedMesh.of(mesh)
    capacity = capacity_for(Landing.in_texture(bare.uvs, texels))
    points = rasterize_in_texture(bare, texels, capacity).points
    colors = complexion(np.asarray(points.centers, np.float64))
    return mesh, Textures(*(rows.reshape(texels, texels, *rows.shape[1:]) for rows in colors))
