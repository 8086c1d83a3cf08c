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


def _write_half(target):
    with atomic_path(target) as temporary:
        assert (temporary.parent, temporary.suffix) == (target.parent, target.suffix)
        temporary.write_text("ha")
        raise RuntimeError("midway")


def test_a_file_takes_its_name_only_when_the_block_ends_well(tmp_path):
    target = tmp_path / "a.txt"
    with atomic_path(target) as temporary:
        temporary.write_text("whole")
        assert not target.exists()
    with pytest.raises(RuntimeError, match="midway"):
        _write_half(target)
    assert target.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("nowhere/a.txt", FileNotFoundError),
        ("folder", IsADirectoryError),
        ("file/a.txt", FileNotFoundError),
    ],
)
def test_places_that_cannot_be_written_to(tmp_path, name, kind):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    with pytest.raises(kind, match=name), atomic_path(tmp_path / name):
        pass


KILLED = """
import os, signal, sys
from splatjax.io import atomic_path
with atomic_path(sys.argv[1]) as temporary:
    temporary.write_text("ha")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_kill_leaves_is_removed_when_the_file_is_written_next(tmp_path):
    """What stood there stays; and so do temporary files of processes that run, and other files."""
    target, other = tmp_path / "a.txt", tmp_path / "b.txt"
    for path in (target, other):
        path.write_text("before")
        words = [sys.executable, "-c", KILLED, str(path)]
        assert subprocess.run(words, check=False).returncode == -signal.SIGKILL
        assert path.read_text() == "before"
    assert len(list(tmp_path.iterdir())) == 4
    with atomic_path(target) as first:
        first.write_text("first")
        with atomic_path(target) as second:
            assert first.exists()
            second.write_text("second")
    assert target.read_text() == "first"
    left = {path.name for path in tmp_path.iterdir()} - {"a.txt", "b.txt"}
    assert [name[:3] for name in left] == [".b-"]


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


@pytest.mark.once
def test_killed_at_any_moment():
    """Writers of every kind, and a turntable that goes on afterwards; `python
    tools/kill_writers.py` does it fifty times.
    """
    tool = Path(__file__).parent.parent.parent / "tools" / "kill_writers.py"
    done = subprocess.run(
        [sys.executable, str(tool), "3"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("3 kills") == 6


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
