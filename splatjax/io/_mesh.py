"""Meshes from GLB and OBJ files, with their maps."""

import json
import os
import struct
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from PIL import Image, UnidentifiedImageError

from splatjax.geometry import Mesh, Textures, cut_below, sample_mesh as sample_surface, unit, vertex_normals
from splatjax.scene import Splats

from ._color import srgb_to_linear

if TYPE_CHECKING:
    import trimesh

_KINDS = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
Name = str | os.PathLike[str]


def sample_mesh(
    path: Name,
    count: int,
    *,
    mm_per_unit: float,
    albedo: Name | None = None,
    specular: Name | None = None,
    normal: Name | None = None,
    v_up: bool | None = None,
    crop_min_y: float | None = None,
    seed: int = 0,
) -> Splats:
    r"""Cover the mesh in a file (GLB, glTF, OBJ, ...) with splats, its maps baked in.

    **Arguments:**

    - `count`: of splats.
    - `mm_per_unit`: length of the file's unit, mm. glTF prescribes metres (1000), yet many scans ignore that.
    - `albedo`: picture, sRGB; `None`: the base color texture that the file itself carries, if any.
    - `specular`: gray picture, not decoded: factor on the material's specular strength.
    - `normal`: tangent-space normal map, not decoded; green points up.
    - `v_up`: whether v = 0 is the *lower* edge of a map. `None` means what the format prescribes: yes for OBJ, no for glTF
      and GLB. Files converted without care need `True`: with the wrong choice the lips land on the chin.
    - `crop_min_y`: what lies below this height, in the file's unit, is cut off.
    - `seed`: another spread of the same quality.

    **Returns:** splats in mm; `splatjax.geometry.sample_mesh` says how they are spread.

    **Raises:** `FileNotFoundError`, or `ValueError` that names the file and says what is wrong and what would be right.
    """
    mesh, textures = read_mesh(path, mm_per_unit=mm_per_unit, v_up=v_up)
    path = Path(path)
    maps = {
        "albedo": None if albedo is None else srgb_to_linear(_read_picture(albedo, "RGB")),
        "specular": None if specular is None else _read_picture(specular, "L"),
        "normal": None if normal is None else _read_picture(normal, "RGB") * 2 - 1,
    }
    textures = Textures(
        albedo=textures.albedo if maps["albedo"] is None else maps["albedo"], specular=maps["specular"], normal=maps["normal"]
    )
    dressed = any(picture is not None for picture in (textures.albedo, textures.specular, textures.normal))
    if dressed and mesh.uvs is None:
        raise ValueError(f"{path}: has no texture coordinates, so no map can be laid on it; give a mesh with UVs, or no maps")
    if crop_min_y is not None:
        top = mesh.vertices[:, 1].max() / mm_per_unit
        if not crop_min_y < top:
            raise ValueError(
                f"{path}: crop_min_y = {crop_min_y:g} leaves nothing; the mesh ends at y = {top:g} in the file's unit"
            )
        mesh = cut_below(mesh, crop_min_y * mm_per_unit)
    try:
        return sample_surface(mesh, count, textures=textures if dressed else None, seed=seed)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_mesh(path: Name, *, mm_per_unit: float, v_up: bool | None = None) -> tuple[Mesh, Textures]:
    """Read all triangles of a file as one mesh in mm, and the base color texture it carries, when it carries just one.

    **Raises:** `FileNotFoundError`, or `ValueError` when the file cannot be read, has no triangle, or values not finite.
    """
    import trimesh  # takes a second, so only where a mesh is read

    path = Path(path)
    if not (np.isfinite(mm_per_unit) and mm_per_unit > 0):
        raise ValueError(f"{path}: mm_per_unit is {mm_per_unit}; it must be the positive length of the file's unit in mm")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    if path.suffix.lower() not in _KINDS:
        raise ValueError(f"{path}: {path.suffix or 'no suffix'} is no mesh format known here; give one of {', '.join(_KINDS)}")
    try:
        whole = BytesIO(_with_materials(path.read_bytes())) if path.suffix.lower() == ".glb" else str(path)
        scene = trimesh.load_scene(whole, file_type=path.suffix.lower()[1:], process=False)
        pieces = [piece for piece in scene.dump() if isinstance(piece, trimesh.Trimesh) and len(piece.faces)]
    except Exception as error:  # each reader of trimesh fails in its own way
        raise ValueError(f"{path}: cannot be read as a mesh ({error}); it is cut short or of another format") from error
    if not pieces:
        raise ValueError(f"{path}: holds no triangle; give a triangle mesh, or read points with read_splats")
    prescribed = path.suffix.lower() not in (".glb", ".gltf")
    upside_down = v_up is not None and v_up != prescribed
    mesh = _join([_piece(path, piece, upside_down) for piece in pieces])
    mesh = Mesh(mesh.vertices * mm_per_unit, mesh.faces, mesh.normals, mesh.uvs)
    textures = [picture for piece in pieces if (picture := _base_color(piece)) is not None]
    own = textures[0] if len(pieces) == 1 and textures else None
    return mesh, Textures(albedo=None if own is None else srgb_to_linear(_values(own, "RGB")))


