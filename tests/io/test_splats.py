"""Splats in PLY files, at once or a part at a time: round trips, other writers, refusals."""

import jax
import meshio
import numpy as np
import pytest
import trimesh
from writers import write_ply, xyz

import splatjax as sj
from splatjax.geometry import complete_splats

SINGLE = 1e-6


def some_splats(count=50):
    """A patch of a sphere, every field given."""
    random = np.random.default_rng(1)
    normals = random.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return complete_splats(
        20 * normals,
        normals=normals,
        radii=random.uniform(0.5, 2, count),
        areas=random.uniform(0.5, 2, count),
        albedo=random.uniform(0, 1, (count, 3)),
        specular=random.uniform(0, 1, count),
        roughness=random.uniform(0, 1, count),
    )


def columns_of(splats, kind="f4"):
    """Return columns in an order of their own."""
    x, y, z = np.asarray(splats.centers, kind).T
    nx, ny, nz = np.asarray(splats.normals, kind).T
    radius = np.asarray(splats.radii, kind)
    return {"nz": nz, "y": y, "radius": radius, "x": x, "nx": nx, "z": z, "ny": ny}


def assert_same(one, other, rtol=SINGLE):
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(np.asarray(b), np.asarray(a, np.float32), rtol=rtol)


def test_splats_come_back_in_order_as_single_precision(tmp_path):
    splats = some_splats()
    sj.write_splats(tmp_path / "a.ply", splats)
    back = sj.read_splats(tmp_path / "a.ply")
    assert_same(splats, back)
    for read in (meshio.read, trimesh.load):
        points = read(tmp_path / "a.ply")
        centers = points.points if hasattr(points, "points") else points.vertices
        np.testing.assert_array_equal(np.asarray(centers, "f4"), np.asarray(splats.centers, "f4"))
    radii = meshio.read(tmp_path / "a.ply").point_data["radius"]
    np.testing.assert_array_equal(radii, np.asarray(splats.radii, np.float32))


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(("text", "order"), [(True, "<"), (False, "<"), (False, ">")])
def test_every_encoding_unit_and_axis(tmp_path, text, order, kind):
    splats = some_splats()
    columns = columns_of(splats, kind) | {"area": np.asarray(splats.areas, kind)}
    path = write_ply(tmp_path / "a.ply", columns, text=text, order=order, comments=["Größe in mm"])
    back = sj.read_splats(path, mm_per_unit=2.0)
    assert back.albedo is None
    given = splats.centers * 2, splats.normals, splats.radii * 2, splats.areas * 4
    assert_same(given, (back.centers, back.normals, back.radii, back.areas))
    turned = sj.read_splats(path, up="z")
    by_radius = np.argsort(turned.radii), np.argsort(splats.radii)
    for name in ("centers", "normals"):
        upright = np.asarray(getattr(splats, name))[:, [0, 2, 1]] * [1, 1, -1]
        found = np.asarray(getattr(turned, name))[by_radius[0]]
        np.testing.assert_allclose(found, upright[by_radius[1]], atol=1e-5)


def test_integers_are_srgb_and_floats_are_linear(tmp_path):
    values = dict(zip(("red", "green", "blue"), (255, 128, 0), strict=True))
    whole = {name: np.full(50, value, np.uint8) for name, value in values.items()}
    linear = {name: np.full(50, value / 255, np.float32) for name, value in values.items()}
    for colors, green in ((whole, 0.2158605), (linear, 128 / 255)):
        path = write_ply(tmp_path / "a.ply", columns_of(some_splats()) | colors)
        np.testing.assert_allclose(sj.read_splats(path).albedo[0], [1, green, 0], atol=1e-6)


def test_raw_points_get_normals_radii_and_areas(tmp_path):
    """1500 points of a ball of 20 mm, spread by the golden angle, each 1/1500 of the sphere."""
    k = np.arange(1500) + 0.5
    y, turn = 1 - 2 * k / 1500, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - y * y)
    points = 20 * np.stack([ring * np.cos(turn), y, ring * np.sin(turn)], axis=1)
    splats = sj.read_splats(write_ply(tmp_path / "a.ply", xyz(points)))
    outward = np.asarray(splats.centers) / 20
    assert (np.asarray(splats.normals) * outward).sum(axis=1).min() > 0.99
    np.testing.assert_allclose(np.asarray(splats.areas).sum(), 4 * np.pi * 400, rtol=0.01)
    np.testing.assert_allclose(np.asarray(splats.areas), 4 * np.pi * 400 / 1500, rtol=0.15)
    assert (np.asarray(splats.radii) > np.sqrt(np.asarray(splats.areas))).all()


def with_value(names, value):
    """Return columns with a value at vertex 7."""
    columns = columns_of(some_splats()) | {"specular": np.ones(50, "f4")}
    columns |= {name: np.ones(50, "f4") for name in ("red", "green", "blue", "area")}
    for name in names.split():
        columns[name] = np.where(np.arange(50) == 7, value, columns[name]).astype("f4")
    return columns


