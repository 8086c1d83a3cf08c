"""Meshes from files that other libraries write and that the formats' own texts show."""

import meshio
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import KDTree
from writers import gltf, write_gltf, write_ply, xyz

from splatjax.io import read_textured_mesh, srgb_to_linear

MM = 2.0
DIGITS = 1e-5
"""Files hold some six digits."""


def bodies():
    """Closed and open, round and with edges, far from the origin."""
    ball = trimesh.creation.icosphere(subdivisions=1, radius=3.0)
    tube = trimesh.creation.annulus(1.0, 2.0, 1.5, sections=8)
    sheet = [[0, 0, 0], [1, 0, 0], [1, 1, 0.2], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    return {
        "ball": (np.array(ball.vertices) + 1, np.array(ball.faces)),
        "tube": (np.array(tube.vertices) - 20, np.array(tube.faces)),
        "sheet": (np.asarray(sheet[0], float), np.asarray(sheet[1])),
    }


BODIES = bodies()


def with_attributes(body):
    """Normals that are not quite the body's own, and colors of 8 bits."""
    vertices, faces = BODIES[body]
    random = np.random.default_rng(len(vertices))
    normals = np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)
    normals += 0.05 * random.normal(size=vertices.shape)
    colors = random.integers(0, 256, vertices.shape, dtype=np.uint8)
    return vertices, faces, normals / np.linalg.norm(normals, axis=1, keepdims=True), colors


def sorted_corners(vertices, faces):
    """Return the corners of triangles, whatever their order and where each begins."""
    corners = np.asarray(vertices, np.float64)[faces]
    starts = np.lexsort(np.moveaxis(np.round(corners, 3) + 0.0, 2, 0)[::-1].reshape(3, -1))
    starts = starts.argsort().reshape(len(corners), 3).argmin(axis=1)
    turned = np.take_along_axis(corners, ((starts[:, None] + np.arange(3)) % 3)[..., None], axis=1)
    return turned[np.lexsort(np.round(turned.reshape(len(turned), -1), 3).T[::-1])]


def compare(path, vertices, faces, normals=None, colors=None, atol=DIGITS, **options):
    """Read a file and compare it, corner by corner; normals and linear colors vertex by vertex."""
    mesh, textures = read_textured_mesh(path, mm_per_unit=MM, crease_angle=180.0, **options)
    expected = MM * np.asarray(vertices, np.float64)
    np.testing.assert_allclose(
        sorted_corners(mesh.vertices, mesh.faces),
        sorted_corners(expected, faces),
        atol=atol * np.abs(expected).max(),
    )
    _, at = KDTree(mesh.vertices).query(expected[np.unique(faces)])
    if normals is not None:
        np.testing.assert_allclose(mesh.normals[at], normals[np.unique(faces)], atol=1e-4)
    assert (mesh.colors is None) == (colors is None)
    if colors is not None:
        np.testing.assert_allclose(mesh.colors[at], colors[np.unique(faces)], atol=1e-4)
    return mesh, textures


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


def export(mesh, folder, suffix, **options):
    """Write a mesh by trimesh; return the file."""
    path, options = folder / f"a.{suffix}", SUFFIXES[suffix] | options
    if suffix == "gltf":
        for name, data in mesh.export(file_type="gltf", **options).items():
            (folder / name).write_bytes(data)
        return folder / "model.gltf"
    mesh.export(path, **options)
    return path


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_of_trimesh(tmp_path, suffix, body):
    vertices, faces, normals, colors = with_attributes(body)
    is_bare = suffix.endswith(("stl", "off"))
    mesh = trimesh.Trimesh(
        vertices,
        faces,
        vertex_normals=normals,
        vertex_colors=None if is_bare else colors,
        process=False,
    )
    linear = colors / 255 if suffix in ("glb", "gltf") else srgb_to_linear(colors / 255)
    path = export(mesh, tmp_path, suffix)
    compare(path, vertices, faces, *((None, None) if is_bare else (normals, linear)))
    turned = vertices[:, [0, 2, 1]] * [1, 1, -1]
    compare(path, turned, faces, None, None if is_bare else linear, up="z")


