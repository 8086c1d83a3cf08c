"""What the program says when something goes wrong, and with which status it ends."""

import os
import re
import subprocess
import sys
import tomllib
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
import pytest
from commands import failure, plate

import splatjax as sj
from splatjax.cli import _materials, _models, main

OWN = """[medium]
unit = "1/mm"
sigma_a = [0.0021, 0.0041, 0.0071]
sigma_s_prime = [2.19, 2.62, 3.0]
eta = 1.5
[surface]
roughness = 0.11
specular = 0.07
[source]
citation = "measured by hand"
provenance = "the third sample"
"""


@pytest.fixture
def spoilt(monkeypatch):
    """`splatjax materials` with an error of choice in it."""

    def with_error(error):
        def run(self):
            raise error

        monkeypatch.setattr(_materials.Materials, "run", run)

    return with_error


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (ValueError("a.ply: is\nempty"), 2, "splatjax: a.ply: is empty\n"),
        (
            OSError(28, "No space left on device", "a.exr"),
            2,
            "splatjax: a.exr: No space left on device\n",
        ),
        (
            MemoryError(),
            2,
            "splatjax: this takes more memory than there is; take fewer splats, or a smaller "
            "picture\n",
        ),
        (
            RuntimeError("RESOURCE_EXHAUSTED: Out of\nmemory"),
            2,
            "splatjax: this takes more memory than there is",
        ),
        (
            TypeError("no such\nthing"),
            1,
            "splatjax: a fault of splatjax itself: TypeError: no such thing; please report it with",
        ),
        (KeyboardInterrupt(), 130, "splatjax: interrupted\n"),
    ],
)
def test_status_says_whose_fault_it_is(error, status, said, spoilt, capsys):
    spoilt(error)
    assert main(["materials"]) == status
    captured = capsys.readouterr()
    assert captured.err.startswith(said)
    assert captured.err.count("\n") == 1


def test_a_check_in_compiled_code_is_one_sentence(monkeypatch, capsys):
    @eqx.filter_jit
    def checked(x):
        return eqx.error_if(x, x > 0, "x is positive;\ngive a negative one")

    monkeypatch.setattr(_materials.Materials, "run", lambda self: checked(jnp.ones(())))
    assert main(["materials"]) == 2
    assert capsys.readouterr().err == "splatjax: x is positive; give a negative one\n"


@pytest.mark.parametrize(
    ("words", "remedy"),
    [
        ([], "give a smaller --count"),
        (["--model", "monte-carlo", "--photons", "200"], "200 photons tell too little apart"),
    ],
)
def test_a_fit_that_does_not_settle_says_what_to_change(
    words, remedy, monkeypatch, tmp_path, capsys
):
    def unsettled(profile, count, *, throw, **_):
        assert not throw
        gaussians = sj.SumOfGaussians(jnp.ones(count), jnp.ones((count, 3)))
        result = optx.RESULTS.nonlinear_max_steps_reached
        return sj.FitResult(gaussians, jnp.ones(3), jnp.ones(3), result, jnp.eye(4 * count))

    medium = jnp.ones(3)
    walked = sj.Tabulated(jnp.arange(1.0, 5.0), jnp.ones((4, 3)), jnp.ones((4, 3)), medium)
    monkeypatch.setattr(sj, "fit_gaussians", unsettled)
    monkeypatch.setattr(_models, "_walked", lambda layers, photons: walked)
    said = failure(
        ["fit", "skin1", *words, "--output", tmp_path / "mine.toml"],
        capsys,
        [tmp_path / "mine.toml"],
    )
    assert said.startswith("splatjax: skin1: the search for 6 Gaussians did not settle")
    assert remedy in said


@pytest.mark.parametrize("words", [["--debug", "materials"], ["materials", "--debug"]])
def test_debug_shows_where_it_arose(words, spoilt, capsys):
    spoilt(ValueError("a.ply: is empty"))
    assert main(words) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("Traceback")
    assert lines[-1] == "splatjax: a.ply: is empty"


def test_what_a_user_should_know_is_a_line(monkeypatch, capsys):
    def run(self):
        warnings.warn("a.obj: wears\nno texture", stacklevel=1)
        warnings.warn("of no concern", DeprecationWarning, stacklevel=1)

    monkeypatch.setattr(_materials.Materials, "run", run)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(["materials"]) == 0
    assert capsys.readouterr().err == "a.obj: wears no texture\n"