BAD_VALUES = [
    ("x", np.nan, "x y z of vertex 7"),
    ("nz", np.inf, "nx ny nz of vertex 7"),
    ("nx ny nz", 0, "nx ny nz of vertex 7 is 0 0 0"),
    ("radius", 0, "radius of vertex 7 is 0"),
    ("area", -2, "area of vertex 7 is -2"),
    ("red", 3, "red green blue of vertex 7 is 3 1 1"),
    ("specular", -1, "specular of vertex 7 is -1"),
]
SCENE = ("x", "y", "z", "f_dc_0", "scale_0", "rot_0", "opacity")


@pytest.mark.parametrize(
    ("columns", "value"),
    [
        *((with_value(names, value), said) for names, value, said in BAD_VALUES),
        ({"x": np.zeros(5), "y": np.zeros(5)}, "a.ply"),
        (columns_of(some_splats()) | {"red": np.ones(50)}, "red green blue"),
        (xyz(np.eye(3)), "3 points"),
        ({name: np.zeros(5) for name in SCENE}, "Gaussian-splatting scene"),
    ],
)
def test_values_that_no_splat_may_have(tmp_path, columns, value):
    path = write_ply(tmp_path / "a.ply", columns)
    with pytest.raises(ValueError, match=r"a\.ply.*") as caught:
        sj.read_splats(path)
    assert value in str(caught.value)
    if "area" in columns:
        with pytest.raises(ValueError, match=r"a\.ply.*complete the file first") as caught:
            list(sj.SplatFile(path)())
        assert value in str(caught.value)


def test_faces_without_radii_are_told(tmp_path):
    path = tmp_path / "a.ply"
    trimesh.creation.icosphere(subdivisions=1).export(path)
    with pytest.warns(UserWarning, match=r"a\.ply: has faces.*splatjax sample"):
        assert sj.read_splats(path).count == 42
    with pytest.raises(ValueError, match=r"a\.obj: is a mesh"):
        sj.read_splats(path.rename(tmp_path / "a.obj"))


def test_a_channel_too_many_is_refused_and_nothing_is_left(tmp_path):
    splats = some_splats()
    odd = sj.Splats(
        splats.centers, splats.normals, splats.radii, splats.areas, splats.centers[:, :2]
    )
    with pytest.raises(ValueError, match=r"a\.ply: albedo has 2 channels"):
        sj.write_splats(tmp_path / "a.ply", odd)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        sj.write_splats(tmp_path / "nowhere" / "a.ply", splats)
    assert not list(tmp_path.iterdir())


def test_parts_are_all_splats_in_the_order_of_the_file(tmp_path):
    path = tmp_path / "all.ply"
    sj.write_splats(path, some_splats(25))
    file = sj.SplatFile(path, part=10, mm_per_unit=2.0, up="z")
    for parts in (list(file()), list(file())):
        assert [part.count for part in parts] == [10, 10, 5]
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    whole = sj.read_splats(path, mm_per_unit=2.0, up="z")
    orders = np.argsort(together.radii), np.argsort(whole.radii)
    for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(one[orders[0]], np.asarray(other)[orders[1]], rtol=1e-6)


def test_files_that_cannot_be_read_in_parts(tmp_path, x64):
    path = tmp_path / "a.ply"
    with pytest.raises(FileNotFoundError, match=r"a\.ply"):
        sj.SplatFile(path)
    columns = columns_of(some_splats())
    for bad in (
        {"text": True},
        {"lists": {"vertex_index": [np.zeros(3, "i4")]}},
        {"columns": {"x": columns["x"]}},
    ):
        write_ply(path, **{"columns": columns, **bad})
        with pytest.raises(ValueError, match=r"a\.ply: "):
            sj.SplatFile(path)
    sj.write_splats(path, some_splats())
    with pytest.raises(ValueError, match="part is 0"):
        sj.SplatFile(path, part=0)
    data = path.read_bytes()
    path.write_bytes(data[:-4])
    with pytest.raises(ValueError, match=r"a\.ply: .*cut short"):
        sj.SplatFile(path)
    path.write_bytes(data[:-40] + np.float32(np.nan).tobytes() + data[-36:])
    with pytest.raises(ValueError, match=r"a\.ply, from vertex 40: .* of vertex 9 is"):
        list(sj.SplatFile(path, part=10)())
    splats = some_splats()
    far = sj.Splats(splats.centers + 1e7, splats.normals, splats.radii, splats.areas)
    sj.write_splats(path, far)
    if not x64:
        with pytest.raises(ValueError, match=r"a\.ply: its points lie 1e\+07 mm"):
            list(sj.SplatFile(path, part=10)())
