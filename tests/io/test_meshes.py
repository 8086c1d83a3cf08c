"""Meshes from files that other libraries write and that the formats' own texts show; where they
have hard edges, normals end there, and splats do too. Splats in PLY files, at once or a part at a
time.
"""

import dataclasses
import functools
import shutil
from importlib import util
from pathlib import Path

import gsply
import jax
import meshio
import numpy as np
import pytest
import trimesh
from bodies import assert_refused, unit
from PIL import Image
from scipy.spatial import KDTree
from writers import SUFFIXES, columns_of, export, some_splats, write_ply, xyz

import splatjax as sj

MM = 2.0
# Files hold some six digits.
DIGITS = 2e-5
BODIES = {
    "ball": trimesh.creation.icosphere(subdivisions=1, radius=3.0).apply_translation([1, 1, 1]),
    "tube": trimesh.creation.annulus(1.0, 2.0, 1.5, sections=8).apply_translation([-20, 0, 0]),
    "sheet": trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0.2], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False
    ),
}


def with_attributes(body):
    """Return a body with normals that are not quite its own, and colors of 8 bits."""
    mesh, random = BODIES[body], np.random.default_rng(0)
    normals = unit(mesh.vertex_normals + 0.05 * random.normal(size=mesh.vertices.shape))
    colors = random.integers(0, 256, mesh.vertices.shape, dtype=np.uint8)
    return np.array(mesh.vertices), np.array(mesh.faces), normals, colors


def described(vertices, faces):
    a, b, c = np.moveaxis(np.asarray(vertices, float)[faces], 1, 0)
    return np.concatenate([(a + b + c) / 3, np.cross(b - a, c - a)], axis=1)


def compare(path, vertices, faces, normals=None, colors=None, **options):
    """Read a file and compare its triangles; normals and linear colors vertex by vertex."""
    mesh, textures = sj.io.read_textured_mesh(path, mm_per_unit=MM, crease_angle=180.0, **options)
    expected, tolerance = MM * np.asarray(vertices, float), DIGITS * MM * np.abs(vertices).max()
    assert len(mesh.faces) == len(faces)
    distance, _ = KDTree(described(mesh.vertices, mesh.faces)).query(described(expected, faces))
    assert distance.max() < 10 * tolerance
    at = KDTree(mesh.vertices).query(expected[np.unique(faces)])[1]
    assert (mesh.colors is None) == (colors is None)
    for found, given in ((mesh.normals, normals), (mesh.colors, colors)):
        if given is not None:
            np.testing.assert_allclose(found[at], given[np.unique(faces)], atol=1e-4)
    return mesh, textures


@pytest.mark.parametrize("body", BODIES)
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_of_trimesh(tmp_path, suffix, body):
    vertices, faces, normals, colors = with_attributes(body)
    is_bare = suffix.endswith(("stl", "off"))
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
    mesh.visual = mesh.visual if is_bare else trimesh.visual.ColorVisuals(vertex_colors=colors)
    linear = colors / 255 if suffix in ("glb", "gltf") else sj.io.srgb_to_linear(colors / 255)
    path, linear = export(mesh, tmp_path, suffix), None if is_bare else linear
    compare(path, vertices, faces, None if is_bare else normals, linear)
    compare(path, vertices[:, [0, 2, 1]] * [1, 1, -1], faces, None, linear, up="z")
    albedo = sj.sample_mesh(path, 500, mm_per_unit=MM).albedo
    assert (albedo is None) == is_bare
    if not is_bare:
        albedo = np.asarray(albedo)
        assert np.all((albedo > linear.min(axis=0) - 1e-4) & (albedo < linear.max(axis=0) + 1e-4))
        assert np.all(np.std(albedo, axis=0) > 0.01)


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
    stored = shares if color == "f4" else np.rint(shares * greatest)
    columns = {"nz": normals[:, 2], **xyz(vertices), "nx": normals[:, 0]}
    columns |= dict(
        zip(("blue", "red", "green"), stored[:, [2, 0, 1]].astype(color).T, strict=True)
    )
    columns["ny"] = normals[:, 1].astype("f4")
    lists = {"vertex_indices": faces.astype("i4")}
    path = write_ply(tmp_path / "a.ply", columns, lists, text=text, order=order)
    compare(
        path, vertices, faces, normals, shares if color == "f4" else sj.io.srgb_to_linear(shares)
    )


