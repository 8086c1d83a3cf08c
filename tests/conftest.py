"""Strict modes for the whole suite. Precision comes from JAX_ENABLE_X64: the suite runs once in
each.
"""

import gc
import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache
from xdist.scheduler import LoadFileScheduling

from splatjax import cache

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tracing makes objects by the million that live as long as what they were traced for: looking for
# garbage among them as often as Python would takes 8% of the time.
gc.set_threshold(100_000, 20, 20)


@pytest.fixture
def x64() -> bool:
    return bool(jax.config.jax_enable_x64)


@pytest.fixture
def float64(x64):
    """Numbers that float32 cannot show: such tests belong to the float64 run, and are left out of
    the other.
    """
    assert x64


@pytest.fixture
def float32(x64):
    """Long sums that need a compiler's whole effort, as users have it: such tests belong to the
    float32 run alone.
    """
    assert not x64


@pytest.fixture
def double():
    """Search in float64, whatever the suite runs in."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def dtype():
    return jnp.zeros(()).dtype


@pytest.fixture
def compiled():
    """The names of all programs that XLA compiles during a test, one after the other."""
    names = []

    def listen(event, duration, fun_name="", **_):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(fun_name)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.fixture
def events():
    """The names of what else JAX reports during a test, one after the other."""
    names = []
    jax.monitoring.register_event_listener(listener := lambda name, **_: names.append(name))
    yield names
    jax.monitoring.unregister_event_listener(listener)


@pytest.fixture(scope="module")
def jax_settings():
    """Restore JAX's settings after the tests of a file."""
    before = dict(jax.config.values)
    yield
    for name, value in before.items() - jax.config.values.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(scope="module", autouse=True)
def no_capacities():
    """Forget what other files planned, which plans reuse: no test depends on its worker's past."""
    cache._capacities.clear()


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Forget compiled programs before XLA crashes: each maps memory, and Linux allows a process
    65,530 maps.
    """
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and len(maps.read_bytes().splitlines()) > 30_000:
        jax.clear_caches()


@pytest.fixture
def monte_carlo():
    """Read a run of the public Monte Carlo code, of tests marked `shared`."""

    def read(name: str) -> dict:
        folder = Path(os.environ["SPLATJAX_SHARED"]) / "monte_carlo"
        return json.loads((folder / f"{name}.json").read_text())

    return read


def shared_folder() -> Path | None:
    """The folder named by SPLATJAX_SHARED, where the scanned head and the yardsticks lie."""
    folder = os.environ.get("SPLATJAX_SHARED")
    return Path(folder) if folder and Path(folder).is_dir() else None


def _left_out(item) -> bool:
    """Whether a test needs shared files that are not there, or shows nothing more in float64."""
    if item.get_closest_marker("shared") and shared_folder() is None:
        return True
    if jax.config.jax_enable_x64:
        return item.get_closest_marker("once") is not None or "float32" in item.fixturenames
    return "float64" in item.fixturenames


# Beside tests marked `once`: what JAX has little part in.
ONCE = (
    "tests/io/",
    "tests/cli/",
    "tests/exports/",
    "tests/documents/",
    "tests/plots/",
    "tests/studio/",
    "render/test_devices",
    "render/test_plan",
    "render/test_streamed",
    "render/test_weights",
    "geometry/test_raw_points",
    "geometry/test_sampling",
    "test_cache",
    "test_chunking",
    "test_imports",
)
# What is about files, words and searches, and not about sums that an optimizing compiler rounds.
UNOPTIMIZED = ("tests/inverse/", "tests/fitting/", "test_records")


@pytest.hookimpl(tryfirst=True)  # before pytest chooses by marks
def pytest_collection_modifyitems(config, items):
    """Leave out, and say so, what cannot run or need not run twice."""
    for item in items:
        names = item.fixturenames
        if "float64" not in names and any(name in item.nodeid for name in ONCE):
            item.add_marker("once")
        if "float32" not in names and any(name in item.nodeid for name in UNOPTIMIZED):
            item.add_marker("unoptimized")
    # The longest files first, so that no worker is left alone with one in the end.
    longest = (
        "tests/studio",
        "tests/inverse",
        "gradients/test_every_float",
        "tests/gradients",
        "tests/fitting",
        "tests/transport",
        "tests/render",
        "tests/cli",
        "tests/baselines",
        "test_budget",
        "tests/documents",
    )
    items.sort(
        key=lambda item: next(
            (i for i, name in enumerate(longest) if name in item.nodeid), len(longest)
        )
    )
    left_out = [item for item in items if _left_out(item)]
    if left_out:
        items[:] = [item for item in items if item not in left_out]
        config.hook.pytest_deselected(items=left_out)


class _ByProgram(LoadFileScheduling):
    """Give a worker whole files, and all files of the studio, which compile the same programs."""

    def _split_scope(self, nodeid):
        return "studio" if "tests/studio/" in nodeid else super()._split_scope(nodeid)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    return _ByProgram(config, log) if config.getvalue("dist") == "loadfile" else None


def pytest_collection_finish():
    """What has been imported stays."""
    gc.freeze()


def pytest_report_header():
    where = "tests marked `shared` are left out: SPLATJAX_SHARED names no folder"
    if shared_folder() is not None:
        where = f"shared files from {shared_folder()}"
    return f"splatjax in {jnp.zeros(()).dtype}; {where}"
