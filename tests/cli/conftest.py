"""The command line is run in process: its settings are those of the whole process."""

import pytest
from bodies import PLAIN

import splatjax as sj
from splatjax.cli import _render
from splatjax.io import _scenes


@pytest.fixture(autouse=True, scope="module")
def own_cache(tmp_path_factory, jax_settings):
    """Keep compiled code in a folder of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(sj.cache, "_folder", None)
        yield


@pytest.fixture(scope="module")
def plain():
    """Plain renderers, whose program is small: what is tested here does not depend on them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_render.PictureOptions, "settings", PLAIN)
        patch.setattr(_scenes, "RenderSettings", lambda **_: PLAIN)
        yield


@pytest.fixture
def drawn(monkeypatch, compiled):
    """Return the plans by which a turntable's frames are drawn, and how many programs had been
    compiled after each.
    """
    seen, draw = [], _render.draw

    def watched(scene, camera, settings, plan, light):
        frame = draw(scene, camera, settings, plan, light)
        seen.append((plan, len(compiled)))
        return frame

    monkeypatch.setattr(_render, "draw", watched)
    return seen