def _with_materials(glb: bytes) -> bytes:
    """Give the same GLB with a material on everything: trimesh passes over the texture coordinates of what has none."""
    length, kind = struct.unpack_from("<I4s", glb, 12)
    if kind != b"JSON":
        return glb
    content = json.loads(glb[20 : 20 + length])
    bare = [part for mesh in content.get("meshes", []) for part in mesh["primitives"] if "material" not in part]
    if not bare:
        return glb
    materials = content.setdefault("materials", [])
    for part in bare:
        part["material"] = len(materials)
    materials.append({})
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    rest = glb[20 + length :]
    return struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest)) + struct.pack("<I4s", len(text), b"JSON") + text + rest


def _piece(path: Path, piece: "trimesh.Trimesh", upside_down: bool) -> Mesh:
    """Turn a mesh of trimesh, whose texture coordinates have v up when the file keeps to its format, into a record."""
    vertices, faces = np.asarray(piece.vertices, np.float64), np.asarray(piece.faces, np.int64)
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path}: has vertices that are not finite; mend or remove them")
    given = "vertex_normals" in piece._cache.cache and np.asarray(piece.vertex_normals).shape == vertices.shape
    normals = unit(np.array(piece.vertex_normals, np.float64)) if given else vertex_normals(vertices, faces)
    uv = getattr(piece.visual, "uv", None)
    if uv is None or len(uv) != len(vertices):
        return Mesh(vertices, faces, normals)
    uvs = np.array(uv, np.float64)[:, :2]
    if upside_down:
        uvs[:, 1] = 1 - uvs[:, 1]
    return Mesh(vertices, faces, normals, uvs[faces])


def _join(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    uvs = [mesh.uvs for mesh in meshes]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.normals for mesh in meshes]),
        None if any(uv is None for uv in uvs) else np.concatenate([uv for uv in uvs if uv is not None]),
    )


def _base_color(piece: "trimesh.Trimesh") -> Image.Image | None:
    material = getattr(piece.visual, "material", None)
    for name in ("baseColorTexture", "image"):
        picture = getattr(material, name, None)
        if isinstance(picture, Image.Image) and not _stands_in(picture):
            return picture
    return None


def _stands_in(picture: Image.Image) -> bool:
    """Tell the 2 x 2 pixels of one gray that trimesh makes up where there is no texture."""
    return picture.size == (2, 2) and len(np.unique(np.asarray(picture).reshape(4, -1), axis=0)) == 1


def _read_picture(path: Name, mode: str) -> Float[np.ndarray, "..."]:
    """Read a picture as values in [0, 1], row 0 at the top: `RGB` for three channels, `L` for gray."""
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the path")
    try:
        with Image.open(path) as picture:
            return _values(picture, mode)
    except (UnidentifiedImageError, OSError) as error:
        raise ValueError(f"{path}: cannot be read as a picture ({error}); give a whole JPEG, PNG or TIFF") from error


def _values(picture: Image.Image, mode: str) -> Float[np.ndarray, "..."]:
    if picture.mode.startswith("I;16") or picture.mode == "I":  # 16 bits, which `convert` would clip
        gray = np.asarray(picture, np.float64) / 65535
        return gray if mode == "L" else np.repeat(gray[..., None], 3, axis=-1)
    return np.asarray(picture.convert(mode), np.float64) / 255
