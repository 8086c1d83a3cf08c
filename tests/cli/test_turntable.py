"""Frames of an animation: all alike, made once, continued after an interruption, and shared by
several processes.
"""

import itertools
import shutil
import signal
from functools import partial
from pathlib import Path
from unittest import mock

import bodies
import numpy as np
import pytest
from commands import SCRIPT, ball, contents, failure, frame_names, run
from PIL import Image
from processes import free_port, run_together

import splatjax as sj
from splatjax.cli import _render
from splatjax.cli._render import Turntable
from splatjax.cli._terminal import process_index_and_count

pytestmark = pytest.mark.usefixtures("plain")

FRAMES = 4


@pytest.fixture(scope="module")
def splats(tmp_path_factory):
    return ball(tmp_path_factory.mktemp("splats") / "ball.ply")


def command(splats, folder, *more, turn="camera", frames=FRAMES):
    size = ("--width", 16, "--height", 16, "--no-scattering", "--material", "marble", "--fill", 0.1)
    return [
        "turntable",
        splats,
        *size,
        "--frames",
        frames,
        "--output",
        folder,
        "--turn",
        turn,
        *more,
    ]


@pytest.fixture(scope="module")
def around(splats, tmp_path_factory):
    folder = tmp_path_factory.mktemp("around") / "turn"
    assert run(*command(splats, folder)) == 0
    return folder


def test_frames_and_animation_are_made_by_one_program(splats, tmp_path, drawn, capsys):
    folder = tmp_path / "turn"
    assert run(*command(splats, folder)) == 0
    captured = capsys.readouterr()
    expected = [*sorted(frame_names(*range(FRAMES))), "turntable.webp"]
    assert captured.out.splitlines() == [str(folder / name) for name in expected]
    assert contents(folder).keys() == {*expected, "turntable.json"}
    assert f"{FRAMES} of {FRAMES}, " in captured.err
    assert not {"\x1b", "\r"} & set(captured.err)
    assert len({(id(plan), compiled) for plan, compiled in drawn}) == 1
    with Image.open(folder / "turntable.webp") as film:
        assert film.n_frames == FRAMES
    pictures = [np.asarray(sj.read_exr(folder / f"frame_{i:04}.exr").beauty) for i in range(FRAMES)]
    for one, other in itertools.combinations(pictures, 2):
        assert np.abs(one - other).max() > 0.05


@pytest.mark.parametrize(
    ("turn", "degrees", "camera_step", "light_step"),
    [
        ("camera", 360.0, 72, 0),
        ("light", 360.0, 0, 72),
        ("object", 360.0, 72, 72),
        ("camera", -10.0, -2, 0),
    ],
)
def test_a_full_turn_does_not_repeat(turn, degrees, camera_step, light_step):
    options = Turntable(frames=5, azimuth=10.0, light_azimuth=-30.0, turn=turn, degrees=degrees)
    expected = [(10 + camera_step * i, -30 + light_step * i) for i in range(5)]
    assert [options.azimuths(i) for i in range(5)] == expected


@pytest.mark.parametrize(
    ("error", "status"), [(KeyboardInterrupt(), 130), (OSError(28, "No space left", "a.png"), 2)]
)
def test_interrupted_frames_are_whole_and_the_rest_follows(
    error, status, splats, around, tmp_path, drawn, monkeypatch, capsys
):
    folder, write_png = tmp_path / "turn", sj.write_png

    def interrupted(path, frame, **options):
        if path.stem == "frame_0001":
            raise error
        write_png(path, frame, **options)

    monkeypatch.setattr(sj, "write_png", interrupted)
    assert run(*command(splats, folder)) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "the same command again" in captured.err
    assert contents(folder).keys() == frame_names(0) | {"frame_0001.exr", "turntable.json"}
    monkeypatch.setattr(sj, "write_png", write_png)
    drawn.clear()
    assert run(*command(splats, folder)) == 0
    assert len(drawn) == FRAMES - 1
    assert contents(folder) == contents(around)
    assert run(*command(splats, folder, "--fps", 10)) == 0
    assert len(drawn) == FRAMES - 1  # another speed needs no rendering
    with Image.open(folder / "turntable.webp") as film:
        film.load()
        assert film.info["duration"] == 100