def test_scenes_keep_their_places_and_their_textures(tmp_path):
    """Two balls with textures of their own, one turned, moved and mirrored, and one plain ball."""
    (vertices, faces, _, _), scene = with_attributes("ball"), trimesh.Scene()
    pictures = [Image.new("RGB", (4, 4), color) for color in ((255, 0, 0), (0, 128, 0))]
    turn = trimesh.transformations.euler_matrix(0.3, -0.5, 1.0)
    turn[:3, 3] = [10, 20, 30]
    places = [np.eye(4), turn @ np.diag([-2.0, 1.0, 1.0, 1.0]), turn]
    looks = [{"baseColorTexture": each} for each in pictures]
    for look, place in zip([*looks, {"baseColorFactor": [0, 0, 255, 255]}], places, strict=True):
        material = trimesh.visual.material.PBRMaterial(**look)
        visual = trimesh.visual.TextureVisuals(uv=vertices[:, :2], material=material)
        ball = trimesh.Trimesh(vertices, faces, visual=visual, process=False)
        scene.add_geometry(ball, transform=place)
    moved = [vertices @ place[:3, :3].T + place[:3, 3] for place in places]
    turned = [each + i * len(vertices) for i, each in enumerate((faces, faces[:, ::-1], faces))]
    path = export(scene, tmp_path, "glb")
    mesh, textures = compare(path, np.concatenate(moved), np.concatenate(turned))
    colors = {}
    for part, picture in enumerate(textures.albedo):
        middle = mesh.corners()[mesh.parts == part].mean(axis=(0, 1)) / MM
        nearest = np.argmin([np.linalg.norm(middle - each.mean(axis=0)) for each in moved])
        colors[nearest] = picture[0, 0]
    expected = [(1, 0, 0), (0, 0.2158605, 0), (0, 0, 1)]
    np.testing.assert_allclose([colors[i] for i in range(3)], expected, atol=1e-6)


@pytest.mark.parametrize("texture", [None, Image.new("RGB", (4, 4), (255, 255, 255))])
def test_colors_of_vertices_beside_a_material_of_gltf(tmp_path, texture):
    """Multiplied by its color; one color alone is left to the material, and two are an albedo."""
    vertices, faces, _, colors = with_attributes("ball")

    def ball(blue, **attributes):
        look = {"baseColorTexture": texture, "baseColorFactor": [255, 255, blue, 255]}
        material = trimesh.visual.material.PBRMaterial(**look)
        visual = trimesh.visual.TextureVisuals(uv=vertices[:, :2], material=material)
        visual.vertex_attributes.update(attributes)
        return trimesh.Trimesh(vertices, faces, visual=visual, process=False)

    path = export(ball(0, color=np.insert(colors, 3, 255, axis=1)), tmp_path, "glb")
    _, textures = compare(path, vertices, faces, colors=colors / 255)
    np.testing.assert_array_equal(textures.albedo[0, 0], [1, 1, 0])
    for blue, count in ((0, texture and 2), (255, 2)):
        path = export(trimesh.Scene([ball(0), ball(blue)]), tmp_path, "glb")
        albedo = sj.io.read_textured_mesh(path, mm_per_unit=MM)[1].albedo
        assert (albedo and len(albedo)) == count


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
    + "".join("f {} \\\n{} {} {}\r\n".format(*(i + 1 for i in quad)) for quad in QUADS[1:])
    + "f 1 2 3\nf 1 3 4\n",
}


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_of_the_formats_own_texts(tmp_path, name):
    """Of OBJ, one side is two triangles: polygons may be mixed."""
    (tmp_path / name).write_bytes(EXAMPLES[name].encode())
    mesh, _ = sj.io.read_textured_mesh(tmp_path / name, mm_per_unit=MM)
    np.testing.assert_allclose(
        (len(mesh.faces), trimesh.Trimesh(mesh.vertices, mesh.faces).volume, mesh.area()),
        (12, MM**3, 6 * MM**2),
    )


COUNT = 800
# Degrees: round sides are of 48 facets, whose normals are this much off in the middle.
FACET = 4.0


HARD_BODIES = {
    "box": trimesh.creation.box((20, 24, 16)),
    "cylinder": trimesh.creation.cylinder(10, 24, sections=48),
    "plate with a rib": trimesh.creation.annulus(6, 14, 4, sections=48)
    + trimesh.creation.box((3, 30, 8)).apply_translation((25, 0, 2)),
}


