"""Bodies are those of the splatting tests."""

import sys
from pathlib import Path

import jax
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "splatting"))


@pytest.fixture
def double():
    """Search in float64, whatever the suite runs in."""
    with jax.enable_x64(True):
        yield