def test_frames_of_something_else_are_refused(splats, around, tmp_path, drawn, capsys):
    copied = shutil.copytree(around, tmp_path / "turn")
    before = contents(copied)
    line = failure(command(splats, copied, "--exposure", 1, turn="light"), capsys)
    assert all(part in line for part in ("--turn is light", "--exposure is 1.0", "--output"))
    assert "--width" not in line
    other = ball(tmp_path / splats.name, radius=11.0)
    assert f"splats is {splats.name}, " in failure(command(other, copied), capsys)
    assert contents(copied) == before
    (copied / "turntable.json").unlink()
    assert "no record" in failure(command(splats, copied), capsys)
    assert drawn == []


def test_an_orbit_under_lights_that_stand_still_is_lit_once(splats, tmp_path, monkeypatch):
    folder, alone = tmp_path / "orbit", tmp_path / "alone.exr"
    illuminate = mock.Mock(wraps=sj.illuminate)
    monkeypatch.setattr(sj, "illuminate", illuminate)
    words = command(splats, folder, "--fill", 0)
    assert run(*words) == 0
    assert illuminate.call_count == 1
    still = [*words[1 : words.index("--frames")], "--fill", 0, "--azimuth", 115]
    assert run("render", *still, "--output", alone) == 0
    frames = [sj.read_exr(path) for path in (folder / "frame_0001.exr", alone)]
    np.testing.assert_allclose(*(np.asarray(frame.beauty) for frame in frames), atol=1e-5)


@pytest.mark.long
def test_an_environment_that_turns_about_the_body_has_its_shadow_maps_made_once(
    splats, tmp_path, monkeypatch
):
    transfer = mock.Mock(wraps=sj.transfer)
    monkeypatch.setattr(sj, "transfer", transfer)
    monkeypatch.setattr(_render, "_DIRECTIONS", 6)
    words = command(splats, tmp_path / "turn", "--environment", "sun", turn="light", frames=2)
    fill = words.index("--fill")
    del words[fill : fill + 2]  # of single lights
    assert run(*words) == 0
    assert transfer.call_count == 1
    first, second = (sj.read_exr(tmp_path / "turn" / f"frame_000{i}.exr").beauty for i in range(2))
    assert np.max(first) > 1.1 * np.max(second) > 0  # the sun has gone behind


SHARED_FRAMES = 6


def run_processes(command, count, **environment):
    """Run a command in some processes, which find each other at this machine's own address; return
    their statuses, and what they print on stdout and stderr.
    """
    environment |= {
        "JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{free_port()}",
        "JAX_NUM_PROCESSES": str(count),
    }
    numbers = [{"JAX_PROCESS_ID": str(i)} for i in range(count)]
    return run_together(*(([SCRIPT, *command], environment | own) for own in numbers))


@pytest.mark.long
def test_processes_share_a_turntable_and_one_that_is_killed_costs_no_finished_frame(tmp_path):
    splats, two, four = ball(tmp_path / "ball.ply"), tmp_path / "two", tmp_path / "four"
    shared = partial(command, splats, frames=SHARED_FRAMES)
    names = frame_names(*range(SHARED_FRAMES))

    statuses, out, err = run_processes(shared(two), 2)
    assert statuses == [0, 0], err
    whole = contents(two)
    assert whole.keys() == names | {"turntable.json", "turntable.webp"}
    printed = {Path(line).name for text in out for line in text.splitlines()}
    assert printed == names | {"turntable.webp"}

    statuses, _, err = run_processes(shared(four), 4, KILLED_BEFORE="frame_0001")
    assert statuses == [0, -signal.SIGKILL, 0, 0], err
    finished = {name for name in names if name[6:10] not in ("0001", "0005")}
    assert contents(four).keys() == finished | {"frame_0001.exr", "turntable.json"}
    assert ["other processes" in text for text in err] == [True, False, True, True]
    statuses, _, err = run_processes(shared(four), 2)
    assert statuses == [0, 0], err
    assert f"4 of {SHARED_FRAMES} frames" in err[0]
    assert contents(four) == whole


def test_one_process_waits_for_nobody(monkeypatch):
    for name in ("JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    assert process_index_and_count() == (0, 1)
    monkeypatch.setenv("JAX_NUM_PROCESSES", "1")
    assert process_index_and_count() == (0, 1)
    monkeypatch.setenv("JAX_NUM_PROCESSES", "many")
    bodies.assert_refused(process_index_and_count, r"'many' Set .*JAX_NUM_PROCESSES")
