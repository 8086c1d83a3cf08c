"""Files that are almost right are read, or refused by an error that names them.

Files that once failed lie in tests/io/corpus. `make fuzz` spoils thousands more (SPLATJAX_FUZZ is
their number for each reader), and adds what fails.
"""

import hashlib
import os
import resource
import shutil
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from spoiled_files import READERS, SQUARE, outcome, seeds, spoiled

CORPUS = Path(__file__).parent / "corpus"
FILES = sorted(path for path in CORPUS.glob("*/*") if path.is_file())
EXAMPLES = int(os.environ.get("SPLATJAX_FUZZ", "20"))
FUZZING = "SPLATJAX_FUZZ" in os.environ
IMPORTS = 60  # seconds: the first file of a kind waits for libraries to be imported
MEMORY = 12 << 30  # bytes of address space, most of it taken by libraries


@pytest.mark.parametrize("path", FILES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_files_that_once_failed_are_read_or_refused(path, tmp_path):
    (tmp_path / "square.obj").write_text(SQUARE)
    copied = Path(shutil.copy(path, tmp_path))
    assert outcome(path.parent.name, copied, IMPORTS) in ("read", "refused")


@pytest.mark.parametrize("name", READERS)
def test_every_reader_reads_or_refuses_spoiled_files(name, tmp_path):
    paths = seeds(name, tmp_path)
    assert "read" in {outcome(name, path, IMPORTS) for path in paths}
    file = tmp_path / f"input{paths[0].suffix}"

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        derandomize=not FUZZING,
        suppress_health_check=list(HealthCheck),
    )
    @given(spoiled([path.read_bytes() for path in paths]))
    def check(data):
        file.write_bytes(data)
        assert outcome(name, file) in ("read", "refused")

    limits = resource.getrlimit(resource.RLIMIT_AS)
    try:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY if FUZZING else limits[0], limits[1]))
        check()
    except AssertionError:  # the file is the smallest that fails
        digest = hashlib.sha256(file.read_bytes()).hexdigest()[:10]
        kept = CORPUS / name if FUZZING else tmp_path
        kept.mkdir(exist_ok=True)
        shutil.copy(file, kept / f"{digest}{file.suffix}")
        raise
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
