"""Small files of meshes and points, written as their formats prescribe; and a frame to write."""

import base64
import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh
from bodies import unit
from PIL import Image

import splatjax as sj

SQUARE = np.asarray([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]], np.float32)
TRIANGLES = np.asarray([[0, 1, 2], [0, 2, 3]])
UVS = SQUARE[:, :2] / 2  # v = 1 at the top of the square
# Formats, and the options by which trimesh writes them with normals.
SUFFIXES = {
    "ply": {"vertex_normal": True},
    "ascii.ply": {"vertex_normal": True, "encoding": "ascii"},
    "obj": {"include_normals": True},
    "glb": {"include_normals": True},
    "gltf": {"include_normals": True},
    "stl": {},
    "ascii.stl": {"file_type": "stl_ascii"},
    "off": {},
}
_PLY_TYPES = {"u1": "uchar", "u2": "ushort", "i4": "int", "f4": "float", "f8": "double"}


def export(mesh, folder, suffix, **options):
    path, options = Path(folder, f"a.{suffix}"), SUFFIXES[suffix] | options
    if suffix != "gltf":
        mesh.export(path, **options)
        return path
    for name, data in mesh.export(file_type="gltf", **options).items():
        Path(folder, name).write_bytes(data)
    return Path(folder, "model.gltf")


def write_ply(path, columns, lists=None, *, text=False, order="<", comments=()):
    """Write columns of vertices of any type, in their order, and lists of faces by their names."""
    kind = "ascii" if text else {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    table = np.rec.fromarrays([np.asarray(column) for column in columns.values()])
    header = ["ply", f"format {kind} 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {len(table)}")
    for name, column in columns.items():
        header.append(f"property {_PLY_TYPES[np.asarray(column).dtype.str[1:]]} {name}")
    polygons = list(zip(*lists.values(), strict=True)) if lists else []
    header += [f"element face {len(polygons)}"] if lists else []
    for name, values in (lists or {}).items():
        header.append(f"property list uchar {_PLY_TYPES[values[0].dtype.str[1:]]} {name}")
    if text:
        rows = [" ".join(map(repr, row.tolist())) for row in table]
        rows += [" ".join(f"{len(v)} {' '.join(map(str, v))}" for v in row) for row in polygons]
        body = "".join(f"{row}\n" for row in rows).encode()
    else:
        body = table.astype(table.dtype.newbyteorder(order)).tobytes()
        for values in (values for row in polygons for values in row):
            body += bytes([len(values)]) + values.astype(values.dtype.newbyteorder(order)).tobytes()
    path.write_bytes("\n".join([*header, "end_header\n"]).encode() + body)
    return path


def xyz(points, names=("x", "y", "z")):
    return dict(zip(names, np.asarray(points).T, strict=True))


def some_splats(count=50):
    random = np.random.default_rng(1)
    normals = unit(random.normal(size=(count, 3)))
    shares = random.uniform(size=(7, count))
    fields = dict(zip(("radii", "areas", "specular", "roughness"), 0.5 + shares, strict=False))
    return sj.geometry.complete_splats(20 * normals, normals=normals, albedo=shares[4:].T, **fields)


def some_frame(channels=3, gaussians=4, lights=2, height=6, width=5) -> sj.Frame:
    """A frame of noise whose diffuse part is the weighted sum of its layers."""
    random = np.random.default_rng(3)

    def noise(*shape):
        return jnp.asarray(random.uniform(0, 1, shape).astype(np.float32))

    size, colors = (height, width), (height, width, channels)
    layers, weights = noise(gaussians, *colors), noise(gaussians, channels)
    diffuse, specular = (layers * weights[:, None, None]).sum(axis=0), noise(*colors)
    return sj.Frame(
        beauty=diffuse + specular,
        coverage=noise(*size),
        depth=noise(*size).at[0, 0].set(jnp.inf),
        position=noise(*size, 3),
        normal=noise(*size, 3),
        albedo=noise(*colors),
        shadow=noise(lights, *size),
        irradiance=noise(*colors),
        layers=layers,
        weights=weights,
        diffuse=diffuse,
        specular=specular,
        unresolved_fraction=noise(gaussians),
        overflow=jnp.zeros((), jnp.float32),
        single_scattering=noise(*colors) if channels == 1 else None,
    )


def columns_of(splats, kind="f4"):
    vectors = xyz(splats.centers) | xyz(splats.normals, ("nx", "ny", "nz"))
    columns = vectors | {"radius": splats.radii, "area": splats.areas}
    return {name: np.asarray(columns[name], kind) for name in sorted(columns, reverse=True)}


def square(**visual):
    made = trimesh.visual.TextureVisuals(uv=UVS, **visual)
    return trimesh.Trimesh(SQUARE, TRIANGLES, visual=made, process=False)


def gltf(path, mesh=None, **changes):
    """Write the square, or another mesh, as glTF with its data in the file, and with changed
    entries: `mesh_0_primitives_0_mode=6` changes that of the first primitive.
    """
    files = (mesh or square()).export(file_type="gltf")
    content = json.loads(files["model.gltf"])
    for buffer in content["buffers"]:
        data = base64.b64encode(files[buffer["uri"]]).decode()
        buffer["uri"] = f"data:application/octet-stream;base64,{data}"
    for name, value in changes.items():
        *outer, last = [int(key) if key.isdigit() else key for key in name.split("_")]
        place = content
        for key in outer:
            place = place[key]
        place[last] = value
    path.write_text(json.dumps(content))
    return path


def ramp():
    rows = np.linspace(1, 0, 64)[:, None] * np.ones(8)
    return Image.fromarray(
        np.rint(255 * np.stack([rows, 1 - rows, 0 * rows], axis=-1)).astype(np.uint8)
    )