@functools.cache
def points_of(body):
    points, faces = trimesh.sample.sample_surface(HARD_BODIES[body], 40_000, seed=0)
    return KDTree(points), HARD_BODIES[body].face_normals[faces]


@pytest.mark.parametrize(
    ("body", "kind", "rounded"),
    [
        *(("box", kind, True) for kind in (*SUFFIXES, "smooth ply", "smooth obj", "smooth glb")),
        *(
            (body, kind, rounded)
            for body in ("cylinder", "plate with a rib")
            for kind in ("obj", "smooth glb")
            for rounded in (True, False)
        ),
    ],
)
def test_normals_end_at_hard_edges(tmp_path, body, kind, rounded):
    """Files without normals, and files whose normals are the mean of all faces around a vertex. At
    edges and corners splats, seen up to 0.8 of their radius, reach 0.7 spacings beyond at most.
    """
    mesh = HARD_BODIES[body].copy()
    if kind.startswith("smooth"):
        mesh.vertex_normals = np.array(mesh.vertex_normals)
        path = export(mesh, tmp_path, kind.split()[1])
    else:
        without = {"include_normals": False}
        options = {"ply": {"vertex_normal": False}, "obj": without, "glb": without, "gltf": without}
        path = export(mesh, tmp_path, kind, **options.get(kind.split(".")[-1], {}))
    splats = sj.sample_mesh(path, COUNT, mm_per_unit=1.0, rounded=rounded)
    centers, normals = np.asarray(splats.centers), np.asarray(splats.normals)
    tree, normals_there = points_of(body)
    distances, near = tree.query(centers, k=8)
    cosines = np.einsum("nki,ni->nk", normals_there[near], normals).max(axis=1)
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert angles.max() < (0.1 if body == "box" else FACET)
    assert distances[:, 0].max() < 0.5
    np.testing.assert_allclose(float(splats.areas.sum()), mesh.area, rtol=2e-3)
    if body == "box":
        beyond = np.abs(centers) + 0.8 * np.asarray(splats.radii)[:, None] - [10, 12, 8]
        assert beyond[np.abs(normals) < 0.5].max() < 0.7 * (mesh.area / COUNT) ** 0.5


SINGLE = 1e-6


def assert_same(one, other):
    orders = np.argsort(one.radii), np.argsort(other.radii)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(b[orders[1]], a[orders[0]], rtol=SINGLE, atol=20 * SINGLE)


def test_splats_come_back_at_once_and_in_parts(tmp_path):
    splats, path = some_splats(), tmp_path / "a.ply"
    weights = np.random.default_rng(2).uniform(0.1, 2.0, (splats.count, 12, 3))
    splats = dataclasses.replace(splats, weights=weights)
    sj.write_splats(path, splats)
    assert_same(splats, sj.read_splats(path))
    vertices = meshio.read(path)
    for found, given in (
        (vertices.points, splats.centers),
        (vertices.point_data["radius"], splats.radii),
    ):
        np.testing.assert_array_equal(found, np.asarray(given, np.float32))
    file = sj.SplatFile(path, part=20, mm_per_unit=2.0, up="z")
    for parts in (list(file()), list(file())):
        assert [part.count for part in parts] == [20, 20, 10]
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    assert_same(sj.read_splats(path, mm_per_unit=2.0, up="z"), together)


def test_splats_that_cannot_be_written_or_read(tmp_path):
    """Rounding of an albedo can."""
    splats, path = some_splats(), tmp_path / "a.ply"
    sj.write_splats(path, dataclasses.replace(splats, albedo=splats.albedo * 0 + 1 + 5e-6))
    np.testing.assert_array_equal(sj.read_splats(path).albedo, 1)
    dots = dataclasses.replace(splats, radii=0 * splats.radii)
    assert_refused(lambda: sj.write_splats(path, dots), r"a\.ply: radius of vertex 0")
    assert_refused(lambda: sj.write_splats(tmp_path / "a.obj", splats), r"a\.obj: .*\.ply")
    write_ply(path, {name: column[:0] for name, column in columns_of(splats).items()})
    assert_refused(lambda: sj.SplatFile(path), r"a\.ply: has no vertices")


