"""What `splatjax render` shows in a terminal while it compiles: commands in processes of their own,
whose stderr is a terminal or a pipe.
"""

import contextlib
import io
import os
import re
import subprocess
import sys

import jax
import numpy as np
import pytest
from commands import SCRIPT, ball
from processes import FINDS
from rich.console import Console

from splatjax.cli import _terminal

pty = pytest.importorskip("pty")

COLORS = {"TERM": "xterm-256color", "COLORTERM": "truecolor", "COLUMNS": "80", "LINES": "40"}
HALF = re.compile(r"\x1b\[38;2;(\d+);(\d+);(\d+);48;2;(\d+);(\d+);(\d+)m(▀+)")


def start(words, cache):
    """Run a command whose stderr is a terminal; return the process and the terminal's other end."""
    seen, terminal = pty.openpty()
    environment = {key: os.environ[key] for key in os.environ.keys() - {"NO_COLOR"}}
    environment |= FINDS | {"XDG_CACHE_HOME": str(cache)}
    process = subprocess.Popen(
        [sys.executable, SCRIPT, "render", *map(str, words)],
        env=environment | COLORS,
        stdout=subprocess.PIPE,
        stderr=terminal,
        text=True,
    )
    os.close(terminal)
    return process, seen


def printed(process, seen):
    """Wait for a command; return what it printed on stdout and on the terminal."""
    shown = b""
    with contextlib.suppress(OSError), open(seen, "rb", buffering=0) as terminal:  # it is closed
        while part := terminal.read(65536):
            shown += part
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 0, shown
    return out, shown.decode()


def pixels(shown):
    rows = []
    for line in shown.splitlines():
        runs = [(list(map(int, run[:6])), len(run[6])) for run in HALF.findall(line)]
        if runs:
            cells = np.concatenate([np.tile(colors, (length, 1)) for colors, length in runs])
            rows += [cells[:, :3], cells[:, 3:]]
    return np.asarray(rows)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.once
def test_a_terminal_shows_a_preview_while_the_picture_compiles_and_only_then(tmp_path):
    splats, output = ball(tmp_path / "ball.ply", count=3000), tmp_path / "ball.exr"
    view = ("--width", 32, "--height", 16, "--azimuth", 0, "--light-azimuth", 60)
    words = [splats, *view, "--material", "marble", "--no-scattering", "--output", output]
    both = [start(words, tmp_path / "shown"), start([*words, "--quiet"], tmp_path / "quiet")]
    (_, shown), (_, quiet) = answers = [printed(*one) for one in both]
    answers += [printed(*start(words, tmp_path / "shown"))]
    assert {out for out, _ in answers} == {f"{output}\n{output.with_suffix('.png')}\n"}
    assert ["▀" in text for _, text in answers] == [True, False, False]
    assert re.sub(r"\x1b\[[?\d;]*[a-zA-Z]|\s", "", quiet) == ""

    picture = pixels(shown)  # the light comes from the right
    height, width, _ = picture.shape
    assert (width, height) == (28, 14)  # 28 is half the root of 3000 or so
    is_covered = picture.max(axis=2) > 0
    assert not is_covered[:, : width // 5].any()
    assert is_covered[height // 2, width // 2 - 3 : width // 2 + 3].all()
    brightness = picture.sum(axis=(0, 2))
    assert brightness[width // 2 :].sum() > 1.5 * brightness[: width // 2].sum()


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("file", "variables", "shown"),
    [
        (Terminal, {}, True),
        (Terminal, {"TERM": "xterm-256color", "COLORTERM": ""}, True),
        (Terminal, {"NO_COLOR": "1"}, False),
        (Terminal, {"TERM": "dumb"}, False),
        (io.StringIO, {"FORCE_COLOR": "1"}, False),
    ],
)
def test_a_preview_is_for_terminals_with_colors(file, variables, shown, monkeypatch):
    for name in ("NO_COLOR", "FORCE_COLOR"):
        monkeypatch.delenv(name, raising=False)
    for name, value in (COLORS | variables).items():
        monkeypatch.setenv(name, value)
    console, sides = Console(file=file()), []
    monkeypatch.setattr(_terminal, "CONSOLE", console)
    with _terminal.preview(lambda side: sides.append(side) or [[(9, 9, 9)], [(0, 0, 0)]]):
        for _ in range(2):
            jax.monitoring.record_event("/jax/compilation_cache/cache_hits")
            jax.monitoring.record_event("/jax/compilation_cache/cache_misses")
    jax.monitoring.record_event("/jax/compilation_cache/cache_misses")
    assert sides == ([64] if shown else [])
    assert console.file.getvalue().count("▀") == shown
