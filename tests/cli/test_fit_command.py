"""`splatjax fit` of coefficients, tables and photographs, and of many media into one table."""

import csv
import tomllib
import unittest.mock
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from bodies import assert_close
from commands import failure, run
from pictures import write_picture
from PIL import Image

import splatjax as sj
from splatjax.cli import _models

SKIN = [0.4395, 0.2133, 0.1155]  # what leaves skin1, by Monte Carlo (MCML)
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


def reflectance(path):
    return np.asarray(sj.load_material(path).gaussians.total_reflectance())


@pytest.fixture
def fits_end_as(monkeypatch):
    """Return how to make every fit end at once, with a result."""

    def ended(result, profile, count, **_):
        total = profile.total_reflectance()
        weights, unknown = jnp.stack([total / count] * count), jnp.ones(len(total))
        gaussians, covariance = sj.SumOfGaussians(jnp.ones(count), weights), jnp.eye(4 * count)
        return sj.fitting.FitResult(gaussians, unknown, unknown, result, covariance)

    return lambda result: monkeypatch.setattr(sj, "fit_gaussians", partial(ended, result))


def test_it_prints_and_writes_a_material_that_loads(tmp_path, capsys):
    output, plot = tmp_path / "mine.toml", tmp_path / "mine.png"
    assert run("fit", "skin1", "--count", 2, "--output", output, "--plot", plot) == 0
    printed = capsys.readouterr().out
    assert "error (Eq. 4)" in printed
    assert "fit over profile, less 1" in printed
    assert printed.splitlines()[-2:] == [str(output), str(plot)]
    with Image.open(plot) as picture:
        assert min(picture.size) > 400
    assert sj.load_material(output).gaussians.weights.shape == (2, 3)
    np.testing.assert_allclose(reflectance(output), SKIN, rtol=1e-3)
    grazing, normal = np.asarray(sj.load_material(output).angles(jnp.asarray([0.1, 1.0])))
    np.testing.assert_allclose(normal, 1, rtol=1e-5)
    assert np.all(grazing > 1.03)


@pytest.mark.parametrize(
    ("words", "description", "rtol"),
    [
        ("--model dipole", "classical dipole, exact", 0.15),
        ("--model better-dipole", "better dipole, exact", 0.12),
        ("--model photon-beam --single-scattering", "without single scattering", 0.1),
        pytest.param(
            "--model monte-carlo --photons 20000",
            "Monte Carlo, 20000 photons",
            0.05,
            marks=pytest.mark.long,
        ),
        pytest.param(
            "--model monte-carlo --photons 20000 --single-scattering",
            "without single scattering",
            0.05,
            marks=pytest.mark.long,
        ),
    ],
)
def test_it_takes_the_model_that_is_asked_for(words, description, rtol, fits_end_as, tmp_path):
    fits_end_as(optx.RESULTS.successful)
    output = tmp_path / "skin.toml"
    assert run("fit", "skin1", *words.split(), "--count", 1, "--output", output) == 0
    assert description in output.read_text()
    material, total = sj.load_material(output), reflectance(output)
    if material.single_scattering is not None:
        single = np.asarray(material.single_scattering.total_reflectance())
        assert np.all((single > 0.03) & (single < total))
        total = total + single
    np.testing.assert_allclose(total, SKIN, rtol=rtol)


def test_colors_that_gaussians_cannot_follow_are_named(fits_end_as, tmp_path, capsys):
    fits_end_as(optx.RESULTS.successful)
    skin, output = tmp_path / "dark.toml", tmp_path / "fitted.toml"
    skin.write_text("[skin]\nmelanin = 0.2\n")
    assert run("fit", skin, "--count", 1, "--output", output) == 0
    assert "its green and blue are negative from" in capsys.readouterr().err


