"""Spoil files for a reader by atheris, which prefers those that reach new lines: `python
tools/fuzz.py READER [examples]`.

Readers are those of tests/io/spoiled_files.py. Needs atheris: `.venv/bin/uv pip install atheris`.
"""

import inspect
import random
import sys
import tempfile
from pathlib import Path

import atheris
from hypothesis import given

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "io"))
from spoiled_files import outcome, seeds, spoiled


def main(name: str, examples: str = "20000") -> None:
    corpus = Path(tempfile.mkdtemp())
    paths = seeds(name, Path(tempfile.mkdtemp()))
    file = paths[0].with_stem("input")
    print(f"the last file read is {file}")

    @given(spoiled([path.read_bytes() for path in paths]))
    def check(data: bytes) -> None:
        file.write_bytes(data)
        assert outcome(name, file) in ("read", "refused")

    for module in [sys.modules[key] for key in sys.modules if key.startswith("splatjax.io.")]:
        for value in filter(inspect.isfunction, vars(module).values()):
            value.__code__ = atheris.instrument_func(value).__code__
    for number in range(16):  # bytes from which Hypothesis draws
        (corpus / str(number)).write_bytes(random.Random(number).randbytes(2048))
    flags = [f"-runs={examples}", "-max_len=4096", "-len_control=0", str(corpus)]
    atheris.Setup([sys.argv[0], *flags], check.hypothesis.fuzz_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
