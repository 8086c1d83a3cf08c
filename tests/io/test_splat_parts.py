"""A file of splats, read a part at a time."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatjax as sj


@pytest.fixture
def path(tmp_path):
    random = np.random.default_rng(4)
    normals = random.normal(size=(25, 3))
    arrays = random.uniform(-5, 5, (25, 3)), normals / np.linalg.norm(normals, axis=1)[:, None]
    arrays = (
        *arrays,
        random.uniform(0.5, 1, 25),
        random.uniform(0.1, 1, 25),
        random.uniform(0, 1, (25, 3)),
    )
    sj.write_splats(tmp_path / "all.ply", sj.Splats(*(jnp.asarray(each, float) for each in arrays)))
    return tmp_path / "all.ply"


def test_parts_are_all_splats_in_the_order_of_the_file(path):
    file = sj.SplatFile(path, part=10, mm_per_unit=2.0)
    for parts in (list(file()), list(file())):
        assert [part.count for part in parts] == [10, 10, 5]
    together = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    whole = sj.read_splats(path, mm_per_unit=2.0)
    for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(whole), strict=True):
        by_place = (
            np.lexsort(np.asarray(together.centers).T),
            np.lexsort(np.asarray(whole.centers).T),
        )
        np.testing.assert_allclose(one[by_place[0]], np.asarray(other)[by_place[1]], rtol=1e-6)


def test_files_that_cannot_be_read_in_parts_are_refused(path, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.ply"):
        sj.SplatFile(tmp_path / "none.ply")
    text = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n"
    (tmp_path / "text.ply").write_text(text)
    with pytest.raises(ValueError, match=r"text\.ply: .* write them as binary"):
        sj.SplatFile(tmp_path / "text.ply")
    data = path.read_bytes()
    (tmp_path / "bare.ply").write_bytes(
        data.replace(b"property float area\n", b"property float else\n")
    )
    with pytest.raises(
        ValueError,
        match=r"bare\.ply: its vertices have no area.* complete the file first: splatjax\.",
    ):
        sj.SplatFile(tmp_path / "bare.ply")
    (tmp_path / "short.ply").write_bytes(data[:-40])
    with pytest.raises(ValueError, match=r"short\.ply: .*cut short"):
        list(sj.SplatFile(tmp_path / "short.ply", part=10)())
    with pytest.raises(ValueError, match="part is 0"):
        sj.SplatFile(path, part=0)


def test_a_bad_number_is_named_with_its_part(path):
    data = bytearray(path.read_bytes())
    row = 4 * 11
    data[-5 * row : -5 * row + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(bytes(data))
    with pytest.raises(
        ValueError, match=r"all\.ply, from vertex 20: x y z of vertex 0 is not finite"
    ):
        list(sj.SplatFile(path, part=10)())


@pytest.mark.parametrize(
    ("columns", "what"), [((3, 4, 5), "length zero"), ((6,), "it must be positive")]
)
def test_what_a_part_cannot_estimate_is_to_be_completed_first(path, columns, what):
    data, row = bytearray(path.read_bytes()), 4 * 11
    for column in columns:
        begin = len(data) - 5 * row + 4 * column
        data[begin : begin + 4] = bytes(4)
    path.write_bytes(bytes(data))
    with pytest.raises(
        ValueError, match=rf"{what}.*out and complete the file first: splatjax.write_splats"
    ):
        list(sj.SplatFile(path, part=10)())


def test_places_that_numbers_cannot_tell_apart_are_refused(path, tmp_path, float32):
    splats = sj.read_splats(path)
    far = sj.Splats(splats.centers + 1e7, splats.normals, splats.radii, splats.areas)
    sj.write_splats(tmp_path / "far.ply", far)
    with pytest.raises(ValueError, match=r"far\.ply: its points lie 1e\+07 mm from the origin"):
        list(sj.SplatFile(tmp_path / "far.ply", part=10)())