@pytest.mark.parametrize(
    ("color", "scale", "green"),
    [("u1", 1, 0.2158605), ("u2", 257, 0.2158605), ("f4", 1 / 255, 128 / 255)],
)
@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(("text", "order"), [(True, "<"), (False, "<"), (False, ">")])
def test_every_encoding_unit_axis_and_color(tmp_path, text, order, kind, color, scale, green):
    """Colors of whole numbers are sRGB, others linear."""
    splats, comments = some_splats(), ["Größe in cm"]
    values = zip(("red", "green", "blue"), (255, 128, 0), strict=True)
    columns = columns_of(splats, kind) | {n: np.full(50, v * scale, color) for n, v in values}
    path = write_ply(tmp_path / "a.ply", columns, text=text, order=order, comments=comments)
    found = sj.read_splats(path, mm_per_unit=10.0, up="z")
    np.testing.assert_allclose(found.albedo[0], [1, green, 0], atol=1e-6)
    centers, normals = (
        np.asarray(vectors)[:, [0, 2, 1]] * [1.0, 1, -1]
        for vectors in (splats.centers, splats.normals)
    )
    expected = sj.Splats(10 * centers, normals, 10 * splats.radii, 100 * splats.areas)
    assert_same(expected, dataclasses.replace(found, albedo=None))


def test_raw_points_are_completed_and_a_mesh_is_not_points(tmp_path):
    path, ball = tmp_path / "a.ply", trimesh.creation.icosphere(radius=20.0)
    ball.export(path)
    assert_refused(lambda: sj.read_splats(path), r"a\.ply: is a mesh.*splatjax sample")
    trimesh.PointCloud(ball.vertices).export(path)
    splats = sj.read_splats(path)
    assert np.sum(splats.normals * splats.centers / 20, axis=1).min() > 0.99
    np.testing.assert_allclose(np.sum(splats.areas), 4 * np.pi * 400, rtol=0.01)
    assert np.all(splats.radii > np.sqrt(splats.areas))


def test_ellipsoids_of_a_gaussian_splatting_scene_become_discs(tmp_path):
    """A ball of radius 2, written by gsply 0.4.6: any local axis is the flattest and points either
    way, quaternions are not of unit length, and every tenth ellipsoid is faint.
    """
    path = shutil.copy(Path(__file__).with_name("gaussians.ply"), tmp_path)
    with pytest.warns(UserWarning, match="12 of 120 Gaussians are below an opacity of 0.5"):
        ball = sj.read_splats(path, mm_per_unit=10.0)
    np.testing.assert_allclose(ball.normals, unit(ball.centers), atol=1e-5)
    np.testing.assert_allclose(ball.radii, 20 * np.sqrt(0.2 * 0.3), rtol=1e-5)
    np.testing.assert_allclose(ball.albedo, np.tile([0.21404, 0.05088, 1], (108, 1)), atol=1e-5)
    np.testing.assert_allclose(ball.areas.sum(), 4 * np.pi * 20**2, rtol=0.1)
    with pytest.warns(UserWarning, match="0 of 120"):
        assert sj.read_splats(path, opacity=0.1).count == 120
    assert_refused(lambda: sj.read_splats(path, opacity=0.9), r": 0 Gaussians .* 0\.9")
    gsply.plywrite(path, gsply.plyread(path)[:1])
    assert_refused(lambda: sj.read_splats(path, opacity=0.0), r"gaussians\.ply: 1 Gaussians")


def test_a_compressed_gaussian_splatting_scene_is_that_of_its_ply_file(tmp_path, monkeypatch):
    """To the 8 bits of its rotations and sizes."""
    path = shutil.copy(Path(__file__).with_name("gaussians.ply"), tmp_path)
    gsply.write_spz(tmp_path / "it.spz", gsply.plyread(path))
    with pytest.warns(UserWarning, match="12 of 120 Gaussians"):
        ball, found = (sj.read_splats(tmp_path / name) for name in ("gaussians.ply", "it.spz"))
    _, nearest = KDTree(found.centers).query(ball.centers)
    np.testing.assert_allclose(found.centers[nearest], ball.centers, atol=1e-3)
    np.testing.assert_allclose(found.normals[nearest], ball.normals, atol=0.02)
    np.testing.assert_allclose(found.radii[nearest], ball.radii, rtol=0.04)
    np.testing.assert_allclose(found.albedo[nearest], ball.albedo, atol=0.02)
    (tmp_path / "cut.spz").write_bytes((tmp_path / "it.spz").read_bytes()[:200])
    assert_refused(lambda: sj.read_splats(tmp_path / "cut.spz"), r"cut\.spz: cannot be read")
    monkeypatch.setattr(util, "find_spec", lambda name: None)
    assert_refused(lambda: sj.read_splats(tmp_path / "it.spz"), r"it\.spz: .*gsply")