@pytest.mark.parametrize("kind", ["ply", "ascii.ply", "obj", "stl", "ascii.stl", "off"])
def test_files_of_meshio(tmp_path, kind):
    vertices, faces, _, _ = with_attributes("tube")
    how = {"binary": not kind.startswith("ascii")} if kind.endswith(("ply", "stl")) else {}
    meshio.write(tmp_path / f"a.{kind}", meshio.Mesh(vertices, [("triangle", faces)]), **how)
    compare(tmp_path / f"a.{kind}", vertices, faces)


@pytest.mark.parametrize(("text", "order"), [(True, "<"), (False, "<"), (False, ">")])
@pytest.mark.parametrize("color", ["u1", "u2", "f4"])
def test_ply_of_any_order_and_type(tmp_path, text, order, color):
    vertices, faces, normals, colors = with_attributes("ball")
    shares, greatest = colors / 255, 1 if color == "f4" else np.iinfo(color).max
    stored = (shares * greatest if color == "f4" else np.rint(shares * greatest)).astype(color)
    columns = {"nz": normals[:, 2], **xyz(vertices), "nx": normals[:, 0]}
    columns |= dict(zip(("blue", "red", "green"), stored[:, [2, 0, 1]].T, strict=True))
    columns["ny"] = normals[:, 1].astype("f4")
    path = write_ply(
        tmp_path / "a.ply", columns, {"vertex_indices": faces.astype("i4")}, text=text, order=order
    )
    compare(path, vertices, faces, normals, shares if color == "f4" else srgb_to_linear(shares))


@pytest.mark.parametrize("suffix", ["gltf", "glb"])
@pytest.mark.parametrize("normal", ["f4", "i1", "i2"])
@pytest.mark.parametrize(("color", "width"), [("f4", 3), ("u1", 4), ("u2", 3)])
def test_gltf_of_any_type(tmp_path, suffix, normal, color, width):
    """Triangles and strips; a node that turns by a quarter around z, moves and mirrors."""
    vertices, faces, normals, colors = with_attributes("sheet")
    is_strip = normal == "f4"
    stored = normals if is_strip else np.rint(normals * np.iinfo(normal).max)
    shares = np.concatenate([colors / 255, np.full((len(colors), 1), 0.5)], axis=1)[:, :width]
    arrays = {
        "POSITION": vertices.astype("f4"),
        "NORMAL": stored.astype(normal),
        "COLOR_0": (shares * (1 if color == "f4" else np.iinfo(color).max)).astype(color),
        "indices": np.asarray([1, 2, 0, 3] if is_strip else faces).astype("u1"),
    }
    half = 0.5**0.5
    nodes = [
        {"children": [1], "translation": [5, 0, 0], "rotation": [0, 0, half, half]},
        {"mesh": 0, "scale": [1, 1, -1]},
    ]
    content = gltf(
        arrays, {"NORMAL", "COLOR_0"}, primitive={"mode": 5 if is_strip else 4}, nodes=nodes
    )
    turn = np.asarray([[0, -1, 0], [1, 0, 0], [0, 0, -1]])
    mesh, _ = compare(
        write_gltf(tmp_path / f"a.{suffix}", content),
        vertices @ turn.T + [5, 0, 0],
        faces[:, ::-1],
        None,
        shares[:, :3],
    )
    _, at = KDTree(mesh.vertices).query(MM * (vertices @ turn.T + [5, 0, 0]))
    precision = {"f4": 1e-5, "i2": 1e-4, "i1": 2e-2}[normal]
    np.testing.assert_allclose(mesh.normals[at], normals @ turn.T, atol=precision)