@pytest.mark.long
def test_nobody_reads_on():
    """The other end of the pipe is closed before the first word."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [
        sys.executable,
        "-c",
        "import sys; from splatjax.cli import main; sys.exit(main(['materials']))",
    ]
    ended = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert ended.returncode == 141
    assert ended.stderr == ""


def test_names_that_are_nearly_right_are_told(tmp_path, capsys, x64):
    path = tmp_path / "mine.toml"
    for right, wrong in (
        ("roughness", "roughnes"),
        ("sigma_a", "sigma_A"),
        ("[surface]", "[surfaces]"),
    ):
        path.write_text(OWN.replace(right, wrong))
        assert (
            f"unknown entry {wrong.strip('[]')!r}; did you mean {right.strip('[]')!r}?"
            in failure(["fit", path], capsys)
        )
    path.write_text(OWN.replace('"1/mm"', '"1/cm"'))
    assert "unit must be \"1/mm\"; it is '1/cm': convert the numbers" in failure(
        ["fit", path], capsys
    )
    path.write_text(OWN.replace('unit = "1/mm"\n', "", 1))
    assert 'has no unit; convert the numbers, and say unit = "1/mm"' in failure(
        ["fit", path], capsys
    )
    path.write_text(OWN.replace("sigma_s_prime", "sigma_s"))
    assert "has sigma_s; give sigma_s_prime = (1 - g) sigma_s, with the mean cosine g" in failure(
        ["fit", path], capsys
    )
    beyond_single = () if x64 else ("1e-60", "1e60")  # nothing, and infinite
    for value in ("true", '"0.1"', *beyond_single):
        path.write_text(OWN.replace("2.19", value))
        said = failure(
            [
                "render",
                plate(tmp_path / "plate.ply"),
                "--material",
                path,
                "--output",
                tmp_path / "o.exr",
            ],
            capsys,
        )
        assert "sigma_s_prime must be" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--width", "1000000", "--height", "1000000"],
            "--width 1000000 --height 1000000 would take about 5e+05 GB of memory",
        ),
        (["--count", "1000000000000"], "--count 1000000000000 would take about 1e+06 GB of memory"),
    ],
)
def test_what_cannot_fit_is_refused_with_what_would(words, said, tmp_path, capsys):
    line = failure(["render", *words, "--output", tmp_path / "o.exr"], capsys)
    assert said in line
    assert re.search(r"take \d+ (pixels )?at most", line)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--width", "0"], "--width is 0; it must be 1 or more"),
        (["--height", "-3"], "--height is -3; it must be 1 or more"),
        (["--count", "0"], "--count is 0; it must be 1 or more"),
        (["--scale", "0"], "--scale is 0; it must be a positive factor"),
        (["--fov", "180"], "--fov is 180; it must lie between 0 and 180 degrees"),
        (["--fov", "nan"], "--fov is nan; it must lie between 0 and 180 degrees"),
    ],
)
def test_a_size_that_cannot_be_is_refused_before_splats_are_read(words, said, tmp_path, capsys):
    nowhere = tmp_path / "missing.ply"
    assert said in failure(["render", nowhere, *words, "--output", tmp_path / "o.exr"], capsys)


def test_what_no_error_can_be_is_refused_before_the_fit(capsys):
    assert "--error is -1; it must be positive" in failure(
        ["fit", "marble", "--error", "-1"], capsys
    )


def test_a_picture_is_no_material(tmp_path, capsys):
    path = tmp_path / "bust.png"
    path.write_bytes(bytes(range(256)))
    assert "bust.png: is no TOML file, and no text at all" in failure(["fit", path], capsys)


def test_a_cut_without_effect_is_refused(capsys):
    for more in (
        ["--model", "photon-beam", "--single-scattering"],
        [],
        ["--model", "better-dipole"],
    ):
        said = failure(["fit", "skin1", *more, "--cut", "0.3"], capsys)
        assert "--cut has no effect on --model" in said
        assert "leave it out" in said


@pytest.mark.once
def test_a_fit_to_its_own_file_keeps_what_stood_there(tmp_path, capsys):
    path = tmp_path / "mine.toml"
    path.write_text(OWN)
    assert main(["fit", str(path), "--count", "1", "--output", str(path)]) == 0
    before, after = tomllib.loads(OWN), tomllib.loads(path.read_text())
    assert after["medium"]["sigma_a"] == before["medium"]["sigma_a"]
    assert after["surface"] == {"eta": 1.5, "specular": 0.07, "roughness": 0.11}
    assert after["source"]["citation"] == "measured by hand"
    assert after["source"]["provenance"].startswith("the third sample; fitted by splatjax")
    assert len(after["fit"]["variances"]) == 1
    with jax.enable_x64(True):
        assert main(["fit", str(path), "--count", "1", "--output", str(path)]) == 0
    assert tomllib.loads(path.read_text())["surface"] == after["surface"]


def test_only_a_binary_file_is_streamed(tmp_path, capsys):
    output = tmp_path / "out.exr"
    assert "--stream is 5" in failure(
        ["render", "--stream", 5, "--output", output], capsys, [output]
    )
    text = plate(tmp_path / "plate.ply")
    assert "write them as binary" in failure(
        ["render", text, "--stream", 5, "--output", output], capsys, [output]
    )
