"""Triangles of mesh files, as trimesh reads them; checked once, whatever the format."""

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from splatjax._memory import check_memory
from splatjax.geometry import Mesh, unit

from ._files import with_y_up
from ._images import srgb_to_linear
from ._trimesh import FORMATS, load_with_trimesh, one_sentence

_BYTES_PER_CORNER = 300.0  # of a mesh, on its way from the file to splats
_FARTHEST, _MOST_TILES = 1e12, 1e6  # units, beyond which areas overflow; repeats of a texture
_BORDER = 1e-3  # of a texture: coordinates may be off by this much
_ENDS = re.compile(rb'"wrap[ST]" *: *(33071|33648)')  # a texture of glTF that does not repeat


class Piece(NamedTuple):
    """Triangles of one material, in the file's unit.

    Normals are zero where they are to be estimated. Texture coordinates and colors of vertices are
    NaN where there are none. Colors of vertices, the material's `color` and the `texture`, an
    encoded picture, are multiplied.
    """

    mesh: Any  # a `Mesh` with all its arrays
    color: Float[np.ndarray, " 3"]
    texture: bytes | None


def read_pieces(path: Path, up: str) -> list[Piece]:
    """Read the triangles of a file, a piece for each material and place, with +y up.

    **Raises:** `ValueError` when the file cannot be read, has no triangle, values that are not
    finite or faces that name vertices it does not have; or does not fit into memory.
    """
    kind = path.suffix[1:].lower()
    if kind not in FORMATS:
        raise ValueError(f"{path}: is of no mesh format known here; give {', '.join(FORMATS)}")
    with one_sentence(path):
        found = load_with_trimesh(path, kind)
        pieces = {
            name: _piece(table, kind, found["columns"])
            for name, table in found.get("geometry", {"": found}).items()
            if np.size(table.get("faces", ()))
        }
        read = sum(len(piece.mesh.faces) for piece in pieces.values())
        if found["triangles"] not in (None, read):
            raise ValueError(f"{found['triangles']} triangles were expected, and {read} were read")
        # Nodes come after those that they hang on.
        world, placed = {found.get("base_frame"): np.eye(4)}, []
        for node in found.get("graph", [{"geometry": name} for name in pieces]):
            matrix = world[node.get("frame_from")] @ node.get("matrix", np.eye(4))
            world[node.get("frame_to")] = matrix
            if node.get("geometry") in pieces:
                placed.append((pieces[node["geometry"]], matrix))
        if not placed:
            raise ValueError(
                f"{path}: holds no triangle; give a triangle mesh, or read points with read_splats"
            )
        corners = sum(3 * len(each.mesh.faces) + len(each.mesh.vertices) for each, _ in placed)
        size = f"{path}: a scene of {corners} corners"
        check_memory(size, _BYTES_PER_CORNER * corners, "export a part of it")
        repeats = not _ENDS.search(found["contents"])
        return [_placed(piece, matrix, up, repeats) for piece, matrix in placed]


def _piece(table: dict[str, Any], kind: str, columns: dict[str, Any]) -> Piece:
    """Convert the arguments of a mesh as trimesh reads them from a file of some kind."""
    from trimesh.geometry import triangulate_quads

    vertices, faces = np.asarray(table["vertices"], float), triangulate_quads(table["faces"])
    normals, visual, colors = (table.get(n) for n in ("vertex_normals", "visual", "vertex_colors"))
    uvs, texture, color = np.full((len(faces), 3, 2), np.nan), None, np.ones(3)
    if visual is not None:
        uvs = uvs if visual.uv is None else np.asarray(visual.uv, float)[faces]
        material = visual.material
        image = getattr(material, "image", getattr(material, "baseColorTexture", None))
        texture = image.fp.getvalue() if hasattr(image, "fp") else None
        # Programs that lay a map leave a gray Kd behind.
        plain = {} if texture else getattr(material, "kwargs", {})
        factor = getattr(material, "baseColorFactor", None)
        color = color * plain.get("kd", 1.0) if factor is None else factor[:3] / 255
    wedges = columns.get("face", {}).get("texcoord")
    if wedges is not None:
        uvs = wedges.astype(float).reshape(-1, 3, 2)
    if colors is None:
        colors = np.full(vertices.shape, np.nan)
    else:
        are_whole = colors.dtype.kind == "u"
        colors = colors[:, :3] / (np.iinfo(colors.dtype).max if are_whole else 1)
        is_linear = kind in ("glb", "gltf") or (kind == "ply" and not are_whole)
        colors = colors if is_linear else srgb_to_linear(colors)
    normals = np.zeros(vertices.shape) if normals is None else np.asarray(normals, float)
    return Piece(Mesh(vertices, faces, normals, uvs, colors), color, texture)


def _placed(piece: Piece, matrix: Float[np.ndarray, "4 4"], up: str, repeats: bool) -> Piece:
    """Move a piece to its place in the scene, turn it so that +y is up, and validate it. A mirror
    turns its triangles around, so that they face outward again.
    """
    mesh, linear = piece.mesh, matrix[:3, :3]
    turn = slice(None, None, -1 if np.linalg.det(linear) < 0 else 1)
    vertices, faces = mesh.vertices @ linear.T + matrix[:3, 3], mesh.faces[:, turn]
    normals, uvs = mesh.normals @ np.linalg.pinv(linear), mesh.uvs[:, turn]
    has_uvs = not np.isnan(uvs).all()
    beyond = np.abs(uvs - 0.5).max() - 0.5 if has_uvs else 0.0
    ends = beyond > _BORDER and not repeats
    faults = {
        f"vertices that are not finite, or reach {_FARTHEST:g}": not (
            np.abs(vertices) < _FARTHEST
        ).all(),
        f"faces of other vertices than its {len(vertices)}": not (
            (faces >= 0) & (faces < len(vertices))
        ).all(),
        "normals that are not finite": not np.isfinite(normals).all(),
        "colors outside [0, 1]": ((mesh.colors < 0) | (mesh.colors > 1)).any(),
        f"texture coordinates that are not finite, or reach {_MOST_TILES:g}": not (
            beyond < _MOST_TILES
        ),
        "a texture on faces without texture coordinates": piece.texture and not has_uvs,
        "a texture that does not repeat, used beyond its border": piece.texture and ends,
    }
    for fault, is_there in faults.items():
        if is_there:
            raise ValueError(f"has {fault}; fix or remove them")
    greatest = np.abs(normals).max(axis=1, keepdims=True)
    normals = np.where(greatest > 0, unit(normals / np.where(greatest > 0, greatest, 1.0)), 0.0)
    vertices, normals = with_y_up(vertices, up), with_y_up(normals, up)
    return piece._replace(mesh=Mesh(vertices, faces, normals, uvs, mesh.colors))
