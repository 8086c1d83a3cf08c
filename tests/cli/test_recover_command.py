"""`splatjax recover`: its inputs, options, messages and files. The search itself is tested where it
is.
"""

import jax.numpy as jnp
import numpy as np
import OpenEXR
import optimistix as optx
import pytest
from commands import failure, plate, run
from PIL import Image

import splatjax as sj

PICTURES = """[[pictures]]
file = "one.exr"
camera = {{ position = [0, 0, 80], target = [0, 0, 0], fov = 20 }}
{more}
[[pictures.lights]]
kind = "directional"
direction = [0, 0, -1]
irradiance = 3
"""
FOUND = (0.011, 0.022, 0.033)


@pytest.fixture
def command(tmp_path):
    pixels = np.full((8, 8), 0.5, np.float32)
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, dict.fromkeys("RGB", pixels)) as file:
        file.write(str(tmp_path / "one.exr"))
    (tmp_path / "pictures.toml").write_text(PICTURES.format(more=""))
    files = plate(tmp_path / "plate.ply"), tmp_path / "pictures.toml"
    return ["recover", *files, "--output", tmp_path / "mine.toml", "--no-suggest"]


@pytest.fixture
def search(monkeypatch):
    """A search that finds the same for every input. Returns the arguments of its calls, and a list
    of how the next ones end: interrupted, or before they have settled.
    """
    calls, ends = [], []

    def recover(observations, splats, starts, *, surface, progress, throw, **options):
        assert not throw  # the command line reports what was not reached
        calls.append((observations, splats, starts, options))
        medium = sj.Medium(jnp.asarray(FOUND), starts[0].sigma_s_prime, starts[0].eta)
        progress("rendering", starts[0])
        progress("round 1", medium)
        ended = ends.pop() if ends else optx.RESULTS.successful
        if isinstance(ended, BaseException):
            raise ended
        seen = np.array(observations[0].picture, float)
        seen[5:] = np.nan
        return sj.inverse.Recovery(
            medium=medium,
            material=surface,
            intensities=jnp.ones((1, 3)),
            information=jnp.diag(jnp.asarray([1e4, 1e4, 1e4, 1e4, 1e4, 1.0, 0.0, 0.0, 0.0])),
            unresolved=jnp.zeros(3),
            chi_squared=jnp.asarray(1.0),
            pictures=(seen + 0.01,),
            residuals=(seen * 0 + 0.01,),
            ends=(medium,),
            costs=jnp.zeros(1),
            result=ended,
            noise_is_known=True,
            relative_noise=0.01,
            steps=5,
            rounds=1,
        )

    monkeypatch.setattr(sj.inverse, "recover", recover)
    return calls, ends


def test_it_writes_a_material_and_a_report_with_what_is_not_fixed(
    command, search, tmp_path, capsys
):
    output, report = tmp_path / "mine.toml", tmp_path / "mine.png"
    assert run(*command, "--start", "skin1", "marble", "--report", report, "--robust") == 0
    printed = capsys.readouterr().out
    assert "red: sigma_a 0.011 +- 1%, sigma_s' 0.74 +- 1%" in printed
    assert "not fixed by these pictures: sigma_s', known to 100%" in printed
    assert printed.splitlines()[-2:] == [str(output), str(report)]
    with Image.open(report) as picture:
        assert min(picture.size) > 200
    np.testing.assert_allclose(sj.load_medium(output).sigma_a, FOUND, rtol=1e-6)
    assert "recovered by splatjax" in output.read_text()
    assert not list(tmp_path.glob("*.json"))
    ((observations, splats, starts, options),) = search[0]
    assert observations[0].picture.shape == (8, 8, 3)
    assert splats.albedo is None
    np.testing.assert_allclose(starts[1].sigma_a, sj.load_medium("marble").sigma_a, rtol=1e-6)
    assert (options["model"], options["count"]) == (sj.Dipole, 6)
    assert isinstance(options["loss"], sj.inverse.HuberLoss)


@pytest.mark.parametrize(("more", "eta"), [([], 1.5), (["--eta", 1.42], 1.42)])
def test_the_index_of_refraction_is_of_the_first_start_or_the_one_given(
    more, eta, command, search, tmp_path
):
    assert run(*command, "--start", "marble", "skin1", *more) == 0
    for start in search[0][0][2]:
        np.testing.assert_allclose(start.eta, 3 * [eta], rtol=1e-6)
    assert sj.load_material(tmp_path / "mine.toml").eta == pytest.approx(eta)


def test_interrupted_or_unsettled_it_continues_where_it_was(command, search, tmp_path, capsys):
    calls, ends = search
    output, record = tmp_path / "mine.toml", tmp_path / "mine.search.json"
    ends += [optx.RESULTS.nonlinear_max_steps_reached, KeyboardInterrupt()]
    for number, status in enumerate((130, 2)):
        assert run(*command) == status
        assert record.exists()
        assert not output.exists()
        assert len(calls[number][2]) == 2 - number
    assert "pictures.toml" in capsys.readouterr().err.splitlines()[-1]
    np.testing.assert_allclose(calls[1][2][0].sigma_a, FOUND)
    (tmp_path / "pictures.toml").write_text(PICTURES.format(more="noise = 0.01"))
    assert run(*command) == 0
    assert str(record) in capsys.readouterr().err  # of another search
    assert len(calls[2][2]) == 2
    assert not record.exists()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--output", "mine.exr"], "mine.exr"),
        (["--eta", 0.9], "--eta is 0.9"),
        (["--start", "skin"], "[medium]"),
    ],
)
def test_options_are_checked_before_the_search(words, named, command, search, tmp_path, capsys):
    assert named in failure([*command, *words], capsys)
    assert not search[0]
    assert not (tmp_path / "mine.toml").exists()
