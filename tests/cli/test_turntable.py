"""Frames of an animation: all alike, made once, taken up again."""

import itertools
import json
import shutil
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest
from commands import ball, failure
from PIL import Image

import splatjax as sj
from splatjax.cli import _turntable, main
from splatjax.diffusion import DenseDiffuser
from splatjax.splatting import DenseRasterizer, ShadowSettings

pytestmark = pytest.mark.once

FRAMES = 4


@pytest.fixture(autouse=True, scope="module")
def plain():
    """Plain renderers: their program is small, and which frames are made of what is no matter of
    the renderer.
    """
    settings = sj.RenderSettings(
        shadows=ShadowSettings(resolution=32),
        rasterizer=DenseRasterizer(),
        diffuser=DenseDiffuser(),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sj, "plan", partial(sj.plan, settings=settings))
        patch.setattr(sj, "render", partial(sj.render, settings=settings))
        yield


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    return ball(tmp_path_factory.mktemp("splats") / "ball.ply")


def command(splats, folder, *more):
    size = ("--width", "16", "--height", "16", "--no-scattering", "--material", "marble")
    return [
        "turntable",
        str(splats),
        *size,
        "--frames",
        str(FRAMES),
        "--output",
        str(folder),
        *map(str, more),
    ]


def names(*frames):
    return {f"frame_{i:04}.{suffix}" for i in frames for suffix in ("exr", "png")}


def everything():
    return names(*range(FRAMES)) | {"turntable.json", "turntable.webp"}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def beauty(folder, frame):
    return np.asarray(sj.read_exr(folder / f"frame_{frame:04}.exr").beauty)


@pytest.fixture(scope="module")
def around(splats, tmp_path_factory):
    """The folder of a turn of the camera, not to be written to."""
    folder = tmp_path_factory.mktemp("around") / "turn"
    assert main(command(splats, folder, "--turn", "camera")) == 0
    return folder


@pytest.fixture
def copied(around, tmp_path):
    return shutil.copytree(around, tmp_path / "turn")


def test_frames_and_animation_are_made_by_one_program(splats, tmp_path, drawn, capsys):
    folder = tmp_path / "turn"
    assert main(command(splats, folder, "--turn", "camera")) == 0
    captured = capsys.readouterr()
    assert contents(folder).keys() == everything()
    frames = [
        str(folder / f"frame_{i:04}.{suffix}") for i in range(FRAMES) for suffix in ("exr", "png")
    ]
    assert captured.out.splitlines() == [*frames, str(folder / "turntable.webp")]
    assert f"{FRAMES} of {FRAMES}, " in captured.err
    assert "\x1b" not in captured.err
    assert "\r" not in captured.err
    assert len({(id(plan), compiled) for plan, compiled in drawn}) == 1
    with Image.open(folder / "turntable.webp") as film:
        assert film.n_frames == FRAMES
    pictures = [beauty(folder, i) for i in range(FRAMES)]
    for one, other in itertools.combinations(pictures, 2):
        assert np.abs(one - other).max() > 0.05


def test_a_full_turn_does_not_repeat():
    def azimuths(turn, degrees=360.0):
        turntable = _turntable.Turntable(
            frames=5, azimuth=10.0, light_azimuth=-30.0, turn=turn, degrees=degrees
        )
        return [turntable.azimuths(i) for i in range(5)]

    steps = [0.0, 72.0, 144.0, 216.0, 288.0]
    assert azimuths(_turntable.Turn.CAMERA) == [(10 + step, -30.0) for step in steps]
    assert azimuths(_turntable.Turn.LIGHT) == [(10.0, -30 + step) for step in steps]
    assert azimuths(_turntable.Turn.OBJECT) == [(10 + step, -30 + step) for step in steps]
    assert azimuths(_turntable.Turn.CAMERA, -10.0) == [
        (10 - step, -30.0) for step in (0.0, 2.0, 4.0, 6.0, 8.0)
    ]


def test_camera_keeps_its_distance_and_the_fill_its_place_beside_it():
    places = np.random.default_rng(3).normal(size=(50, 3)) * np.asarray([30.0, 10.0, 5.0]) + 20
    centers, ones = jnp.asarray(places, float), jnp.ones(50)
    splats = sj.Splats(centers, jnp.ones((50, 3)) / 3**0.5, ones, ones)
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    turntable = _turntable.Turntable(elevation=20.0)
    distances, fills = [], []
    for azimuth in np.arange(0.0, 360.0, 40.0).tolist():
        camera = turntable.camera(splats, azimuth)
        distances.append(np.linalg.norm(np.asarray(camera.position) - middle))
        fills.append(
            np.asarray(camera.rotation)
            @ np.asarray(turntable.lights(3, azimuth, -20.0)[1].direction)
        )
    np.testing.assert_allclose(distances, distances[0], rtol=1e-5)
    np.testing.assert_allclose(fills, np.broadcast_to(fills[0], (9, 3)), atol=1e-5)


