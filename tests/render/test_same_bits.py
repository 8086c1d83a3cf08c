"""Same input, same bits: in another process, on another number of processors."""

import importlib.util
import os
from pathlib import Path

import pytest


@pytest.fixture
def same_bits():
    """The tool that makes a small one of everything."""
    spec = importlib.util.spec_from_file_location(
        "same_bits", Path(__file__).parent.parent.parent / "tools" / "same_bits.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.long
def test_a_picture_is_the_same_on_one_processor(same_bits):
    names = "points", "picture"
    assert same_bits.in_a_process({min(os.sched_getaffinity(0))}, *names) == same_bits.outputs(
        names
    )


@pytest.mark.long
def test_everything_is_the_same_on_one_processor_and_on_all(same_bits):
    everyone = os.sched_getaffinity(0)
    assert same_bits.in_a_process({min(everyone)}) == same_bits.in_a_process(everyone)