def test_it_takes_normalized_diffusion_of_others(fits_end_as, tmp_path, capsys):
    fits_end_as(optx.RESULTS.successful)
    other, output = tmp_path / "other.toml", tmp_path / "fitted.toml"
    other.write_text(
        '[burley]\nunit = "mm"\nalbedo = [0.8, 0.5]\nscattering_distance = [2.0, 1.0]\n'
    )
    assert run("fit", other, "--count", 1, "--output", output) == 0
    material = sj.load_material(output)
    np.testing.assert_allclose(material.total_reflectance(), [0.8, 0.5], rtol=1e-5)
    assert material.angles is None
    assert sj.load_profile(output).length_scale().tolist() == [2.0, 1.0]
    capsys.readouterr()
    assert "[burley]" in failure(["fit", other, "--g", "0.5", "--output", output], capsys)


def test_it_takes_a_table_and_the_least_count(tmp_path):
    table, output = tmp_path / "measured.csv", tmp_path / "measured.toml"
    r = np.linspace(0.01, 0.5, 40)
    rows = np.column_stack([r, np.exp(-((10 * r) ** 2) / 4)])
    np.savetxt(table, rows, delimiter=",", header="r (cm), R (1/cm^2)")
    assert run("fit", table, "--mm-per-unit", 10, "--error", "1e-4", "--output", output) == 0
    gaussians = sj.load_material(output).gaussians
    assert_close(gaussians, sj.SumOfGaussians([2.0], [[4 * np.pi / 100]]), rtol=1e-5)


def test_it_takes_a_photograph_and_the_size_of_its_pixels(fits_end_as, tmp_path, capsys):
    """The total is one: of radiance times squared pixels, over the power."""
    fits_end_as(optx.RESULTS.successful)
    photograph, output = tmp_path / "dot.exr", tmp_path / "dot.toml"
    y, x = (np.mgrid[:60, :60] - 29.5) * 0.2
    radiance = 3 / np.pi * np.exp(-(x * x + y * y) / 4) / (4 * np.pi)
    write_picture(photograph, radiance[..., None])
    command = ["fit", photograph, "--count", 1, "--power", 3, "--output", output]
    assert "--mm-per-pixel" in failure(command, capsys)
    assert run(*command, "--mm-per-pixel", 0.2) == 0
    np.testing.assert_allclose(reflectance(output), [1.0], rtol=0.01)


@pytest.mark.parametrize(
    ("values", "count", "noted"),
    [
        ((0.42, 0.19, 0.048, 0.0062), 1, "times the light"),
        ((0.084, 0.037, 0.0096, 0.00124), 2, None),
        ((0.084, 0.037, 0.0096, 0.00124), 3, "4 radii"),
    ],
)
def test_it_notes_too_much_light_and_too_few_radii(
    values, count, noted, fits_end_as, tmp_path, capsys
):
    fits_end_as(optx.RESULTS.successful)
    rows = zip((0.5, 1, 2, 4), values, strict=True)
    lines = ["r (mm), R", *(f"{r}, {value}" for r, value in rows)]
    (tmp_path / "few.csv").write_text("\n".join(lines))
    assert run("fit", tmp_path / "few.csv", "--count", count) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if "few.csv " in line]
    assert (noted is None and not notes) or any(noted in line for line in notes)


def test_it_notes_a_large_error_and_channels_too_far_apart(fits_end_as, capsys):
    fits_end_as(optx.RESULTS.successful)
    for name, are_apart in (("ketchup", True), ("marble", False)):
        assert run("fit", name, "--model", "dipole") == 0
        noted = capsys.readouterr().err
        assert "--error 0.05" in noted
        assert ("far apart" in noted) == are_apart


@pytest.mark.parametrize(
    ("words", "remedy"), [("", "--count"), ("--model monte-carlo --photons 200", "--photons")]
)
def test_a_fit_that_does_not_settle_names_the_remedy(
    words, remedy, fits_end_as, monkeypatch, tmp_path, capsys
):
    fits_end_as(optx.RESULTS.nonlinear_max_steps_reached)
    walked = sj.scattering.Tabulated(
        jnp.arange(1.0, 5.0), jnp.ones((4, 3)), jnp.ones((4, 3)), jnp.ones(3)
    )
    monkeypatch.setattr(_models, "_walked", lambda *_: _models.Reference(walked))
    output = tmp_path / "mine.toml"
    line = failure(["fit", "skin1", *words.split(), "--output", output], capsys)
    assert "skin1" in line
    assert remedy in line
    assert not output.exists()


