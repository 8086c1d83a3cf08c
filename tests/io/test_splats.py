"""Splats in PLY files: round trips, other writers and readers, refusals."""

import jax
import meshio
import numpy as np
import plyfile
import pytest

from splatjax.geometry import complete_splats
from splatjax.io import read_splats, write_splats

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


def write_table(path, columns, *, text=False, byte_order="<", name="vertex"):
    """Write columns of any type, in the order given."""
    table = np.empty(
        len(next(iter(columns.values()))),
        [(key, np.asarray(values).dtype.str) for key, values in columns.items()],
    )
    for key, values in columns.items():
        table[key] = values
    plyfile.PlyData(
        [plyfile.PlyElement.describe(table, name)], text=text, byte_order=byte_order
    ).write(str(path))


def columns_of(splats):
    x, y, z = np.asarray(splats.centers, np.float32).T
    nx, ny, nz = np.asarray(splats.normals, np.float32).T
    return {
        "nz": nz,
        "y": y,
        "radius": np.asarray(splats.radii, np.float32),
        "x": x,
        "nx": nx,
        "z": z,
        "ny": ny,
    }


def test_splats_come_back_in_order_as_single_precision(tmp_path):
    splats = some_splats()
    write_splats(tmp_path / "a.ply", splats)
    back = read_splats(tmp_path / "a.ply")
    for one, other in zip(jax.tree.leaves(splats), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(np.asarray(other), np.asarray(one, np.float32), rtol=SINGLE)
    write_splats(tmp_path / "b.ply", back)
    np.testing.assert_array_equal(
        np.asarray(read_splats(tmp_path / "b.ply").centers), np.asarray(back.centers)
    )


def test_another_reader_sees_the_same(tmp_path):
    splats = some_splats()
    write_splats(tmp_path / "a.ply", splats)
    mesh = meshio.read(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.points, np.asarray(splats.centers, np.float32))
    np.testing.assert_array_equal(mesh.point_data["radius"], np.asarray(splats.radii, np.float32))


@pytest.mark.parametrize(("text", "byte_order"), [(True, "="), (False, "<"), (False, ">")])
def test_every_encoding_and_any_order_of_properties(tmp_path, text, byte_order):
    splats = some_splats()
    write_table(tmp_path / "a.ply", columns_of(splats), text=text, byte_order=byte_order)
    back = read_splats(tmp_path / "a.ply", mm_per_unit=2.0)
    np.testing.assert_allclose(
        np.asarray(back.centers), 2 * np.asarray(splats.centers), rtol=SINGLE
    )
    np.testing.assert_allclose(np.asarray(back.normals), np.asarray(splats.normals), atol=SINGLE)
    np.testing.assert_allclose(np.asarray(back.radii), 2 * np.asarray(splats.radii), rtol=SINGLE)
    assert back.albedo is None


def test_areas_scale_with_the_square_of_the_unit(tmp_path):
    splats = some_splats()
    write_splats(tmp_path / "a.ply", splats)
    back = read_splats(tmp_path / "a.ply", mm_per_unit=10.0)
    np.testing.assert_allclose(np.asarray(back.areas), 100 * np.asarray(splats.areas), rtol=SINGLE)


def test_integers_are_srgb_and_floats_are_linear(tmp_path):
    columns = columns_of(some_splats(8))
    bytes_ = {
        name: np.full(8, value, np.uint8)
        for name, value in (("red", 255), ("green", 128), ("blue", 0))
    }
    write_table(tmp_path / "a.ply", columns | bytes_)
    albedo = read_splats(tmp_path / "a.ply").albedo
    assert albedo is not None
    np.testing.assert_allclose(np.asarray(albedo)[0], [1, 0.2158605, 0], atol=1e-6)
    write_table(
        tmp_path / "b.ply",
        columns | {name: values / np.float32(255) for name, values in bytes_.items()},
    )
    albedo = read_splats(tmp_path / "b.ply").albedo
    assert albedo is not None
    np.testing.assert_allclose(np.asarray(albedo)[0], [1, 128 / 255, 0], atol=1e-6)


def test_raw_points_get_normals_radii_and_areas(tmp_path):
    """1500 points of a ball of 20 mm, spread by the golden angle, each 1/1500 of the sphere."""
    k = np.arange(1500) + 0.5
    y, turn = 1 - 2 * k / 1500, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - y * y)
    write_table(
        tmp_path / "a.ply",
        {"x": 20 * ring * np.cos(turn), "y": 20 * y, "z": 20 * ring * np.sin(turn)},
    )
    splats = read_splats(tmp_path / "a.ply")
    outward = np.asarray(splats.centers) / 20
    assert (np.asarray(splats.normals) * outward).sum(axis=1).min() > 0.99
    np.testing.assert_allclose(np.asarray(splats.areas).sum(), 4 * np.pi * 400, rtol=0.01)
    np.testing.assert_allclose(np.asarray(splats.areas), 4 * np.pi * 400 / 1500, rtol=0.15)
    assert (np.asarray(splats.radii) > np.sqrt(np.asarray(splats.areas))).all()


