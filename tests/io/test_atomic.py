"""Files are written whole or not at all."""

import resource
import sys
from pathlib import Path

import numpy as np
import pytest
from writers import some_frame

from splatjax.geometry import complete_splats
from splatjax.io import (
    atomic_path,
    load_material,
    save_material,
    write_exr,
    write_png,
    write_record,
    write_splats,
)

WRITERS = {
    "a.exr": lambda path: write_exr(path, some_frame(height=40, width=40)),
    "a.png": lambda path: write_png(path, np.random.default_rng(0).uniform(size=(60, 60, 3))),
    "a.ply": lambda path: write_splats(
        path, complete_splats(np.random.default_rng(0).normal(size=(400, 3)))
    ),
    "a.toml": lambda path: save_material(
        load_material("skin"), path, source={"citation": 9000 * "x"}
    ),
    "a.json": lambda path: write_record(path, {"x": 9000 * "x"}),
}


@pytest.fixture
def small_files(monkeypatch):
    """No file may grow beyond 4 kB: what a full disk does, without one. Python would keep half of a
    module's bytecode and never read it again.
    """
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_what_stood_there_and_no_litter(tmp_path, name, small_files):
    target = tmp_path / name
    target.write_text("before")
    for path in (target, Path("/sys", name)):  # nobody may write to the second
        with pytest.raises(OSError, match="cannot be written: ") as caught:
            WRITERS[name](path)
        assert caught.value.filename == str(path)
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]


def _write_half(path):
    with atomic_path(path) as temporary:
        assert (temporary.parent, temporary.suffix) == (path.parent, "")
        temporary.write_text("ha")
        if path.name == "file":
            raise RuntimeError(path)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("nowhere/a", FileNotFoundError),
        ("file/a", FileNotFoundError),
        ("folder", IsADirectoryError),
        ("file", RuntimeError),
    ],
)
def test_a_file_takes_its_name_only_when_the_block_ends_well(tmp_path, name, kind):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("before")
    with pytest.raises(kind, match=name):
        _write_half(tmp_path / name)
    assert (tmp_path / "file").read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 2
