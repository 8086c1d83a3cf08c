"""Programs in processes of their own, beside each other."""

import os
import socket
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parent
# Where a program finds splatjax, and what tests share.
FINDS = {"PYTHONPATH": os.pathsep.join([str(TESTS.parent), str(TESTS)])}


def run_together(*programs):
    """Run Python programs beside each other, each given by its words and by what it adds to the
    environment; return their statuses, and what they print on stdout and stderr.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    processes = [
        subprocess.Popen(
            [sys.executable, *map(str, words)], env=os.environ | FINDS | added, **pipes
        )
        for words, added in programs
    ]
    printed = [process.communicate(timeout=600) for process in processes]
    return [process.returncode for process in processes], *zip(*printed, strict=True)


def free_port():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]
