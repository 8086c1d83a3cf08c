"""The command line is run in process: its settings are those of the whole process."""

from functools import partial

import jax
import pytest
from bodies import PLAIN
from jax.experimental.compilation_cache import compilation_cache

import splatjax as sj
from splatjax.cli import _render

SETTINGS = (
    "jax_compilation_cache_dir",
    "jax_logging_level",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_platforms",
)
COMPILED = "/jax/core/compile/backend_compile_duration"


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory):
    """Keep compiled code in a folder of the tests, and restore the settings afterwards."""
    before = {name: getattr(jax.config, name) for name in SETTINGS}
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(sj.cache, "_folder", None)
        yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.fixture(scope="module")
def plain():
    """Plain renderers, whose program is small: what is tested here does not depend on them."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("make_plan", "illuminate", "render"):
            patch.setattr(sj, name, partial(getattr(sj, name), settings=PLAIN))
        yield


@pytest.fixture
def drawn(monkeypatch):
    """Return the plans by which a turntable's frames are drawn, and how many programs had been
    compiled after each.
    """
    compiled, seen, draw = [], [], _render.draw

    def watched(scene, camera, plan, light):
        frame = draw(scene, camera, plan, light)
        seen.append((plan, len(compiled)))
        return frame

    def listen(event, duration, **_):
        compiled.extend([duration] if event == COMPILED else [])

    monkeypatch.setattr(_render, "draw", watched)
    jax.monitoring.register_event_duration_secs_listener(listen)
    yield seen
    jax.monitoring.unregister_event_duration_listener(listen)