def spoilt(name, value):
    columns = columns_of(some_splats())
    columns[name] = columns[name].copy()
    columns[name][7] = value
    return columns


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (
            spoilt("x", np.nan),
            r"x y z of vertex 7 is not finite \(1 such vertices\); remove or mend",
        ),
        (spoilt("nz", np.inf), r"nx ny nz of vertex 7 is not finite"),
        (
            spoilt("radius", 0),
            r"the radius of vertex 7 is 0 \(1 such vertices\); it must be positive",
        ),
        (spoilt("radius", -2), r"the radius of vertex 7 is -2"),
        (
            {name: values[:0] for name, values in columns_of(some_splats()).items()},
            "is empty, it holds no vertex",
        ),
        ({"x": np.zeros(5), "y": np.zeros(5)}, r"its vertices have no x, y, z; they have x, y"),
        ({name: np.arange(3.0) for name in "xyz"}, "3 points are too few"),
        (
            columns_of(some_splats())
            | {name: np.full(50, 3.0) for name in ("red", "green", "blue")},
            r"red green blue range from 3 to 3; floats are linear albedo in \[0, 1\]",
        ),
        (columns_of(some_splats()) | {"specular": np.full(50, -1.0)}, "specular reaches -1"),
        (
            {
                name: np.zeros(5, np.float32)
                for name in ("x", "y", "z", "f_dc_0", "scale_0", "rot_0", "opacity")
            },
            "is a Gaussian-splatting scene",
        ),
    ],
)
def test_what_is_wrong_is_named_with_the_remedy(tmp_path, columns, said):
    write_table(tmp_path / "bad.ply", columns)
    with pytest.raises(ValueError, match=said) as caught:
        read_splats(tmp_path / "bad.ply")
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'bad.ply'}: ")
    assert "\n" not in message


def test_normals_of_length_zero_are_refused(tmp_path):
    columns = columns_of(some_splats())
    for name in ("nx", "ny", "nz"):
        columns[name] = np.where(np.arange(50) == 3, 0, columns[name]).astype(np.float32)
    write_table(tmp_path / "bad.ply", columns)
    with pytest.raises(ValueError, match="the normal of vertex 3 has length zero"):
        read_splats(tmp_path / "bad.ply")


def test_files_that_are_no_ply_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none.ply: there is no such file"):
        read_splats(tmp_path / "none.ply")
    (tmp_path / "text.ply").write_text("hello\n")
    with pytest.raises(ValueError, match=r"text.ply: cannot be read as PLY"):
        read_splats(tmp_path / "text.ply")
    (tmp_path / "nothing.ply").write_bytes(b"")
    with pytest.raises(ValueError, match=r"nothing.ply: cannot be read as PLY"):
        read_splats(tmp_path / "nothing.ply")
    write_table(tmp_path / "face.ply", {"x": np.zeros(4)}, name="corner")
    with pytest.raises(ValueError, match="has no element `vertex`"):
        read_splats(tmp_path / "face.ply")
    with pytest.raises(ValueError, match="mm_per_unit is 0"):
        read_splats(tmp_path / "face.ply", mm_per_unit=0.0)


@pytest.mark.parametrize("text", [True, False])
def test_files_cut_short_are_refused(tmp_path, text):
    write_table(tmp_path / "a.ply", columns_of(some_splats()), text=text)
    whole = (tmp_path / "a.ply").read_bytes()
    for share in (0.95, 0.5, 0.02):
        (tmp_path / "cut.ply").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(
            ValueError,
            match=r"cut.ply: cannot be read as PLY: .*(it is cut short|its header has no end)",
        ):
            read_splats(tmp_path / "cut.ply")


def test_nothing_is_left_when_writing_fails(tmp_path):
    splats = some_splats()
    with pytest.raises(FileNotFoundError, match="nowhere does not exist; make it first"):
        write_splats(tmp_path / "nowhere" / "a.ply", splats)
    assert not list(tmp_path.iterdir())
