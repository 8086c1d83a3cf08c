"""Meshes and maps from files, and splats sampled from them. trimesh reads the triangles; one check
serves all formats.
"""

import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from splatjax._display import srgb_to_linear
from splatjax._memory import check_memory
from splatjax._records import Numbers
from splatjax.geometry import (
    Mesh,
    Textures,
    cut_below,
    sample_mesh as sample_surface,
    split_creases,
    unit,
)
from splatjax.scene import Splats

from ._files import StrPath, check_units, existing_file, expect, naming, with_y_up
from ._images import read_color, read_map
from ._trimesh import FORMATS, load_with_trimesh, one_sentence

_LUMA = np.asarray([0.299, 0.587, 0.114])  # weights of encoded colors, Rec. 601
_BYTES_PER_SPLAT = 2500.0  # while sampling; measured: 1.2 GB for 683,549 splats
_BYTES_PER_CORNER = 300.0  # per corner of a mesh, from reading the file to sampling splats
# Largest coordinate in units of the file, beyond which areas overflow; most repeats of a texture.
_FARTHEST, _MOST_TILES = 1e12, 1e6
_BORDER = 1e-3  # tolerance of texture coordinates beyond the border of a texture
_ENDS = re.compile(rb'"wrap[ST]" *: *(33071|33648)')  # a glTF texture that does not repeat


class Piece(NamedTuple):
    """Triangles of one material, in the file's unit. Zero normals are estimated later. Missing
    texture coordinates and vertex colors are NaN. The albedo is the product of vertex colors, the
    material's `color` and the `texture`, which is an encoded picture.
    """

    mesh: Any  # a `Mesh` with all its arrays
    color: Float[np.ndarray, " 3"]
    texture: bytes | None


def sample_mesh(
    path: StrPath,
    count: int,
    *,
    mm_per_unit: float,
    albedo: StrPath | None = None,
    specular: StrPath | None = None,
    normal: StrPath | None = None,
    parameters: Mapping[str, StrPath | Numbers] | None = None,
    weights: Callable[[dict[str, Any]], Any] | None = None,
    v_up: bool | None = None,
    up: str = "y",
    crop_min_y: float | None = None,
    crease_angle: float = 40.0,
    seed: int = 0,
    rounded: bool = True,
) -> Splats:
    r"""Sample splats from a mesh file (GLB, glTF, OBJ, PLY, STL, OFF), with its maps and vertex
    colors.

    **Arguments:**

    - `count`: number of splats.
    - `mm_per_unit`: length of the file's unit, mm. glTF prescribes meters (1000), but many scans
      ignore this.
    - `albedo`: a picture, sRGB for integers and linear for floating-point numbers. `None`: the base
      colors of the file, unless all its parts have the same, without textures and vertex colors.
    - `specular`: a gray picture, not decoded: factor of the material's specular strength.
    - `normal`: a tangent-space normal map, not decoded; green points up.
    - `parameters`: parameters of the material by name, such as melanin. Each is a gray picture, not
      decoded, whose integers are scaled to [0, 1]; an array (height, width); or a number.
    - `weights`: computes `Splats.weights` from arrays of the parameters at the splats, such as
      `table.factors` of a `splatjax.fitting.weight_table`.
    - `v_up`: whether v = 0 is the *lower* edge of a map. `None` follows the format: true, except in
      glTF and GLB. If a texture appears upside down, give the opposite.
    - `up`: the file's upward axis, `"y"` or `"z"`; splats have +y up.
    - `crop_min_y`: height, in the file's unit, below which the mesh is removed.
    - `crease_angle`: degrees from 0 to 180, above which an edge between two triangles is hard. It
      is used where the file has no normals, or normals that differ from their triangles by more
      than this angle.
    - `seed`: seed of the random positions.
    - `rounded`: place splats on a curved surface that follows the normals of the mesh. On flat
      triangles, the edge between light and shadow is ragged. Hard edges stay straight.

    **Returns:** splats in mm; `splatjax.geometry.sample_mesh` describes their distribution.

    **Raises:** `FileNotFoundError`, or `ValueError` with the file, the fault and the remedy.
    """
    check_memory(f"{path}: {count} splats", _BYTES_PER_SPLAT * count, "take fewer")
    mesh, textures = read_textured_mesh(
        path,
        mm_per_unit=mm_per_unit,
        albedo=albedo,
        specular=specular,
        normal=normal,
        parameters=parameters,
        weights=weights,
        v_up=v_up,
        up=up,
        crop_min_y=crop_min_y,
        crease_angle=crease_angle,
    )
    with naming(path):
        return sample_surface(mesh, count, textures=textures, seed=seed, rounded=rounded)