def test_a_fit_to_its_own_file_keeps_what_stood_there(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(OWN)
    assert run("fit", path, "--count", 2, "--output", path) == 0
    after = tomllib.loads(path.read_text())
    assert after["medium"]["sigma_a"] == tomllib.loads(OWN)["medium"]["sigma_a"]
    assert after["surface"] == {"eta": 1.5, "specular": 0.07, "roughness": 0.11}
    assert after["source"]["citation"] == "measured by hand"
    assert after["source"]["provenance"].startswith("the third sample; fitted by splatjax")
    assert len(after["fit"]["variances"]) == 2
    edited = tmp_path / "edited.toml"
    edited.write_text(path.read_text().replace("0.0021", "0.0022"))
    with pytest.warns(UserWarning, match="coefficients"):
        sj.load_material(edited)
    assert max(after["fit"]["error"]) < 0.5  # 1 if no Gaussian is as wide as the profile
    with jax.enable_x64(True):
        assert run("fit", path, "--count", 2, "--output", path) == 0
    assert tomllib.loads(path.read_text())["surface"] == after["surface"]


MEDIA = [
    "name,sigma_a,sigma_s_prime,eta",
    "a,0.002,2.6,1.5",
    "b,0.5,1.0,1.3",
    "c,0.0,3.0,1.4",
    "d,0.03,0.7,1.2",
    "e,0.1,8.0,1.0",
]


@pytest.fixture
def media(tmp_path):
    (tmp_path / "media.csv").write_text("\n".join(MEDIA) + "\n")
    return tmp_path / "media.csv"


def test_a_table_of_media_becomes_a_table_of_fits_and_is_continued(
    media, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(_models, "BATCH", 2)
    output = tmp_path / "fits.csv"
    words = ["fit", media, "--all", "--count", 2, "--output", output]
    with monkeypatch.context() as patch:
        patch.setattr(sj.io, "read_columns", unittest.mock.Mock(side_effect=KeyboardInterrupt))
        assert run(*words) == 130
    capsys.readouterr()
    assert run(*words) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{output}\n"
    assert "3 of 3 batches" in captured.err
    assert sorted(tmp_path.iterdir()) == [output, media]
    rows = list(csv.DictReader(output.read_text().splitlines()))
    assert [row["name"] for row in rows] == [line[0] for line in MEDIA[1:]]
    assert all(float(row["converged"]) == 1 for row in rows)
    alone = tmp_path / "alone.toml"
    alone.write_text(
        '[medium]\nunit = "1/mm"\nsigma_a = [0.03, 0.03, 0.03]\n'
        "sigma_s_prime = [0.7, 0.7, 0.7]\neta = 1.2\n"
    )
    assert run("fit", alone, "--count", 2, "--output", alone) == 0
    with jax.enable_x64(True):
        material = sj.load_material(alone)
    (first, second), angles = material.gaussians.variances, material.angles.coefficients[:, 0]
    error = tomllib.loads(alone.read_text())["fit"]["error"][0]
    columns = ("variance_1", "variance_2", "weight_1", "weight_2", "error")
    columns += tuple(f"angles_{power}" for power in range(5))
    found = [float(rows[3][column]) for column in columns]
    expected = [first, second, *material.gaussians.weights[:, 0], error, *angles]
    np.testing.assert_allclose(found, np.asarray(expected), rtol=1e-6)


def test_it_reports_how_many_did_not_converge(media, tmp_path, monkeypatch, capsys):
    columns = {"error": np.zeros(5), "converged": np.asarray([1.0, 0.0, 1.0, 1.0, 0.0])}
    monkeypatch.setattr(_models, "fit_batch", lambda *_: columns)
    assert run("fit", media, "--all", "--output", tmp_path / "fits.csv") == 0
    assert "2 of 5 fits" in capsys.readouterr().err
