"""What `splatjax render` shows in a terminal while it compiles."""

import io

import jax
import numpy as np
import pytest
from bodies import sphere, view
from commands import ball, run
from rich.console import Console

import splatjax as sj
from splatjax.cli import _main, _terminal
from splatjax.cli._render import rough_picture

COLORS = {"TERM": "xterm-256color", "COLORTERM": "truecolor", "COLUMNS": "80", "LINES": "40"}


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def console(monkeypatch):
    """Return how to put a file with some variables in the place of stderr."""

    def put(file, **variables):
        for name in ("NO_COLOR", "FORCE_COLOR"):
            monkeypatch.delenv(name, raising=False)
        for name, value in (COLORS | variables).items():
            monkeypatch.setenv(name, value)
        console = Console(file=file, quiet="QUIET" in variables)
        for module in (_terminal, _main):
            monkeypatch.setattr(module, "CONSOLE", console)
        return file

    return put


def test_a_preview_is_shown_while_the_picture_compiles_and_only_then(plain, console, tmp_path):
    splats, output, size = ball(tmp_path / "ball.ply"), tmp_path / "ball.exr", ("--width", 16)
    options = [*size, "--height", 24, "--material", "marble", "--no-scattering", "--output", output]
    shown = []
    for more in ([], [], ["--quiet"]):
        file = console(Terminal())
        assert run("render", splats, *options, *more) == 0
        shown.append("▀" in file.getvalue())
    assert shown == [True, False, False]
    assert file.getvalue() == ""


def test_a_preview_is_upright_and_lit_from_where_the_light_is():
    lights = sj.DirectionalLight([-0.8, -0.6, -0.2], [1.0, 2.0, 3.0])
    scene = sj.Scene(sphere(3000, jitter=0.0), lights, sj.load_material("marble"))
    picture = np.asarray(
        rough_picture(scene, lights.samples(), view((0.0, 0.0, 40.0), size=32), 0.0, 28)
    )
    red, _, blue = np.moveaxis(picture, 2, 0)
    assert picture.shape == (28, 28, 3)
    assert np.all(red[red > 0] < blue[red > 0])
    assert np.mean(red[10:18, 10:18] > 0) > 0.6
    assert red.max() < 256
    assert np.all(red[:, :2] == 0)
    assert red[:, 14:].sum() > 1.5 * red[:, :14].sum()
    assert red[:14].sum() > 1.3 * red[14:].sum()


def test_a_preview_compiles_nothing(compiled):
    """It is drawn while JAX compiles a program, which may be one that it would need."""
    sampled, other = (sj.EnvironmentLight(np.ones((6, 12, 3)), count=count) for count in (16, 19))
    camera, samples = view((0.0, 0.0, 40.0)), sampled.samples()
    scene = sj.Scene(sphere(3000), other, sj.load_material("marble"))
    before = len(compiled)
    rough_picture(scene, samples, camera, 0.0, 28)
    assert len(compiled) == before
    other.samples()
    assert len(compiled) > before


@pytest.mark.parametrize(
    ("file", "variables", "shown"),
    [
        (Terminal, {}, True),
        (Terminal, {"TERM": "xterm-256color", "COLORTERM": ""}, True),
        (Terminal, {"NO_COLOR": "1"}, False),
        (Terminal, {"TERM": "dumb"}, False),
        (Terminal, {"QUIET": "1"}, False),
        (io.StringIO, {"FORCE_COLOR": "1"}, False),
    ],
)
def test_a_preview_is_for_terminals_with_colors(file, variables, shown, console):
    file, sides = console(file(), **variables), []
    with _terminal.preview(lambda side: sides.append(side) or [[(9, 9, 9)], [(0, 0, 0)]]):
        jax.monitoring.record_event("/jax/compilation_cache/cache_hits")
        assert sides == []
        for _ in range(2):
            jax.monitoring.record_event("/jax/compilation_cache/cache_misses")
    jax.monitoring.record_event("/jax/compilation_cache/cache_misses")
    assert sides == ([64] if shown else [])
    assert file.getvalue().count("▀") == shown
