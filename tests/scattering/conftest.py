"""Precision for tests of numbers that float32 cannot show."""

import json
import os
from pathlib import Path

import pytest


@pytest.fixture
def monte_carlo():
    """Read a run of the public Monte Carlo code, of tests marked `shared`."""

    def read(name: str) -> dict:
        folder = Path(os.environ["SPLATJAX_SHARED"]) / "monte_carlo"
        return json.loads((folder / f"{name}.json").read_text())

    return read
