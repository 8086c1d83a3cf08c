"""Several processes share the work of one command; one that is killed costs nothing that is
finished.
"""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from commands import ball

from splatjax.cli import _processes

pytestmark = pytest.mark.once

SCRIPT = Path(__file__).parent / "one_process.py"
FRAMES = 6


def started(command, count, **environment):
    """Start a command in some processes, which find each other at this machine's own address; give
    those that still run.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    common = (
        os.environ
        | {"PYTHONPATH": str(SCRIPT.parents[2]), "JAX_COORDINATOR_ADDRESS": address}
        | environment
    )
    words = [sys.executable, str(SCRIPT), *map(str, command)]
    return [
        subprocess.Popen(
            words,
            env=common | {"JAX_NUM_PROCESSES": str(count), "JAX_PROCESS_ID": str(i)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for i in range(count)
    ]


def ended(processes):
    """Wait for all; give their statuses and what they said."""
    said = [process.communicate(timeout=300) for process in processes]
    return [process.returncode for process in processes], said


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_processes_share_a_turntable_and_one_that_is_killed_costs_no_finished_frame(tmp_path):
    splats = ball(tmp_path / "ball.ply")

    def command(folder):
        size = (
            "--width",
            16,
            "--height",
            16,
            "--no-scattering",
            "--material",
            "marble",
            "--turn",
            "camera",
        )
        return ["turntable", splats, *size, "--frames", FRAMES, "--output", tmp_path / folder]

    statuses, said = ended(started(command("two"), 2))
    assert statuses == [0, 0], said
    whole = contents(tmp_path / "two")
    names = {f"frame_{i:04}.{suffix}" for i in range(FRAMES) for suffix in ("exr", "png")}
    assert whole.keys() == names | {"turntable.json", "turntable.webp"}
    listed = [line for out, _ in said for line in out.splitlines()]
    assert {Path(line).name for line in listed} == names | {"turntable.webp"}

    statuses, said = ended(started(command("four"), 4, KILLED_BEFORE="frame_0001"))
    assert statuses == [0, -signal.SIGKILL, 0, 0], said
    left = contents(tmp_path / "four")
    finished = {name for name in names if name[6:10] not in ("0001", "0005")}
    assert finished | {"frame_0001.exr", "turntable.json"} == {
        name for name in left if not name.startswith(".")
    }
    assert all(
        "still at work" in error
        for status, (_, error) in zip(statuses, said, strict=True)
        if status == 0
    )
    statuses, said = ended(started(command("four"), 2))
    assert statuses == [0, 0], said
    assert f"4 of {FRAMES} frames are there already" in said[0][1]
    assert contents(tmp_path / "four") == whole


def test_every_item_is_one_process_share():
    shares = [_processes.Share(i, 3).of(range(8)) for i in range(3)]
    assert shares == [[0, 3, 6], [1, 4, 7], [2, 5]]


def test_a_process_of_its_own_asks_nobody(monkeypatch):
    for name in ("JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    assert _processes.own_share() == _processes.Share(0, 1)
    monkeypatch.setenv("JAX_NUM_PROCESSES", "many")
    with pytest.raises(ValueError, match="JAX_NUM_PROCESSES is 'many'; it must be a whole number"):
        _processes.own_share()
