"""Precision for tests of numbers that float32 cannot show."""

import jax
import pytest


@pytest.fixture
def float64():
    """Compute in float64 whatever the precision of the run."""
    with jax.enable_x64(True):
        yield


def pytest_collection_modifyitems(config, items):
    """Leave out of a float32 run the slow tests that compute in float64: they are in the float64 run."""
    if jax.config.jax_enable_x64:
        return
    left_out = [item for item in items if "float64" in item.fixturenames and item.get_closest_marker("slow")]
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)
