"""Files are written whole or not at all."""

import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from test_pictures import some_frame

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


def test_file_takes_its_name_when_the_block_ends_well(tmp_path):
    target = tmp_path / "a.txt"
    with atomic_path(target) as temporary:
        assert temporary.parent == target.parent
        assert temporary.suffix == ".txt"
        temporary.write_text("whole")
        assert not target.exists()
    assert target.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [target]


def _write_half(target):
    with atomic_path(target) as temporary:
        temporary.write_text("ha")
        raise RuntimeError("midway")


def test_failure_leaves_what_stood_there_before(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("before")
    with pytest.raises(RuntimeError, match="midway"):
        _write_half(target)
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]


def test_missing_folder_is_named_with_the_remedy(tmp_path):
    target = tmp_path / "nowhere" / "a.txt"
    with (
        pytest.raises(FileNotFoundError, match="nowhere does not exist; make it first"),
        atomic_path(target),
    ):
        pass


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(IsADirectoryError, match="name a file"), atomic_path(tmp_path):
        pass
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(NotADirectoryError, match="is a file"),
        atomic_path(tmp_path / "file" / "a.txt"),
    ):
        pass


def test_what_a_kill_left_behind_goes_when_the_file_is_written_next(tmp_path):
    """A process that holds its temporary file keeps it; those of other files, and whatever else
    lies there, stay.
    """
    target = tmp_path / "a.txt"
    left, other, alike = (
        tmp_path / name for name in (".a-0123abcd.txt", ".b-0123abcd.txt", ".a-0123abcx.txt")
    )
    for path in (left, other, alike):
        path.write_text("half")
    with atomic_path(target) as first:
        assert not left.exists()
        with atomic_path(target) as second:
            assert first.exists()
            second.write_text("second")
        first.write_text("first")
    assert target.read_text() == "first"
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", other.name, alike.name}


KILLED = """
import os, signal, sys
from splatjax.io import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    temporary.write_text("ha")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_kill_leaves_the_file_that_stood_there(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("before")
    assert (
        subprocess.run([sys.executable, "-c", KILLED, str(target)], check=False).returncode
        == -signal.SIGKILL
    )
    assert target.read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_path(target) as temporary:
        temporary.write_text("after")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


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
def small_files():
    """No file may grow beyond 4 kB: what a full disk does, without one."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_what_stood_there_and_no_litter(tmp_path, name, small_files):
    target = tmp_path / name
    target.write_text("before")
    with pytest.raises(
        OSError, match=r"cannot be written: .*what stood there before is untouched"
    ) as caught:
        WRITERS[name](target)
    assert caught.value.filename == str(target)
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]


@pytest.fixture
def read_only():
    """A folder that may be read and not written to, by root neither: it becomes nobody for a
    while.
    """
    folder = Path(tempfile.mkdtemp())
    (folder / "before").write_text("before")
    folder.chmod(0o555)
    as_root = os.geteuid() == 0
    if as_root:
        os.seteuid(65534)
    yield folder
    if as_root:
        os.seteuid(0)
    folder.chmod(0o755)
    shutil.rmtree(folder)


@pytest.fixture
def ready(tmp_path):
    """Whatever writers import is there."""
    for name, write in WRITERS.items():
        write(tmp_path / name)


@pytest.mark.usefixtures("ready")
def test_a_read_only_folder_is_said(read_only):
    for name, write in WRITERS.items():
        with pytest.raises(PermissionError, match="cannot be written: Permission denied") as caught:
            write(read_only / name)
        assert caught.value.filename == str(read_only / name)
    assert [path.name for path in read_only.iterdir()] == ["before"]


def test_processes_that_write_the_same_file_do_not_remove_what_others_write(tmp_path):
    write = (
        "import sys\nfrom splatjax.io import write_record\nfor i in range(150): "
        "write_record(sys.argv[1], {'i': i})"
    )
    words = [sys.executable, "-c", write, str(tmp_path / "same.json")]
    writers = [subprocess.Popen(words, stderr=subprocess.PIPE, text=True) for _ in range(3)]
    said = [writer.communicate(timeout=300)[1] for writer in writers]
    assert [writer.returncode for writer in writers] == [0, 0, 0], said
    assert [path.name for path in tmp_path.iterdir()] == ["same.json"]
