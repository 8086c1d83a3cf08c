"""Precision for tests of numbers that float32 cannot show."""

import jax
import pytest


@pytest.fixture
def float64():
    """Compute in float64 whatever the precision of the run."""
    with jax.enable_x64(True):
        yield
