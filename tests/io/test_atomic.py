"""Files are written whole or not at all."""

import pytest

from splatjax.io import atomic_path


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
    with pytest.raises(FileNotFoundError, match="nowhere does not exist; make it first"), atomic_path(target):
        pass


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(IsADirectoryError, match="name a file"), atomic_path(tmp_path):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError, match="is a file"), atomic_path(tmp_path / "file" / "a.txt"):
        pass