def read_textured_mesh(
    path: StrPath,
    *,
    mm_per_unit: float,
    albedo: StrPath | None = None,
    specular: StrPath | None = None,
    normal: StrPath | None = None,
    parameters: Mapping[str, StrPath | Numbers] | None = None,
    weights: Callable[[dict[str, Any]], Any] | None = None,
    v_up: bool | None = None,
    up: str = "y",
    crop_min_y: float | None = None,
    crease_angle: float = 40.0,
) -> tuple[Mesh, Textures]:
    """Read the mesh in a file and its maps. Arguments and errors are those of `sample_mesh`.

    **Returns:** the mesh in mm, and its maps.
    """
    path = existing_file(path)
    check_units(path, mm_per_unit, up)
    expect(
        0 <= crease_angle <= 180,
        path,
        f"crease_angle is {crease_angle}; give degrees from 0 to 180",
    )
    pieces = _read_pieces(path, up)
    flip_v = v_up is not None and v_up == (path.suffix[1:].lower() in ("glb", "gltf"))
    mesh = split_creases(_joined(pieces, mm_per_unit, flip_v), crease_angle)
    textures = Textures(
        albedo=_own_albedo(path, pieces) if albedo is None else read_color(albedo),
        specular=None if specular is None else read_map(specular) @ _LUMA,
        normal=None if normal is None else 2 * read_map(normal) - 1,
        parameters={
            name: read_map(given) @ _LUMA if isinstance(given, str | os.PathLike) else given
            for name, given in (parameters or {}).items()
        },
        weights=weights,
    )
    expect(
        (parameters is None) == (weights is None),
        path,
        f"parameters are {', '.join(parameters or ['None'])}, weights {weights}; give both, or "
        "neither",
    )
    has_maps = any(name is not None for name in (albedo, specular, normal))
    has_maps = has_maps or any(np.ndim(given) for given in textures.parameters.values())
    expect(
        not has_maps or (mesh.uvs is not None and not np.isnan(mesh.uvs).any()),
        path,
        "has no texture coordinates, which maps need; give a mesh with UVs (in glTF, with a "
        "material), or no maps",
    )
    if albedo is not None:
        mesh = Mesh(mesh.vertices, mesh.faces, mesh.normals, mesh.uvs)
    if crop_min_y is not None:
        top = mesh.vertices[:, 1].max() / mm_per_unit
        expect(
            crop_min_y < top,
            path,
            f"crop_min_y is {crop_min_y:g}, which removes the whole mesh; the mesh ends at "
            f"y = {top:g} in the file's unit",
        )
        mesh = cut_below(mesh, crop_min_y * mm_per_unit)
    return mesh, textures


def _read_pieces(path: Path, up: str) -> list[Piece]:
    """Read the triangles of a file with +y up, one piece per material and instance.

    **Raises:** `ValueError` if the file cannot be read, has no triangle, has values that are not
    finite or faces with missing vertices, or does not fit into memory.
    """
    kind = path.suffix[1:].lower()
    expect(kind in FORMATS, path, f"is not a known mesh format; give {', '.join(FORMATS)}")
    with one_sentence(path):
        content = load_with_trimesh(path, kind)
        pieces = {
            name: _piece(table, kind, content["columns"])
            for name, table in content.get("geometry", {"": content}).items()
            if np.size(table.get("faces", ()))
        }
        read = sum(len(piece.mesh.faces) for piece in pieces.values())
        expect(
            content["triangles"] in (None, read),
            path,
            f"{content['triangles']} triangles were expected, and {read} were read; re-export it",
        )
        # Parents come before their children.
        world, placed = {content.get("base_frame"): np.eye(4)}, []
        for node in content.get("graph", [{"geometry": name} for name in pieces]):
            matrix = world[node.get("frame_from")] @ node.get("matrix", np.eye(4))
            world[node.get("frame_to")] = matrix
            if node.get("geometry") in pieces:
                placed.append((pieces[node["geometry"]], matrix))
        expect(
            placed, path, "has no triangle; give a triangle mesh, or read points with read_splats"
        )
        corners = sum(3 * len(piece.mesh.faces) + len(piece.mesh.vertices) for piece, _ in placed)
        check_memory(
            f"{path}: a scene of {corners} corners",
            _BYTES_PER_CORNER * corners,
            "export a part of it",
        )
        repeats = not _ENDS.search(content["contents"])
        return [_placed(piece, matrix, up, repeats) for piece, matrix in placed]


