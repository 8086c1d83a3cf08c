"""What `splatjax render` shows: a preview while it compiles, and its lights."""

import io
import json
from unittest import mock

import jax
import numpy as np
import pytest
from bodies import sphere, view
from commands import ball, run
from PIL import Image
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
    eye = view((0.0, 0.0, 40.0), size=32)
    picture = np.asarray(rough_picture(scene, lights.samples(), eye, 0.0, 28))
    red, _, blue = np.moveaxis(picture, 2, 0)
    assert picture.shape == (28, 28, 3)
    assert np.all(red[red > 0] < blue[red > 0])
    assert np.mean(red[10:18, 10:18] > 0) > 0.6
    assert red.max() < 256
    assert np.all(red[:, :2] == 0)
    assert red[:, 14:].sum() > 1.5 * red[:, :14].sum()
    assert red[:14].sum() > 1.3 * red[14:].sum()


FAR, AHEAD, DISK = [0, 0, 1e5], [0, 0, -3], 2e10 / np.pi


@pytest.mark.parametrize(
    "light",
    [
        sj.DirectionalLight(AHEAD, 2.0),
        sj.PointLight(FAR, 2e10),
        sj.scene.SpotLight(FAR, AHEAD, 2e10),
        sj.GaussianBeam(FAR, AHEAD, 4e8 * np.pi, 1e8),
        sj.scene.DiskLight(FAR, DISK, AHEAD, 1.0),
        sj.scene.RectangleLight.facing(FAR, [0, 0, 0], 1.0, 1.0, 2e10),
        sj.scene.SphereLight(FAR, DISK, 1.0),
    ],
)
def test_a_preview_shows_every_kind_of_light(light):
    scene, camera = sj.Scene(sphere(3000), light, sj.load_material("marble")), view((9, 9, 40))
    samples = light.samples(), [sj.DirectionalLight([0, 0, -1], 2.0)]
    pictures = [rough_picture(scene, sampled, camera, 0.0, 28) for sampled in samples]
    assert np.abs(np.subtract(*pictures)).max() <= 1


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


def test_a_preview_that_fails_does_not_end_the_picture(console):
    console(Terminal())
    with _terminal.preview(mock.Mock(side_effect=AttributeError("direction"))):
        jax.monitoring.record_event("/jax/compilation_cache/cache_misses")


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


SMALL = "--material", "marble", "--no-scattering", "--height", 16, "--output"
# From behind: an OpenGL camera at (0, 0, -60) that looks along +z.
BEHIND = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, -60], [0, 0, 0, 1]]
SCENE = """material = "marble"
[splats]
file = "ball.ply"
[camera]
position = [0, 0, 60]
target = [0, 0, 0]
width = 16
height = 16
[[lights]]
kind = "directional"
direction = [0, 0, -1]
irradiance = 3
[[lights]]
kind = "environment"
image = "overcast"
count = 4
"""


def test_the_fill_is_beside_the_camera_of_a_file(plain, tmp_path, capsys):
    """And no splats are proposed to resolve a body without scattering, also from its manifest."""
    splats, picture, path = (tmp_path / n for n in ("ball.ply", "ball.exr", "transforms.json"))
    frames = [{"file_path": "0", "transform_matrix": BEHIND}]
    path.write_text(json.dumps({"w": 16, "h": 16, "fl_x": 30.0, "frames": frames}))
    more = "--camera", path, "--fill", 0.5, "--light-azimuth", -20
    assert run("render", ball(splats), *SMALL, picture, *more) == 0
    scene, camera, _ = sj.io.load_scene(picture)
    assert float(scene.lights[1].direction @ camera.rotation[2]) > 0.8
    assert run("render", picture, "--output", tmp_path / "again.exr") == 0
    assert "unresolved" not in capsys.readouterr().err


def test_the_background_is_the_environment_also_after_other_lights(plain, tmp_path):
    ball(tmp_path / "ball.ply")
    (tmp_path / "scene.toml").write_text(SCENE)
    options = "--background", "environment", "--output", tmp_path / "it.exr"
    assert run("render", tmp_path / "scene.toml", *options) == 0
    assert np.asarray(Image.open(tmp_path / "it.png"))[0, 0].min() > 0
