"""Splats in PLY files, at once or a part at a time: round trips, and files of other writers."""

import jax
import jax.numpy as jnp
import meshio
import numpy as np
import pytest
import trimesh
from writers import columns_of, some_splats, write_ply

import splatjax as sj

SINGLE = 1e-6


def assert_same(one, other):
    """Compare splats, or other records, whatever the order of their rows."""
    orders = np.argsort(one.radii), np.argsort(other.radii)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(b[orders[1]], a[orders[0]], rtol=SINGLE, atol=20 * SINGLE)


def test_splats_come_back_at_once_and_in_parts(tmp_path):
    splats, path = some_splats(), tmp_path / "a.ply"
    sj.write_splats(path, splats)
    assert_same(splats, sj.read_splats(path))
    vertices = meshio.read(path)
    np.testing.assert_array_equal(vertices.points, np.asarray(splats.centers, np.float32))
    np.testing.assert_array_equal(
        vertices.point_data["radius"], np.asarray(splats.radii, np.float32)
    )
    file = sj.SplatFile(path, part=20, mm_per_unit=2.0, up="z")
    for parts in (list(file()), list(file())):
        assert [part.count for part in parts] == [20, 20, 10]
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    assert_same(sj.read_splats(path, mm_per_unit=2.0, up="z"), together)


@pytest.mark.parametrize("kind", ["f4", "f8"])
@pytest.mark.parametrize(("text", "order"), [(True, "<"), (False, "<"), (False, ">")])
def test_every_encoding_unit_and_axis(tmp_path, text, order, kind):
    splats, comments = some_splats(), ["Größe in cm"]
    columns = columns_of(splats, kind)
    path = write_ply(tmp_path / "a.ply", columns, text=text, order=order, comments=comments)
    turned = [
        vectors[:, [0, 2, 1]] * [1.0, 1, -1]
        for vectors in map(np.asarray, (splats.centers, splats.normals))
    ]
    fields = 10 * turned[0], turned[1], 10 * splats.radii, 100 * splats.areas
    expected = sj.Splats(*(jnp.asarray(field, float) for field in fields))
    assert_same(expected, sj.read_splats(path, mm_per_unit=10.0, up="z"))


@pytest.mark.parametrize(
    ("kind", "scale", "green"),
    [("u1", 1, 0.2158605), ("u2", 257, 0.2158605), ("f4", 1 / 255, 128 / 255)],
)
def test_integers_are_srgb_and_floats_are_linear(tmp_path, kind, scale, green):
    values = zip(("red", "green", "blue"), (255, 128, 0), strict=True)
    colors = {name: np.full(50, value * scale, kind) for name, value in values}
    path = write_ply(tmp_path / "a.ply", columns_of(some_splats()) | colors)
    np.testing.assert_allclose(sj.read_splats(path).albedo[0], [1, green, 0], atol=1e-6)


def test_raw_points_are_completed_and_faces_without_radii_are_told(tmp_path):
    path = tmp_path / "a.ply"
    trimesh.creation.icosphere(radius=20.0).export(path)
    with pytest.warns(UserWarning, match=r"a\.ply: has faces.*splatjax sample"):
        splats = sj.read_splats(path)
    outward = np.asarray(splats.centers) / 20
    assert (np.asarray(splats.normals) * outward).sum(axis=1).min() > 0.99
    np.testing.assert_allclose(np.asarray(splats.areas).sum(), 4 * np.pi * 400, rtol=0.01)
    assert (np.asarray(splats.radii) > np.sqrt(np.asarray(splats.areas))).all()