def _piece(table: dict[str, Any], kind: str, columns: dict[str, Any]) -> Piece:
    """Convert the mesh arguments that trimesh reads from a file of a given kind."""
    from trimesh.geometry import triangulate_quads

    vertices, faces = np.asarray(table["vertices"], float), triangulate_quads(table["faces"])
    normals, visual, colors = (table.get(n) for n in ("vertex_normals", "visual", "vertex_colors"))
    uvs, texture, color = np.full((len(faces), 3, 2), np.nan), None, np.ones(3)
    if visual is not None:
        uvs = uvs if visual.uv is None else np.asarray(visual.uv, float)[faces]
        material = visual.material
        image = getattr(material, "image", getattr(material, "baseColorTexture", None))
        texture = image.fp.getvalue() if hasattr(image, "fp") else None
        colors = visual.vertex_attributes.get("color") if colors is None else colors
        # Exporters write a gray Kd together with a map or vertex colors.
        plain = {} if texture or colors is not None else getattr(material, "kwargs", {})
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
    """Transform a piece to its place in the scene, with +y up, and validate it. A reflection also
    reverses the triangles, so that they face outward.
    """
    mesh, linear = piece.mesh, matrix[:3, :3]
    turn = slice(None, None, -1 if np.linalg.det(linear) < 0 else 1)
    vertices, faces = mesh.vertices @ linear.T + matrix[:3, 3], mesh.faces[:, turn]
    normals, uvs = mesh.normals @ np.linalg.pinv(linear), mesh.uvs[:, turn]
    has_uvs = not np.isnan(uvs).all()
    beyond = np.abs(uvs - 0.5).max() - 0.5 if has_uvs else 0.0
    faults = {
        f"vertices that are not finite, or beyond {_FARTHEST:g}": not (
            np.abs(vertices) < _FARTHEST
        ).all(),
        f"faces with indices beyond its {len(vertices)} vertices": not (
            (faces >= 0) & (faces < len(vertices))
        ).all(),
        "normals that are not finite": not np.isfinite(normals).all(),
        "colors outside [0, 1]": ((mesh.colors < 0) | (mesh.colors > 1)).any(),
        f"texture coordinates that are not finite, or beyond {_MOST_TILES:g}": not (
            beyond < _MOST_TILES
        ),
        "a texture on faces without texture coordinates": piece.texture and not has_uvs,
        "a texture that does not repeat, used beyond its border": (
            piece.texture and not repeats and beyond > _BORDER
        ),
    }
    for fault, is_there in faults.items():
        if is_there:
            raise ValueError(f"has {fault}; fix or remove them")
    greatest = np.abs(normals).max(axis=1, keepdims=True)
    normals = np.where(greatest > 0, unit(normals / np.where(greatest > 0, greatest, 1.0)), 0.0)
    return piece._replace(
        mesh=Mesh(with_y_up(vertices, up), faces, with_y_up(normals, up), uvs, mesh.colors)
    )


def _joined(pieces: Sequence[Piece], mm_per_unit: float, flip_v: bool) -> Mesh:
    """Join pieces into one mesh in mm, with one part per piece. Zero normals are unchanged."""
    starts = np.cumsum([0, *(len(piece.mesh.vertices) for piece in pieces[:-1])])
    faces = [piece.mesh.faces + start for piece, start in zip(pieces, starts, strict=True)]
    vertices, normals, uvs, colors = (
        np.concatenate([getattr(piece.mesh, name) for piece in pieces])
        for name in ("vertices", "normals", "uvs", "colors")
    )
    return Mesh(
        mm_per_unit * vertices,
        np.concatenate(faces),
        normals,
        None if np.isnan(uvs).all() else uvs * [1, -1 if flip_v else 1] + [0, 1.0 * flip_v],
        None if np.isnan(colors).all() else np.nan_to_num(colors, nan=1.0),
        np.repeat(np.arange(len(pieces)), [len(triangles) for triangles in faces]),
    )


def _own_albedo(path: Path, pieces: Sequence[Piece]) -> np.ndarray | tuple[np.ndarray, ...] | None:
    """Decode the textures of pieces, and multiply them by the material colors; `None` for pieces of
    one color without textures and vertex colors.
    """
    pictures = {None: np.ones((1, 1, 3))}
    with naming(path), TemporaryDirectory() as folder:
        for encoded in {piece.texture for piece in pieces if piece.texture}:
            (file := Path(folder, "texture")).write_bytes(encoded)
            pictures[encoded] = read_color(file)
    maps = tuple(pictures[piece.texture] * piece.color for piece in pieces)
    is_varied = len(pictures) > 1 or np.ptp([piece.color for piece in pieces], axis=0).any()
    if not is_varied and all(np.isnan(piece.mesh.colors).all() for piece in pieces):
        return None
    return maps if len(maps) > 1 else maps[0]
