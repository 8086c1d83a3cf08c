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
from commands import ball, contents, frame_names

from splatjax.cli._resumable import process_index_and_count

pytestmark = pytest.mark.once

SCRIPT = Path(__file__).parent / "one_process.py"
FRAMES = 6
OPTIONS = "--width 16 --height 16 --no-scattering --material marble --turn camera --frames"


def run_processes(command, count, **environment):
    """Run a command in some processes, which find each other at this machine's own address; return
    their statuses, and what they print on stdout and stderr.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    common = {"PYTHONPATH": str(SCRIPT.parents[2]), "JAX_COORDINATOR_ADDRESS": address}
    numbers = [{"JAX_NUM_PROCESSES": str(count), "JAX_PROCESS_ID": str(i)} for i in range(count)]
    pipe, words = subprocess.PIPE, [sys.executable, str(SCRIPT), *map(str, command)]
    processes = [
        subprocess.Popen(
            words, env=os.environ | common | environment | own, stdout=pipe, stderr=pipe, text=True
        )
        for own in numbers
    ]
    printed = [process.communicate(timeout=300) for process in processes]
    return [process.returncode for process in processes], *zip(*printed, strict=True)


@pytest.mark.long
def test_processes_share_a_turntable_and_one_that_is_killed_costs_no_finished_frame(tmp_path):
    splats, two, four = ball(tmp_path / "ball.ply"), tmp_path / "two", tmp_path / "four"
    words = ["turntable", splats, *OPTIONS.split(), FRAMES, "--output"]
    names = frame_names(*range(FRAMES))

    statuses, out, err = run_processes([*words, two], 2)
    assert statuses == [0, 0], err
    whole = contents(two)
    assert whole.keys() == names | {"turntable.json", "turntable.webp"}
    printed = {Path(line).name for text in out for line in text.splitlines()}
    assert printed == names | {"turntable.webp"}

    statuses, _, err = run_processes([*words, four], 4, KILLED_BEFORE="frame_0001")
    assert statuses == [0, -signal.SIGKILL, 0, 0], err
    finished = {name for name in names if name[6:10] not in ("0001", "0005")}
    assert contents(four).keys() == finished | {"frame_0001.exr", "turntable.json"}
    assert ["still at work" in text for text in err] == [True, False, True, True]
    statuses, _, err = run_processes([*words, four], 2)
    assert statuses == [0, 0], err
    assert f"4 of {FRAMES} frames" in err[0]
    assert contents(four) == whole


def test_one_process_waits_for_nobody(monkeypatch):
    for name in ("JAX_NUM_PROCESSES", "SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    assert process_index_and_count() == (0, 1)
    monkeypatch.setenv("JAX_NUM_PROCESSES", "1")
    assert process_index_and_count() == (0, 1)
    monkeypatch.setenv("JAX_NUM_PROCESSES", "many")
    with pytest.raises(ValueError, match=r"'many' Set .*JAX_NUM_PROCESSES"):
        process_index_and_count()
