"""Files that fuzzing found (tools/fuzz.py): once they stopped a reader, now they are read or
refused in one sentence.
"""

import importlib.util
import random
import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SLOW = 60
"""Seconds: the first file of a kind waits for libraries to be imported."""

FILES = sorted(path for path in (ROOT / "tests" / "io" / "corpus").glob("*/*") if path.is_file())


def tool():
    sys.path.insert(0, str(ROOT / "tools"))
    spec = importlib.util.spec_from_file_location("fuzz", ROOT / "tools" / "fuzz.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.path.pop(0)
    return module


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_what_was_found_is_read_or_refused(path, tmp_path):
    copied = shutil.copy(path, tmp_path)
    assert tool().try_input(tool().DOORS[path.parent.name], Path(copied), SLOW) in (
        "read",
        "refused",
    )


def test_every_reader_takes_its_seeds_and_refuses_some_spoilt_ones(tmp_path):
    """A few dozen inputs for each, that the fuzzer itself stays whole."""
    fuzz = tool()
    chance = random.Random(1)
    for name, door in fuzz.DOORS.items():
        folder = tmp_path / name
        folder.mkdir()
        seeds = door.seeds(folder)
        assert "read" in {fuzz.try_input(door, path, SLOW) for path in seeds}, name
        contents = [path.read_bytes() for path in seeds]
        became = []
        for _ in range(20):
            path = folder / f"input{door.suffix}"
            path.write_bytes(fuzz.mutate(chance.choice(contents), contents, chance))
            became.append(fuzz.try_input(door, path, SLOW))
        assert set(became) <= {"read", "refused"}, (name, became)
