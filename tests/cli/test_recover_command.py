"""`splatjax recover`: what it reads, hands over, says and writes. The search itself is tested where
it is.
"""

import jax.numpy as jnp
import numpy as np
import OpenEXR
import optimistix as optx
import pytest
from commands import failure, plate
from PIL import Image

import splatjax as sj
from splatjax.cli import main

PICTURES = """[[pictures]]
file = "one.exr"
camera = {{ position = [0, 0, 80], target = [0, 0, 0], fov = 20 }}
{more}
[[pictures.lights]]
kind = "directional"
direction = [0, 0, -1]
irradiance = 3
"""


@pytest.fixture
def files(tmp_path):
    pixels = np.full((8, 8), 0.5, np.float32)
    with OpenEXR.File(
        {"type": OpenEXR.scanlineimage}, {"R": pixels, "G": pixels, "B": pixels}
    ) as file:
        file.write(str(tmp_path / "one.exr"))
    pictures = tmp_path / "pictures.toml"
    pictures.write_text(PICTURES.format(more=""))
    return plate(tmp_path / "plate.ply"), pictures


FOUND = (0.011, 0.022, 0.033)


@pytest.fixture
def search(monkeypatch):
    """A search that finds the same whatever it sees; the first one may be interrupted, or end
    before it has settled.
    """
    asked, interrupted = [], []

    def recover(observations, splats, starts, *, surface, model, count, loss, progress, throw):
        assert not throw  # what it has not reached the command line says
        asked.append((observations, splats, starts, model, count, loss))
        medium = sj.Medium(jnp.asarray(FOUND), starts[0].sigma_s_prime, starts[0].eta)
        progress("rendering", starts[0])
        progress("round 1", medium)
        ended = interrupted.pop() if interrupted else optx.RESULTS.successful
        if isinstance(ended, BaseException):
            raise ended
        seen = np.where(
            np.arange(64).reshape(8, 8, 1) < 40, np.asarray(observations[0].picture, float), np.nan
        )
        return sj.Recovery(
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

    monkeypatch.setattr(sj, "recover", recover)
    return asked, interrupted


def test_it_writes_a_material_and_a_report_and_says_what_is_not_fixed(
    files, search, tmp_path, capsys
):
    output, report = tmp_path / "mine.toml", tmp_path / "mine.png"
    command = [
        "recover",
        *files,
        "--start",
        "skin1",
        "marble",
        "--output",
        output,
        "--report",
        report,
        "--robust",
        "--no-suggest",
    ]
    assert main([str(word) for word in command]) == 0
    printed = capsys.readouterr().out
    assert "red: sigma_a 0.011 +- 1%, sigma_s' 0.74 +- 1% (1/mm)" in printed
    assert "not fixed by these pictures: sigma_s', known to 100%" in printed
    assert printed.splitlines()[-2:] == [str(output), str(report)]
    with Image.open(report) as picture:
        assert min(picture.size) > 200
    np.testing.assert_allclose(sj.load_medium(output).sigma_a, FOUND, rtol=1e-6)
    assert "recovered by splatjax" in output.read_text()
    assert not list(tmp_path.glob("*.json"))
    ((observations, splats, starts, model, count, loss),) = search[0]
    assert observations[0].picture.shape == (8, 8, 3)
    assert splats.albedo is None
    np.testing.assert_allclose(starts[1].sigma_a, sj.load_medium("marble").sigma_a, rtol=1e-6)
    np.testing.assert_array_equal(starts[1].eta, starts[0].eta)  # one index, that of the first
    assert (model, count) == (sj.Dipole, 6)
    assert isinstance(loss, sj.HuberLoss)


def test_the_index_of_refraction_is_that_of_the_first_start_or_the_one_given(
    files, search, tmp_path
):
    command = [
        "recover",
        *files,
        "--start",
        "marble",
        "skin1",
        "--output",
        tmp_path / "mine.toml",
        "--no-suggest",
    ]
    for more, eta in (([], 1.5), (["--eta", "1.42"], 1.42)):
        assert main([str(word) for word in (*command, *more)]) == 0
        for start in search[0][-1][2]:
            np.testing.assert_allclose(start.eta, 3 * [eta], rtol=1e-6)
        assert sj.load_material(tmp_path / "mine.toml").eta == pytest.approx(eta)


def test_interrupted_it_goes_on_where_it_was(files, search, tmp_path, capsys):
    asked, interrupted = search
    interrupted.append(KeyboardInterrupt())
    command = [
        str(word)
        for word in ("recover", *files, "--output", tmp_path / "mine.toml", "--no-suggest")
    ]
    assert main(command) == 130
    assert (tmp_path / "mine.search.json").exists()
    assert not (tmp_path / "mine.toml").exists()
    interrupted.append(KeyboardInterrupt())
    assert main(command) == 130
    assert len(asked[0][2]) == 2
    (start,) = asked[1][2]
    np.testing.assert_allclose(start.sigma_a, FOUND)
    files[1].write_text(PICTURES.format(more="noise = 0.01"))
    capsys.readouterr()
    assert main(command) == 0
    assert "is of another search, and is not used" in capsys.readouterr().err
    assert len(asked[2][2]) == 2
    assert not (tmp_path / "mine.search.json").exists()


def test_what_cannot_be_is_said_in_one_line(files, search, tmp_path, capsys):
    output = tmp_path / "mine.toml"
    command = ["recover", *files, "--output", output]
    assert "--model monte-carlo cannot be searched; take dipole" in failure(
        [*command, "--model", "monte-carlo"], capsys, [output]
    )
    assert "must end in .toml" in failure(
        ["recover", *files, "--output", tmp_path / "mine.exr"], capsys
    )
    assert "--eta is 0.9; it must lie between 1 and 3" in failure(
        [*command, "--eta", "0.9"], capsys, [output]
    )
    assert "has no [medium]" in failure([*command, "--start", "skin"], capsys, [output])
    assert not search[0]


def test_a_search_that_does_not_settle_says_so_and_is_taken_up_again(
    files, search, tmp_path, capsys
):
    search[1].append(optx.RESULTS.nonlinear_max_steps_reached)
    command = [
        str(word)
        for word in ("recover", *files, "--output", tmp_path / "mine.toml", "--no-suggest")
    ]
    assert main(command) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert (
        f"{files[1]}: the search did not settle in 1 round and 5 steps; the same command goes on "
        "where it stopped" in said
    )
    assert (tmp_path / "mine.search.json").exists()
    assert not (tmp_path / "mine.toml").exists()
    assert main(command) == 0
    np.testing.assert_allclose(search[0][1][2][0].sigma_a, FOUND)
