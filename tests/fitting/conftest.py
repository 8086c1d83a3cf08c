"""Precision for tests of numbers that float32 cannot show."""

from pathlib import Path

import jax
import pytest

HERE = Path(__file__).parent


@pytest.fixture
def float64():
    """Compute in float64 whatever the precision of the run."""
    with jax.enable_x64(True):
        yield


def pytest_collection_modifyitems(config, items):
    """Leave out of a float32 run the fits in float64, which take their time to compile: they are in the float64 run."""
    if jax.config.jax_enable_x64:
        return
    left_out = [item for item in items if "float64" in item.fixturenames and item.path.parent == HERE]
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)