def test_only_what_is_missing_is_rendered_and_is_as_it_was(splats, copied, drawn, capsys):
    before = contents(copied)
    (copied / "frame_0002.png").unlink()
    (copied / "frame_0003.exr").unlink()
    (copied / "turntable.webp").unlink()
    assert main(command(splats, copied, "--turn", "camera")) == 0
    assert f"2 of {FRAMES} frames are there already" in capsys.readouterr().err
    assert len(drawn) == 2
    assert contents(copied) == before


def test_another_speed_needs_no_rendering(splats, copied, drawn):
    assert main(command(splats, copied, "--turn", "camera", "--fps", 10)) == 0
    assert drawn == []
    with Image.open(copied / "turntable.webp") as film:
        film.load()
        assert film.info["duration"] == 100


@pytest.mark.parametrize("by", ["keyboard", "disk"])
def test_interrupted_frames_are_whole_and_the_rest_follows(
    by, splats, around, tmp_path, drawn, monkeypatch, capsys
):
    folder = tmp_path / "turn"
    write_png = sj.write_png

    def interrupted(path, frame, **how):
        if path.stem == "frame_0001":
            raise (
                KeyboardInterrupt
                if by == "keyboard"
                else OSError(28, "No space left on device", str(path))
            )
        write_png(path, frame, **how)

    monkeypatch.setattr(sj, "write_png", interrupted)
    assert main(command(splats, folder, "--turn", "camera")) == (130 if by == "keyboard" else 2)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "run the same command again to continue" in captured.err
    assert contents(folder).keys() == names(0) | {"frame_0001.exr", "turntable.json"}
    monkeypatch.setattr(sj, "write_png", write_png)
    drawn.clear()
    assert main(command(splats, folder, "--turn", "camera")) == 0
    assert len(drawn) == FRAMES - 1
    assert contents(folder) == contents(around)


def test_frames_of_something_else_are_refused(splats, copied, tmp_path, drawn, capsys):
    before = contents(copied)

    def refused(*words):
        said = failure(words, capsys)
        assert "name another --output" in said
        assert contents(copied) == before
        return said

    said = refused(*command(splats, copied, "--turn", "light", "--exposure", 1))
    assert "--turn is light, but was camera" in said
    assert "--exposure is 1.0, but was 0.0" in said
    assert "--width" not in said
    other = ball(tmp_path / splats.name, radius=11.0)
    assert f"splats is {splats.name}, " in refused(*command(other, copied, "--turn", "camera"))
    record = json.loads((copied / "turntable.json").read_text())
    assert record["splatjax"] in str(before["turntable.json"])
    (copied / "turntable.json").unlink()
    before.pop("turntable.json")
    assert "nothing says what it is made of" in refused(
        *command(splats, copied, "--turn", "camera")
    )
    assert drawn == []


def test_light_goes_around_a_camera_that_stands_still(splats, around, tmp_path):
    folder = tmp_path / "light"
    still = ("--azimuth", 0, "--light-elevation", 0)
    assert main(command(splats, folder, "--turn", "light", "--light-azimuth", 0, *still)) == 0
    frames = [sj.read_exr(folder / f"frame_{i:04}.exr") for i in range(FRAMES)]
    for frame in frames[1:]:
        np.testing.assert_array_equal(np.asarray(frame.position), np.asarray(frames[0].position))
    front, right, back, left = (np.asarray(frame.diffuse).sum(axis=-1) for frame in frames)
    assert front.sum() > right.sum() > back.sum()
    assert right[:, 8:].sum() > 2 * right[:, :8].sum()
    assert left[:, :8].sum() > 2 * left[:, 8:].sum()
    alone = tmp_path / "alone.exr"
    words = command(splats, alone, "--light-azimuth", -90, *still)
    at = words.index("--frames")
    assert main(["render", *words[1:at], *words[at + 2 :]]) == 0
    np.testing.assert_allclose(
        np.asarray(sj.read_exr(alone).beauty), np.asarray(frames[3].beauty), atol=1e-5
    )


IMPOSSIBLE = [
    ("frames", 0),
    ("frames", 10_001),
    ("degrees", 0),
    ("degrees", "nan"),
    ("fps", 0),
    ("width", 20_000),
]
IMPOSSIBLE += [("exposure", "inf"), ("light-azimuth", "nan")]


@pytest.mark.parametrize(("option", "value"), IMPOSSIBLE)
def test_impossible_turns_are_one_line(option, value, splats, tmp_path, capsys):
    folder = tmp_path / "turn"
    assert f"--{option}" in failure(command(splats, folder, f"--{option}", value), capsys, [folder])


def test_a_folder_that_cannot_be_is_one_line(splats, tmp_path, capsys):
    assert "make it first" in failure(command(splats, tmp_path / "none" / "turn"), capsys)
    (tmp_path / "file").write_text("")
    assert "is a file" in failure(command(splats, tmp_path / "file"), capsys)
    folder = tmp_path / "turn"
    assert "marbel" in failure(command(splats, folder, "--material", "marbel"), capsys, [folder])