def test_scenes_of_trimesh_keep_their_places_and_their_textures(tmp_path):
    """Two balls with textures of their own, one turned, moved and mirrored, and one plain ball."""
    vertices, faces = BODIES["ball"]
    uvs = np.random.default_rng(0).uniform(0, 1, (len(vertices), 2))
    pictures = [Image.new("RGB", (4, 4), color) for color in ((255, 0, 0), (0, 128, 0))]
    material = trimesh.visual.material.PBRMaterial
    materials = [*(material(baseColorTexture=picture) for picture in pictures)]
    materials.append(material(baseColorFactor=[0, 0, 255, 255]))
    turn = trimesh.transformations.euler_matrix(0.3, -0.5, 1.0)
    turn[:3, 3] = [10, 20, 30]
    places = [np.eye(4), turn @ np.diag([-2.0, 1.0, 1.0, 1.0]), turn]
    scene = trimesh.Scene()
    for i, (own, place) in enumerate(zip(materials, places, strict=True)):
        visual = trimesh.visual.TextureVisuals(uv=uvs if i < 2 else None, material=own)
        ball = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
        scene.add_geometry(ball, geom_name=str(i), transform=place)
    scene.export(tmp_path / "scene.glb")
    moved = [vertices @ place[:3, :3].T + place[:3, 3] for place in places]
    turned = [each + i * len(vertices) for i, each in enumerate((faces, faces[:, ::-1], faces))]
    found, textures = compare(
        tmp_path / "scene.glb", np.concatenate(moved), np.concatenate(turned), atol=1e-4
    )
    assert found.parts is not None
    heights = [found.corners()[found.parts == part].mean(axis=(0, 1))[1] for part in range(3)]
    expected = dict(
        zip(
            [each[:, 1].mean() for each in moved],
            [(1, 0, 0), (0, 0.2158605, 0), (0, 0, 1)],
            strict=True,
        )
    )
    for height, picture in zip(heights, textures.albedo, strict=True):
        nearest = min(expected, key=lambda each: abs(MM * each - height))
        np.testing.assert_allclose(picture[0, 0], expected[nearest], atol=1e-6)


CUBE = [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0], [1, 0, 0], [1, 0, 1], [1, 1, 1], [1, 1, 0]]
QUADS = [[0, 1, 2, 3], [7, 6, 5, 4], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]]
ROWS = "\n".join(" ".join(map(str, row)) for row in CUBE)
EXAMPLES = {
    "cube.ply": "ply\nformat ascii 1.0\ncomment made by Greg Turk\nelement vertex 8\n"
    "property float x\nproperty float y\nproperty float z\nelement face 6\n"
    f"property list uchar int vertex_index\nend_header\n{ROWS}\n"
    + "".join("4 {} {} {} {}\n".format(*quad) for quad in QUADS),
    "cube.off": "OFF\n# of Geomview's manual: polygons with colors\n8 6 12\n"
    f"{ROWS}\n" + "".join("4 {} {} {} {}  255 0 0 # red\n".format(*quad) for quad in QUADS),
    "cube.obj": "# Wavefront, appendix B1\r\ng cube\r\ns off\r\n"
    + "".join(f"v {row} 1.0\r\n" for row in ROWS.split("\n"))
    + "".join("f {} \\\n{} {} {}\r\n".format(*(i + 1 for i in quad)) for quad in QUADS),
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_the_formats_own_texts(tmp_path, name):
    (tmp_path / name).write_bytes(EXAMPLES[name].encode())
    halves = np.asarray(QUADS)[:, [[0, 1, 2], [2, 3, 0]]].reshape(-1, 3)
    mesh, _ = compare(tmp_path / name, CUBE, halves)
    np.testing.assert_allclose(mesh.volume(), MM**3)


def test_mixed_polygons_of_text(tmp_path):
    """A triangle, a quadrilateral and a pentagon: the fans of each have its area."""
    places = [[0, 0], [2, 0], [2, 2], [1, 3], [0, 2], [4, 0], [4, 2]]
    polygons = [[0, 1, 2, 3, 4], [1, 5, 6, 2], [3, 2, 6]]
    (tmp_path / "a.obj").write_text(
        "".join("v {} {} 0\n".format(*place) for place in places)
        + "".join("f " + " ".join(str(i + 1) for i in each) + "\n" for each in polygons)
    )
    columns = xyz(np.column_stack([places, np.zeros(7)]))
    lists = {"vertex_index": [np.asarray(each, "i4") for each in polygons]}
    write_ply(tmp_path / "a.ply", columns, lists, text=True)
    for name in ("a.obj", "a.ply"):
        mesh, _ = read_textured_mesh(tmp_path / name, mm_per_unit=1.0)
        np.testing.assert_allclose((len(mesh.faces), mesh.area()), (6, 5 + 4 + 1))
