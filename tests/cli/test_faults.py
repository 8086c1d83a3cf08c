"""What a terminal shows: exit status and message of the program when something goes wrong; help,
versions, and words that it does not know.
"""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from commands import failure, plate, run

import splatjax as sj
from splatjax.cli import _materials, _terminal, main
from splatjax.cli._main import _COMMANDS

MEDIUM = """[medium]
unit = "1/mm"
sigma_a = [0.0021, 0.0041, 0.0071]
sigma_s_prime = [2.19, 2.62, 3.0]
eta = 1.5
[surface]
roughness = 0.11
specular = 0.07
"""
TWO = """[fit]
unit = "mm^2"
variances = [0.5, 2.0]
weights = [[0.3, 0.4], [0.2, 0.5]]
[surface]
eta = 1.5
"""
MEDIA = {
    "negative.toml": MEDIUM.replace("0.0021", "-0.03"),
    "thin.toml": MEDIUM.replace("eta = 1.5", "eta = 0.5"),
    "misspelt.toml": MEDIUM.replace("roughness", "roughnes"),
    "two.toml": TWO,
    "spectral.toml": f"wavelengths = [480, 600]\n{TWO}",
    "media.csv": "name,sigma_a,sigma_s_prime,eta\na,0.002,2.6,1.5\n",
    "dark.toml": "[skin]\nmelanin = 0.15\n",
    "scene.toml": 'material = "marble"\n',
    "lit.toml": 'material = "marble"\n[splats]\n[[lights]]\nkind = "directional"\n',
}
REFUSED = {
    # Inputs that are missing, or something else.
    "render missing.ply": ["missing.ply"],
    "render picture.ply --stream 5": ["picture.ply", "cannot be read"],
    "sample missing.glb --mm-per-unit 1 --output o.ply": ["missing.glb"],
    "sample ball.obj --mm-per-unit 1 --share picture.png --output o.ply": ["--share", "--second"],
    "fit missing.toml": ["missing.toml"],
    "render ball.obj": ["ball.obj", "splatjax sample"],
    "render picture.png": ["picture.png", "PLY or SPZ"],
    "turntable scene.toml": ["scene.toml", "PLY or SPZ", "`splatjax render`"],
    "fit picture.png": ["picture.png", "TOML"],
    "fit marbel": ["marbel", "'marble'"],
    "materials marbel": ["marbel", "'marble'"],
    "render --material marbel": ["marbel"],
    "render plate.ply --camera missing.json": ["missing.json", "no such file"],
    "render plate.ply --camera picture.png:a": ["picture.png", "not a file of cameras"],
    "render lit.toml --background environment": ["--background", "no light is an"],
    "render missing.toml": ["missing.toml", "no such file"],
    # Contents.
    "render scene.toml": ["scene.toml", "[splats] must be a table"],
    "studio scene.toml": ["scene.toml", "[splats] must be a table"],
    "studio scene.toml --azimuth 3": ["--azimuth is 3", "scene.toml"],
    "render scene.toml --azimuth 3": ["--azimuth is 3", "scene.toml"],
    "fit negative.toml": ["negative.toml", "sigma_a"],
    "render plate.ply --material negative.toml": ["negative.toml", "sigma_a"],
    "fit thin.toml": ["thin.toml", "eta must be at least 1"],
    "fit misspelt.toml": ["'roughnes'", "'roughness'"],
    "render plate.ply --material two.toml": ["2 channels", "PNG", "`wavelengths`", "1 or 3"],
    "render plate.ply --material spectral.toml --illuminant D66": ["'D66'", "'D65'"],
    "render plate.ply --material marble --illuminant A": ["--illuminant is A", "marble"],
    # Outputs.
    "render --output none/o.exr": ["none/o.exr", "no folder"],
    "render --output o.png": ["o.png", ".exr"],
    "fit skin1 --output o.txt": ["o.txt", ".toml"],
    "export skin --output o.txt": ["o.txt", ".json"],
    "export skin --output o.glb": ["o.glb", "skin", "scene"],
    "export two.toml --output o.glb": ["two.toml", "the file of a scene"],
    "export scene.toml --output o.mtlx": ["scene.toml", "is the file of a scene"],
    "export skin --output o.json --mm-per-unit 9": ["--mm-per-unit is 9", "o.json", ".mtlx"],
    "export scene.toml --output o.usda --lux 9": ["--lux is 9", "o.usda", ".glb"],
    "turntable plate.ply --output none/turn": ["none/turn", "no folder"],
    "turntable plate.ply --output picture.png": ["--output is picture.png", "a folder"],
    # Values that an option cannot have, before a file is read.
    "render missing.ply --elevation 90": ["--elevation", "90"],
    "render missing.ply --fov 180": ["--fov", "180"],
    "render missing.ply --fov nan": ["--fov", "nan"],
    "render missing.ply --width 0": ["--width", "0"],
    "render missing.ply --height -3": ["--height", "-3"],
    "render --count 0": ["--count", "0"],
    "render plate.ply --count 9": ["--count is 9", "plate.ply"],
    "render missing.ply --scale 0": ["--scale", "0"],
    "render missing.ply --environment-rotation nan": ["--environment-rotation", "nan"],
    "render plate.ply --environment missing.hdr": ["missing.hdr"],
    "render plate.ply --environment overcst": ["overcst", "studio, overcast, sun"],
    "render plate.ply --background environment --fill 0": ["--background", "no light is an"],
    "render plate.ply --environment map.png": ["map.png", "encoded for a display"],
    "render missing.ply --environment studio --light-azimuth 30": ["--light-azimuth", "--env"],
    "render missing.ply --fill -1": ["--fill", "-1"],
    "render missing.ply --bounces -1": ["--bounces", "-1"],
    "render plate.ply --bounces 1 --stream 5": ["--bounces", "0 with --stream"],
    "render plate.ply --diffusion shape": ["--diffusion", "skin has no [medium]"],
    "render --stream 5": ["--stream", "5"],
    "turntable missing.ply --frames 0": ["--frames", "0"],
    "turntable missing.ply --frames 10001": ["--frames", "10001"],
    "turntable missing.ply --degrees 0": ["--degrees", "0"],
    "turntable missing.ply --degrees nan": ["--degrees", "nan"],
    "turntable missing.ply --fps 0": ["--fps", "0"],
    "turntable missing.ply --width 20000": ["--width", "20000"],
    "turntable missing.ply --exposure inf": ["--exposure", "inf"],
    "turntable missing.ply --light-azimuth nan": ["--light-azimuth", "nan"],
    "turntable plate.ply --material marbel": ["marbel"],
    "fit marble --count 13": ["--count", "13"],
    "fit marble --error -1": ["--error", "-1"],
    "recover plate.ply missing.toml --output mine.exr": ["mine.exr"],
    "recover plate.ply missing.toml --output mine.toml --eta 0.9": ["--eta is 0.9"],
    "recover plate.ply missing.toml --output mine.toml --count 0": ["--count is 0"],
    "recover plate.ply missing.toml --output mine.toml --start skin": ["[medium]"],
    "fit media.csv --all": ["--output"],
    "fit media.csv --all --output nowhere/fits.csv": ["no folder"],
    "fit media.csv --all --output fits.csv --count 9": ["--count is 9"],
    # Options that have no effect, or do not go together.
    "render plate.ply --environment-rotation 40 --fill 1": ["--environment-rotation is 40"],
    "render plate.ply --camera missing.json --fov 30": ["--fov is 30", "--camera"],
    "render plate.ply --camera-unit 10": ["--camera-unit is 10"],
    "render --up z": ["--up is z"],
    "fit skin1 --photons 5": ["--photons is 5", "monte-carlo"],
    "sample ball.obj --mm-per-unit 1 --material marble --output o.ply": ["--material", "--share"],
    "fit media.csv --all --output fits.csv --error 0.1": ["--error is 0.1", "--all"],
    "fit dot.csv --model monte-carlo": ["--model", "dot.csv"],
    "fit dot.csv --power 2": ["--power", "dot.csv"],
    "fit dot.exr --mm-per-pixel 1 --single-scattering": ["--single-scattering", "dot.exr"],
    "fit marble --mm-per-unit 10": ["--mm-per-unit", "marble"],
    "fit skin1 --single-scattering --model dipole": ["--single-scattering", "dipole"],
    "fit skin1 --g 0.8 --model dipole": ["--g 0.8", "dipole"],
    "fit skin1 --g 1": ["--g", "1"],
    "fit dark.toml --model dipole": ["leave --model"],
    "fit media.csv --all --output fits.csv --g 0.8 --model dipole": ["--g 0.8", "dipole"],
    "recover plate.ply missing.toml --output mine.toml --g 0.8 --model dipole": ["--g 0.8"],
    "fit skin_layers --single-scattering --model monte-carlo": ["--single-scattering", "layers"],
    "fit skin_layers --model photon-beam": ["photon-beam", "layers"],
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, text in MEDIA.items():
        (tmp_path / name).write_text(text)
    plate(tmp_path / "plate.ply")
    trimesh.creation.icosphere().export(tmp_path / "ball.obj")
    sj.write_png(tmp_path / "map.png", np.ones((4, 8, 3)))
    for name in ("picture.png", "picture.ply"):
        (tmp_path / name).write_bytes(bytes(range(256)))
    return tmp_path


@pytest.mark.parametrize("command", REFUSED)
def test_what_cannot_be_done_is_one_line_that_names_it_and_writes_nothing(command, folder, capsys):
    before = sorted(folder.iterdir())
    line = failure(shlex.split(command), capsys)
    assert [part for part in REFUSED[command] if part not in line] == [], line
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("words", ["--width 1000000 --height 1000000", "--count 1000000000000"])
def test_what_memory_cannot_hold_is_refused_with_what_it_could(words, folder, capsys):
    line = failure(["render", *words.split()], capsys)
    assert words in line
    assert re.search(r"[\d.e+]+ GB .* GB are free; take fewer", line)


def check_in_compiled_code():
    check = eqx.filter_jit(lambda x: eqx.error_if(x, x > 0, "x is positive;\ngive a negative one"))
    check(jnp.ones(()))


@pytest.mark.parametrize(
    ("error", "status", "named"),
    [
        (ValueError("a.ply: is\nempty"), 2, "splatjax: a.ply: is empty\n"),
        (
            OSError(28, "No space left on device", "a.exr"),
            2,
            "splatjax: a.exr: No space left on device\n",
        ),
        (MemoryError(), 2, "not enough memory"),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of\nmemory"), 2, "not enough memory"),
        (TypeError("no such\nthing"), 1, "TypeError: no such thing"),
        (KeyboardInterrupt(), 130, "splatjax: interrupted\n"),
        (check_in_compiled_code, 2, "splatjax: x is positive; give a negative one\n"),
    ],
)
def test_status_tells_whose_fault_it_is(error, status, named, monkeypatch, capsys):
    monkeypatch.setattr(_materials.Materials, "run", mock.Mock(side_effect=error))
    assert run("materials") == status
    captured = capsys.readouterr()
    assert (captured.out, captured.err.count("\n")) == ("", 1)
    assert captured.err.startswith("splatjax: ")
    assert named in captured.err


BUSY = """
import ctypes
from splatjax.cli import _main

def wait_outside_python():
    mutex, lock = ctypes.create_string_buffer(64), ctypes.CDLL(None).pthread_mutex_lock
    lock(mutex)
    print("busy", flush=True)
    lock(mutex)

_main.main = wait_outside_python
_main.run_and_exit()
"""


@pytest.mark.once
def test_an_interruption_ends_a_program_that_does_not_notice_it():
    words, pipe = [sys.executable, "-c", BUSY], subprocess.PIPE
    with subprocess.Popen(words, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout.readline() == "busy\n"
        time.sleep(1)  # until it waits
        process.send_signal(signal.SIGINT)
        _, printed = process.communicate(timeout=300)
    assert (process.returncode, printed) == (130, "splatjax: interrupted\n")


@pytest.mark.parametrize("words", [["--debug", "materials"], ["materials", "--debug"]])
def test_debug_shows_where_it_arose(words, monkeypatch, capsys):
    failing = mock.Mock(side_effect=ValueError("a.ply: is empty"))
    monkeypatch.setattr(_materials.Materials, "run", failing)
    assert run(*words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1] == "splatjax: a.ply: is empty"


def test_a_warning_for_users_is_a_line_and_one_for_developers_none(monkeypatch, capsys):
    def warn(self):
        warnings.warn("a.obj: wears\nno texture", stacklevel=1)
        warnings.warn("of no concern", DeprecationWarning, stacklevel=1)

    monkeypatch.setattr(_materials.Materials, "run", warn)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert run("materials") == 0
    assert capsys.readouterr().err == "a.obj: wears no texture\n"


@pytest.mark.long
def test_a_closed_pipe_ends_it_in_silence():
    reading, writing = os.pipe()
    os.close(reading)
    program = "import sys; from splatjax.cli import main; sys.exit(main(['materials']))"
    ended = subprocess.run(
        [sys.executable, "-c", program], stdout=writing, stderr=subprocess.PIPE, check=False
    )
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (141, b"")


@pytest.fixture
def printed(monkeypatch, capsys):
    """Return how to get what words print, in a terminal so wide that no line is broken."""
    monkeypatch.setenv("COLUMNS", "3000")

    def run(*words, status=0):
        with pytest.raises(SystemExit) as stopped:
            main(words)
        assert (stopped.value.code or 0) == status
        captured = capsys.readouterr()
        return captured.err if status else captured.out

    return run


def test_a_misspelt_word_is_named_with_what_would_be_right(printed):
    text = printed("render", "--widht", "3", status=2)
    assert "--widht" in text
    assert text.count("--width") == 1  # of this command alone
    text = printed("rendr", status=2)
    assert all(command in text for command in _COMMANDS)


def test_help_lists_every_command_and_the_version_is_printed(printed):
    assert re.findall(r"• (\w+) +[A-Z]", printed("--help")) == list(_COMMANDS)
    assert printed() == printed("--help")
    assert printed("--version") == f"splatjax {sj.__version__}, jax {jax.__version__}\n"


def test_the_remaining_time_does_not_count_what_is_compiled_first(monkeypatch, capsys):
    """Of each of two tasks the first step takes 100 s, and each other one 2 s."""
    times = iter([0.0, 100.0, 102.0, 104.0, 106.0, 206.0, 208.0, 208.0])
    monkeypatch.setattr(_terminal.time, "perf_counter", lambda: next(times))
    with _terminal.stage("frames", 4) as report:
        for done in range(1, 5):
            report(done)
        report(1, "more")
        report(2, "more")
    lines = capsys.readouterr().err.splitlines()
    expected = ["1 of 4", "2 of 4, 4 s left", "3 of 4, 2 s left", "4 of 4, 0 s left"]
    assert lines[:4] == [f"frames: {line}" for line in expected]
    assert lines[4:6] == ["more: 1 of 4", "more: 2 of 4, 4 s left"]
